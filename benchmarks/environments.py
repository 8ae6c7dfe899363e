"""Environment steps a second: ours beside Gymnasium's CartPole, one by one and batched.

    python benchmarks/environments.py

Everything is measured in one run, in turns, and the medians of the turns are compared, since a
shared machine slows all of it down together. Targets: a single environment at 0.3 times CartPole's
rate or better (both by `gymnasium.make`, default wrappers), and 1024 batched at 100 times the
single one's or better.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median
from typing import Any

import gymnasium
import numpy as np

import iflow_gym  # noqa: F401  (registers the ids)

LASA = "iflow/LASA-Sshape-v0"
TURNS = 7
SECONDS = 0.25
"""Of stepping, a turn."""

Step = Callable[[], Any]


def single(env_id: str, action: Any, **settings: Any) -> Step:
    """Return a function that makes one step, and resets where an episode ends."""
    env = gymnasium.make(env_id, **settings)
    env.reset(seed=0)

    def step() -> None:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()

    return step


def batched(n: int, mode: str = "vector_entry_point", **settings: Any) -> Step:
    """Return a function that steps n environments, which reset by themselves."""
    envs = gymnasium.make_vec(LASA, num_envs=n, vectorization_mode=mode, **settings)
    envs.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-0.1, 0.1, (n, 2)).astype(np.float32)
    return lambda: envs.step(actions)


def drawn() -> Step:
    """Return a function that draws a frame with a trail of 500 samples."""
    env = gymnasium.make(LASA, render_mode="rgb_array")
    env.reset(seed=0)
    for _ in range(500):
        env.step(np.array([0.01, -0.01]))
    return env.render


def rate(step: Step) -> float:
    """Return calls a second."""
    calls, begin = 0, time.perf_counter()
    while (passed := time.perf_counter() - begin) < SECONDS:
        for _ in range(10):
            step()
        calls += 10
    return calls / passed


def main() -> None:
    action = np.array([0.02, -0.01], dtype=np.float32)
    cases: dict[str, tuple[int, Step]] = {
        "CartPole-v1": (1, single("CartPole-v1", 1)),
        "single, velocity": (1, single(LASA, action)),
        "single, force": (1, single(LASA, action, control_mode="force")),
        "SyncVectorEnv of 64": (64, batched(64, "sync")),
        "batched 64": (64, batched(64)),
        "batched 1024": (1024, batched(1024)),
        "batched 1024, force": (1024, batched(1024, control_mode="force")),
        "batched 8192": (8192, batched(8192)),
        "frames, rgb_array": (1, drawn()),
    }
    rates: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(TURNS):
        for name, (n, step) in cases.items():
            rates[name].append(n * rate(step))
    medians = {name: median(values) for name, values in rates.items()}
    print(f"{'':<22}{'steps/s':>14}{'x CartPole':>12}{'x single':>10}{'us/call':>10}")
    for name, value in medians.items():
        own = medians["single, force" if "force" in name else "single, velocity"]
        print(
            f"{name:<22}{value:>14,.0f}{value / medians['CartPole-v1']:>12.2f}"
            f"{value / own:>10.1f}{1e6 * cases[name][0] / value:>10.1f}"
        )


if __name__ == "__main__":
    main()
