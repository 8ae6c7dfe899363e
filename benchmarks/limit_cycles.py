"""ImitationFlow on the generated letters: the orbit, its period, attraction, calm, classification.

    python benchmarks/limit_cycles.py [--letters I R O S] [--seeds 0 1 2] [--n-steps 1500]

Every model is fitted on a letter's first ten recordings, all of them together. Rollouts last eight
periods, of which the last two are the steady orbit, sampled FINER times as often as the recordings
so that a distance is not one between samples. Distances are in % of the diagonal of the
recordings' box; "floor" is what the mean round of the recordings has, which no deterministic orbit
beats by much: recordings differ from each other. Classification is of the other ten recordings,
as they are and changed in size and tempo, with and without the pose removed.
"""

import time
from dataclasses import dataclass

import numpy as np
import torch
import tyro
from scipy.spatial import cKDTree

from iflow_gym import Demonstrations
from iflow_gym.baselines.imitation_flow import ImitationFlow
from iflow_gym.baselines.imitation_flow.config import IN_PLANE
from iflow_gym.classification import TrajectoryClassifier, varied
from iflow_gym.datasets.letters import load_letter
from iflow_gym.demonstrations import FloatArray
from iflow_gym.rounds import period_of, phases

N_FIT = 10
"""Recordings that are fitted on."""

PERIODS, STEADY = 8, 2
"""Periods of a rollout, and those that are scored."""

FINER = 10
"""Samples of the orbit for each of the recordings'."""

CHANGES = (0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0)
"""Sizes and tempos at which the held-out recordings are classified."""


@dataclass(frozen=True)
class Options:
    """What to measure."""

    letters: tuple[str, ...] = ("I", "R", "O", "S")
    """By name."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """One table a seed."""
    n_steps: int = IN_PLANE.n_steps
    """Steps of Adam."""
    classify: bool = True
    """Classify the held-out recordings."""


def distances(orbit: FloatArray, samples: FloatArray) -> tuple[float, float]:
    """Mean distance to the nearest, both ways, and Hausdorff distance."""
    there, back = cKDTree(samples).query(orbit)[0], cKDTree(orbit).query(samples)[0]
    return (there.mean() + back.mean()) / 2, max(there.max(), back.max())


def mean_round(motion: Demonstrations, n: int = 600) -> FloatArray:
    """Mean over all rounds at n phases; each recording is shifted to where it is nearest."""
    at = np.arange(n) / n
    means = []
    for path, dt in zip(motion.positions, motion.dt, strict=True):
        phase = phases(path, dt)
        each = [[np.interp(at + k, phase, x) for x in path.T] for k in range(int(phase[-1]))]
        means.append(np.mean(each, axis=0).T)
    mean = means[0]
    for _ in range(3):
        shifted = [np.stack([np.roll(path, k, axis=0) for k in range(n)]) for path in means]
        nearest = [path[np.sum((path - mean) ** 2, axis=(1, 2)).argmin()] for path in shifted]
        mean = np.mean(nearest, axis=0)
    return mean


def grid(motion: Demonstrations, n: int) -> FloatArray:
    """Return n x n states of the recordings' box enlarged by half of each side."""
    low, high = motion.bounding_box
    reach = (high - low) / 2
    axes = [np.linspace(a - r, b + r, n) for a, b, r in zip(low, high, reach, strict=True)]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)


def row(system: ImitationFlow, motion: Demonstrations) -> str:
    """Return a letter's figures."""
    size, samples = motion.bounding_box.diagonal, np.concatenate(motion.positions)
    dt, period = motion.mean_dt, float(motion.period or 0)
    n, n_steady, n_round = (round(k * period / dt) for k in (PERIODS, STEADY, 1))
    path = system.rollout(motion.starts[:1], FINER * n, dt / FINER)[0]
    orbit, mean = path[-FINER * n_steady :], mean_round(motion)
    starts = system.rollout(grid(motion, 16), n, dt)[:, -n_round:]
    off = cKDTree(orbit).query(starts)[0].max(axis=1)
    speed = np.linalg.norm(system.velocity(grid(motion, 80)), axis=1).max() / motion.peak_speed
    found = period_of(path[-2 * FINER * n_steady :: FINER], dt)
    pairs = [distances(orbit, samples), distances(mean, samples), distances(orbit, mean)]
    figures = [100 * value / size for pair in pairs for value in pair]
    return " | ".join(
        [*(f"{x:.2f}" for x in figures), f"{100 * abs(found - period) / period:.2f}",
         f"{(off <= 0.05 * size).mean():.3f}", f"{speed:.1f}"]
    )  # fmt: skip


def main(options: Options) -> None:
    """Print a table of the letters and of the classification for each seed."""
    torch.set_num_threads(1)
    recordings = {name: load_letter(name) for name in options.letters}
    fitted = {name: motion.subset(range(N_FIT)) for name, motion in recordings.items()}
    others = {name: m.subset(range(N_FIT, len(m))) for name, m in recordings.items()}
    for seed in options.seeds:
        began = time.perf_counter()
        method = ImitationFlow(n_steps=options.n_steps)
        systems = method.fit_many(list(fitted.values()), seeds=[seed] * len(fitted))
        print(f"\nseed {seed}: {time.perf_counter() - began:.0f} s for {len(systems)} letters\n")
        print(
            "| letter | mean | Hausdorff | floor, mean | floor, Hausdorff | to the mean round "
            "| Hausdorff | period | attraction | peak speed |\n" + "| --- " + 9 * "| ---: " + "|"
        )
        for name, system in zip(fitted, systems, strict=True):
            print(f"| {name} | {row(system, fitted[name])} |", flush=True)
        if not options.classify:
            continue
        models = dict(zip(fitted, systems, strict=True))
        plain, posed = TrajectoryClassifier(models), TrajectoryClassifier(models, fitted)
        print("\n| change | size | tempo | size, pose removed | tempo, pose removed |")
        print("| ---: | ---: | ---: | ---: | ---: |")
        for k in CHANGES:
            scores = []
            for classifier in (plain, posed):
                for change in ({"scale": k}, {"tempo": k}):
                    shown = {name: varied(m, **change) for name, m in others.items()}
                    scores.append(f"{classifier.accuracy(shown):.3f}")
            print(f"| {k} | {' | '.join(scores)} |", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options))
