"""The drumming arm: control steps a second, alone and eight at once.

    python benchmarks/drumming.py

Everything is measured in one run, in turns, and the medians of the turns are compared, since a
shared machine slows all of it down together. Target: one arm, by `gymnasium.make` with its default
wrappers, at 20 times real time or better (2000 control steps a second). Eight arms in processes of
their own cannot be faster than the machine has cores.
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

import iflow_gym  # noqa: F401  (registers the ids)
from iflow_gym.envs.drumming.simulation import SUBSTEPS, Simulation
from iflow_gym.registration import DRUMMING_ID

TURNS = 7
SECONDS = 0.5
"""Of stepping, a turn."""
ARMS = 8

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


def eight() -> tuple[Step, Callable[[], None]]:
    """Return a function that steps eight arms in processes, and one that ends them."""
    envs = gymnasium.make_vec(f"iflow_gym:{DRUMMING_ID}", num_envs=ARMS, vectorization_mode="async")
    envs.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-0.2, 0.2, (100, ARMS, 3)).astype(np.float32)
    turn = cycle([*actions, *-actions])  # there and back, clear of drums and borders
    return lambda: envs.step(next(turn)), envs.close


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
    together, close = eight()
    cases: dict[str, tuple[int, Step]] = {
        "physics alone": (1, physics(env)),
        "one arm, velocity": (1, replayed()),
        "one arm, torque": (1, replayed(control_mode="torque")),
        f"{ARMS} arms, AsyncVectorEnv": (ARMS, together),
    }
    rates: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(TURNS):
        for name, (n, step) in cases.items():
            rates[name].append(n * rate(step))
    close()
    try:
        cases["pictures, 640 x 480"], rates["pictures, 640 x 480"] = (1, drawn()), [rate(drawn())]
    except gymnasium.error.DependencyNotInstalled as error:
        print(f"no pictures: {error}")
    one = median(rates["one arm, velocity"])
    print(f"MuJoCo {mujoco.__version__}, {os.cpu_count()} cores, {TURNS} turns of {SECONDS} s")
    print(f"{'':<26}{'steps/s':>10}{'x real time':>13}{'x one arm':>11}{'us/call':>10}")
    for name, (n, _) in cases.items():
        value = median(rates[name])
        real = value * base_dt(env)
        print(f"{name:<26}{value:>10,.0f}{real:>13.1f}{value / one:>11.2f}{1e6 * n / value:>10.0f}")


def base_dt(env: gymnasium.Env[Any, Any]) -> float:
    dt: float = env.unwrapped.dt  # type: ignore[attr-defined]
    return dt


if __name__ == "__main__":
    main()
