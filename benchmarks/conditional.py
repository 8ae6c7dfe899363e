"""One ImitationFlow for several motions, by a context, against a model for each: Fréchet and calm.

    python benchmarks/conditional.py [--sets Multi_Models_1 four eight] [--n-hidden 32] [--seed 1]

Each of LASA's Multi_Models holds two or three motions; `four` and `eight` are so many of its other
shapes. Three ways to learn a set: one model for each motion; one model that is told the motion by
a context, one unit vector each; and, for the Multi_Models, one field for all without a context.
Errors are means over a motion's recordings, in mm, of rollouts in closed form, then over the
motions.

Converged is the worst share of the start grid from which the motion is at its goal after five
durations, over the contexts that were fitted and, apart, over contexts between: a quarter, half and
three quarters of the way between any two, and the mean of all. Peak is the highest speed on that
grid, over the recordings' peak: between two motions nothing was shown, and nothing but the calm
penalty of the fitted contexts keeps the field from being fast. The grid is on twice the box of the
whole set; for a model of one motion it is on twice that motion's, the box whose calm it was asked.
"""

import time
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np
import torch
import tyro

from iflow_gym import Demonstrations
from iflow_gym.baselines.imitation_flow import (
    ConditionalImitationFlow,
    ImitationFlow,
    ImitationFlowConfig,
)
from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.metrics import converged, convergence_tolerance, frechet, rmse, start_grid
from iflow_gym.metrics.stability import HORIZON

PARTS = {
    "Multi_Models_1": (3, 2, 2),
    "Multi_Models_2": (4, 3),
    "Multi_Models_3": (4, 3),
    "Multi_Models_4": (4, 3),
}
"""How many recordings in a row each of the motions has."""

FOUR = ("Angle", "Sshape", "Leaf_1", "CShape")
SHAPES = {"four": FOUR, "eight": (*FOUR, "GShape", "Khamesh", "Sharpc", "heee")}

N_SAMPLES = 1000
"""Samples of a rollout to the horizon."""


@dataclass(frozen=True)
class Options:
    """What to measure."""

    sets: tuple[str, ...] = (*PARTS, *SHAPES)
    """Sets of motions."""
    seed: int = 0
    """Of every fit."""
    n_steps: int | None = None
    """Steps of training; None takes the default."""
    n_layers: int = ImitationFlowConfig().n_layers
    n_hidden: int = ImitationFlowConfig().n_hidden
    """Layers and units of the model with a context; the other models have the default."""
    others: bool = True
    """False leaves the other models out, to compare settings of the one with a context."""


def motions_of(name: str) -> list[Demonstrations]:
    """Return the motions of a set."""
    if name in SHAPES:
        return [load_lasa(shape) for shape in SHAPES[name]]
    whole, ends = load_lasa(name), np.cumsum((0, *PARTS[name]))
    return [whole.subset(range(a, b)) for a, b in pairwise(ends)]


def all_errors(
    systems: list[ImitationFlow], motions: list[Demonstrations]
) -> list[tuple[float, float]]:
    """Return the errors of each system on its motion."""
    return [errors(s, m) for s, m in zip(systems, motions, strict=True)]


def errors(system: ImitationFlow, motion: Demonstrations) -> tuple[float, float]:
    """Return mean RMSE and Fréchet distance of the reproductions of a motion's recordings."""
    shown = np.stack(motion.positions)
    made = np.stack(
        [
            system.rollout(p[0], len(p) - 1, h)
            for p, h in zip(motion.positions, motion.dt, strict=True)
        ]
    )
    return float(np.mean(rmse(shown, made))), float(np.mean(frechet(shown, made)))


def stability(system: ImitationFlow, motions: list[Demonstrations]) -> tuple[float, float]:
    """Return the share of the grid round the motions that converged, and the peak speed there."""
    boxes = np.array([motion.bounding_box for motion in motions])
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    starts = start_grid(low, high)
    horizon = HORIZON * max(motion.durations.max() for motion in motions)
    paths = system.rollout(starts, N_SAMPLES, horizon / N_SAMPLES)
    there = converged(paths, system.goal_, convergence_tolerance(low, high))
    peak = np.linalg.norm(system.velocity(starts), axis=1).max()
    return float(np.mean(there)), float(peak / max(motion.peak_speed for motion in motions))


def between(n: int) -> np.ndarray:
    """Return contexts between n unit vectors, shape (contexts, n)."""
    unit = np.eye(n)
    ways = [
        (1 - share) * unit[i] + share * unit[j]
        for i, j in combinations(range(n), 2)
        for share in (0.25, 0.5, 0.75)
    ]
    return np.array([*ways, unit.mean(axis=0)])


def measure(name: str, options: Options) -> None:
    """Learn one set in every way and print a line each."""
    motions, seed = motions_of(name), options.seed
    config = ImitationFlowConfig(n_steps=options.n_steps)
    if options.others:
        began = time.perf_counter()
        # One by one: a batch of motions of different counts is several batches, which say less.
        alone = [ImitationFlow(config).fit(motion, seed=seed) for motion in motions]
        took = time.perf_counter() - began
        seen = [stability(s, [m]) for s, m in zip(alone, motions, strict=True)]
        row(name, "each its own", took, all_errors(alone, motions), seen)
    if options.others and name in PARTS:
        began = time.perf_counter()
        field = ImitationFlow(config).fit(load_lasa(name), seed=seed)
        took = time.perf_counter() - began
        found = all_errors([field] * len(motions), motions)
        row(name, "one field", took, found, [stability(field, motions)])
    settings = replace(config, n_layers=options.n_layers, n_hidden=options.n_hidden)
    began = time.perf_counter()
    model = ConditionalImitationFlow(settings).fit(motions, seed=seed)
    took = time.perf_counter() - began
    fitted = [model.at(context) for context in model.contexts_]
    seen = [stability(s, motions) for s in fitted]
    row(name, "by context", took, all_errors(fitted, motions), seen)
    others = [model.at(context) for context in between(len(motions))]
    row(name, "contexts between", 0.0, [], [stability(s, motions) for s in others])
    kinds = {s.guarantee.kind for s in (*fitted, *others)}
    print(f"{'':16} {len(others)} contexts between; guarantees: {', '.join(sorted(kinds))}\n")


def row(
    name: str,
    way: str,
    seconds: float,
    found: list[tuple[float, float]],
    seen: list[tuple[float, float]],
) -> None:
    """Print errors, their worst, and the stability of all systems of a way."""
    shares, peaks = np.array(seen).T
    cells = f"{'':6} {'':8} {'':6}"
    if found:
        means = np.mean(found, axis=0)
        cells = "{:6.2f} {:8.2f} {:6.2f}".format(*means, max(f for _, f in found))
    took = f"{seconds:4.0f}" if seconds else ""
    print(
        f"{name:16} {way:17} {cells} {shares.min():9.3f} {peaks.mean():6.1f} {peaks.max():6.1f} "
        f"{took:>5}",
        flush=True,
    )


def main() -> None:
    """Measure every set."""
    options = tyro.cli(Options, description=__doc__)
    torch.set_num_threads(1)
    print(
        f"{'set':16} {'way':17} {'RMSE':>6} {'Fréchet':>8} {'worst':>6} {'converged':>9} "
        f"{'peak':>6} {'worst':>6} {'s':>5}"
    )
    for name in options.sets:
        measure(name, options)


if __name__ == "__main__":
    main()
