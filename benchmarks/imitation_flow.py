"""ImitationFlow on LASA-26 in one run: accuracy, seconds, numerics and calm, on one thread.

    python benchmarks/imitation_flow.py [--protocol generalisation] [--seed 0] [--n-steps 2400]

Rollouts here are the closed form (`rollout`); the leaderboard's are stepped in the environment.
Inverse error is the worst |h(h^-1(y)) - y| over a 16 x 16 grid on twice the demonstrations' box, as
a fraction of the box's diagonal; calm is the peak speed on that grid over the demonstrations' peak.
"""

import time
from dataclasses import dataclass

import numpy as np
import torch
import tyro

from iflow_gym.baselines.imitation_flow import ImitationFlow, ImitationFlowConfig
from iflow_gym.baselines.imitation_flow.field import Layer
from iflow_gym.datasets.lasa import SINGLE_MOTIONS, load_lasa
from iflow_gym.metrics import box_diagonal, dtw, frechet, rmse, start_grid


@dataclass(frozen=True)
class Options:
    """What to measure."""

    protocol: str = "reproduction"
    """Or "generalisation"."""
    seed: int = 0
    """Seed of every fit."""
    n_steps: int = ImitationFlowConfig.n_steps
    """Steps of training."""


def inverse_error(system: ImitationFlow, grid: np.ndarray, dtype: type) -> float:
    """Worst |h(h^-1(y)) - y| in the motion's units, computed in `dtype` throughout."""
    flow = system._flow
    exact = flow.layers
    flow.layers = [Layer(*(a.astype(dtype) for a in layer)) for layer in exact]
    y = ((grid - system.goal_) / system._length).astype(dtype)
    z = flow.inverse(y)[0].astype(dtype)
    error = np.linalg.norm(flow.forward(z) - y, axis=1).max() * system._length
    flow.layers = exact
    return float(error)


def main() -> None:
    """Fit all shapes together and print a line a shape."""
    options = tyro.cli(Options, description=__doc__)
    torch.set_num_threads(1)
    motions = [load_lasa(shape) for shape in SINGLE_MOTIONS]
    splits = [motion.split(options.protocol) for motion in motions]
    began = time.perf_counter()
    systems = ImitationFlow(n_steps=options.n_steps).fit_many(
        [split.fit for split in splits], seeds=[options.seed] * len(motions)
    )
    seconds = time.perf_counter() - began
    print(f"{'shape':18} {'RMSE':>6} {'Fréchet':>8} {'DTW':>6} {'calm':>6}  inverse error f32, f64")
    rows = []
    for motion, split, system in zip(motions, splits, systems, strict=True):
        shown = np.stack(split.score.positions)
        made = np.stack(
            [
                system.rollout(p[0], len(p) - 1, h)
                for p, h in zip(split.score.positions, split.score.dt, strict=True)
            ]
        )
        low, high = motion.bounding_box
        grid = start_grid(low, high)
        diagonal = box_diagonal(low, high)
        row = [float(np.mean(metric(shown, made))) for metric in (rmse, frechet, dtw)] + [
            float(np.linalg.norm(system.velocity(grid), axis=1).max()) / motion.peak_speed,
            inverse_error(system, grid, np.float32) / diagonal,
            inverse_error(system, grid, np.float64) / diagonal,
        ]
        rows.append(row)
        print("{:18} {:6.2f} {:8.2f} {:6.2f} {:6.1f}  {:.1e} {:.1e}".format(motion.name[5:], *row))
    table = np.array(rows)
    print("{:18} {:6.2f} {:8.2f} {:6.2f} {:6.1f}".format("mean", *table.mean(0)[:4]))
    print("{:18} {:6.2f} {:8.2f} {:6.2f} {:6.1f}  {:.1e} {:.1e}".format("worst", *table.max(0)))
    print(f"{len(motions)} shapes fitted in {seconds:.0f} s on one thread, {options}")


if __name__ == "__main__":
    main()
