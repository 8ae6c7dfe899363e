"""The drumming arm: control steps a second, alone and many at once.

    OMP_NUM_THREADS=1 python benchmarks/drumming.py

Everything is measured in one run, in turns, and the medians of the turns are compared, since a
shared machine slows all of it down together. Targets: one arm, by `gymnasium.make` with its default
wrappers, at 20 times real time or better (2000 control steps a second); many arms as many times as
fast as one as there are cores.

- *by make_vec*: the suite's own batch, whose processes, one a core, share the arms out.
- *AsyncVectorEnv*: Gymnasium's, with a process for each arm.
- *of an idle one*: the same of an environment whose step only counts for about as long as the arm's
  takes, in the least memory, and which tells nothing: what processes and messages alone cost.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from itertools import cycle
from statistics import median
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium.vector import AsyncVectorEnv

import iflow_gym  # noqa: F401  (registers the ids)
from iflow_gym.envs.drumming.simulation import SUBSTEPS, Simulation
from iflow_gym.registration import DRUMMING_ID

TURNS = 7
SECONDS = 0.5
"""Of stepping, a turn."""
ARMS, MANY = 8, 64
ONE = "one arm"

Step = Callable[[], Any]


def physics(env: gymnasium.Env[Any, Any]) -> Step:
    """Return a function that does a control step's physics alone, with the arm at rest."""
    simulation = Simulation(env.unwrapped.drums)  # type: ignore[attr-defined]
    simulation.place(np.array([0.68, 0.0, 0.42]))
    return lambda: mujoco.mj_step(simulation.model, simulation.data, SUBSTEPS)


def replayed(**settings: Any) -> Step:
    """Return a function that makes one step of a replay, and resets where an episode ends."""
    env = gymnasium.make(DRUMMING_ID, **settings)
    base: Any = env.unwrapped
    path = base.demonstrations.positions[0]
    state: dict[str, Any] = {}

    def begin() -> None:
        state["observation"], _ = env.reset(seed=0, options={"demonstration": 0})
        state["k"] = 0

    def step() -> None:
        state["k"] += 1
        observation = state["observation"]
        action = (path[state["k"]] - observation[:3]) / base.dt / base.max_speed
        if base.control_mode == "torque":
            action = base.command_to_action(action * base.max_speed, observation)
        state["observation"], _, _, truncated, _ = env.step(action)
        if truncated:
            begin()

    begin()
    return step


def wandering(env: Any, *shape: int) -> Step:
    """Return a function that steps one or many by actions there and back, clear of all."""
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-0.2, 0.2, (100, *shape, 3)).astype(np.float32)
    turn = cycle([*actions, *-actions])

    def step() -> None:
        truncated = env.step(next(turn))[3]
        if not shape and truncated:
            env.reset(seed=0)

    return step


def together(n: int, mode: str) -> Any:
    """Return n arms at once."""
    return gymnasium.make_vec(f"iflow_gym:{DRUMMING_ID}", num_envs=n, vectorization_mode=mode)


class Idle(gymnasium.Env[Any, Any]):
    """Computes for as long as it is told, and tells nothing."""

    observation_space = gymnasium.spaces.Box(-2.0, 2.0, (3,), np.float64)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float32)

    def __init__(self, seconds: float) -> None:
        self._turns = 10_000
        begin = time.perf_counter()
        self._spin()
        self._turns = round(self._turns * seconds / (time.perf_counter() - begin))

    def _spin(self) -> None:
        for _ in range(self._turns):
            pass

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Begin."""
        super().reset(seed=seed)
        return np.zeros(3), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Compute."""
        self._spin()
        return np.zeros(3), 0.0, False, False, {}


def drawn() -> Step:
    """Return a function that draws a picture of 640 x 480."""
    env = gymnasium.make(DRUMMING_ID, render_mode="rgb_array")
    env.reset(seed=0)
    env.render()
    return env.render


def rate(step: Step) -> float:
    """Return calls a second."""
    calls, begin = 0, time.perf_counter()
    while (passed := time.perf_counter() - begin) < SECONDS:
        step()
        calls += 1
    return calls / passed


def main() -> None:
    env = gymnasium.make(DRUMMING_ID)
    alone = wandering(gymnasium.make(DRUMMING_ID))
    seconds = 1 / rate(alone)
    batches = {
        (ARMS, "by make_vec"): together(ARMS, "vector_entry_point"),
        (MANY, "by make_vec"): together(MANY, "vector_entry_point"),
        (ARMS, "AsyncVectorEnv"): together(ARMS, "async"),
        (ARMS, "of an idle one"): AsyncVectorEnv([lambda: Idle(seconds)] * ARMS),
    }
    cases: dict[str, tuple[int, Step]] = {
        "physics alone": (1, physics(env)),
        "one arm, replay by torques": (1, replayed(control_mode="torque")),
        "one arm, replay": (1, replayed()),
        ONE: (1, alone),
        "an idle one": (1, wandering(Idle(seconds))),
        **{f"{n} arms, {name}": (n, wandering(b, n)) for (n, name), b in batches.items()},
    }
    rates: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(TURNS):
        for name, (n, step) in cases.items():
            rates[name].append(n * rate(step))
    for batch in batches.values():
        batch.close()
    try:
        cases["pictures, 640 x 480"], rates["pictures, 640 x 480"] = (1, drawn()), [rate(drawn())]
    except gymnasium.error.DependencyNotInstalled as error:
        print(f"no pictures: {error}")
    one = median(rates[ONE])
    print(f"MuJoCo {mujoco.__version__}, {os.cpu_count()} cores, {TURNS} turns of {SECONDS} s")
    print(f"{'':<28}{'steps/s':>10}{'x real time':>13}{'x one arm':>11}{'us/call':>10}")
    for name, (n, _) in cases.items():
        value = median(rates[name])
        real = value * base_dt(env)
        print(f"{name:<28}{value:>10,.0f}{real:>13.1f}{value / one:>11.2f}{1e6 * n / value:>10.0f}")


def base_dt(env: gymnasium.Env[Any, Any]) -> float:
    dt: float = env.unwrapped.dt  # type: ignore[attr-defined]
    return dt


if __name__ == "__main__":
    main()
