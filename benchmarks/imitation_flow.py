"""ImitationFlow on LASA-26 in one run: accuracy, seconds, numerics and calm, on one thread.

    python benchmarks/imitation_flow.py [--protocol generalisation] [--seeds 0 1 2] [--n-steps 2000]

Rollouts here are the closed form (`rollout`); the leaderboard's are stepped in the environment.
Inverse error is the worst |h(h^-1(y)) - y| over a 16 x 16 grid on twice the demonstrations' box, as
a fraction of the box's diagonal; calm is the peak speed on that grid over the demonstrations' peak,
and fine is that on 160 x 160 states. Rounds are those of training that a shape needed to be calm.
"""

import time
from dataclasses import dataclass

import numpy as np
import torch
import tyro

from iflow_gym.baselines.imitation_flow import ImitationFlow, kernels
from iflow_gym.baselines.imitation_flow.config import ENDS
from iflow_gym.datasets.lasa import SINGLE_MOTIONS, load_lasa
from iflow_gym.metrics import box_diagonal, dtw, frechet, rmse, start_grid


@dataclass(frozen=True)
class Options:
    """What to measure."""

    protocol: str = "reproduction"
    """Or "generalisation"."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of the fits, one run of all shapes each."""
    n_steps: tuple[int, ...] = (ENDS.n_steps,)
    """Steps of training; several give the curve of accuracy against seconds."""
    calm: bool = True
    """False leaves the calm penalty out, for comparison."""
    n_jobs: int = 1
    """Processes that all shapes are dealt out to."""
    alone: tuple[str, ...] = ()
    """Shapes to fit instead, one after the other: the seconds are those of one fit."""


FINE = 160
"""States along an axis of the finer grid."""

LINE = "{:18} {:6.2f} {:8.2f} {:6.2f} {:6.1f} {:6.1f}  {:.1e} {:.1e}"


def fastest(system: ImitationFlow, points: np.ndarray) -> float:
    """Greatest speed at points."""
    return float(np.linalg.norm(system.velocity(points), axis=1).max())


def inverse_error(system: ImitationFlow, grid: np.ndarray, dtype: type) -> float:
    """Worst |h(h^-1(y)) - y| in the motion's units, computed in `dtype` throughout."""
    p = {name: array.astype(dtype) for name, array in system._parameters.items()}
    hidden = np.concatenate([p["hidden_weight"], p["hidden_bias"][..., None]], axis=-1)
    one = np.zeros_like(hidden[:, :1])
    one[..., -1] = kernels.SATURATED
    out = np.concatenate([p["out_weight"], p["out_bias"][..., None]], axis=-1)
    bound, n_kept = system.config.log_scale_bound, hidden.shape[-1] - 1
    out[:, : system.n_dims_ - n_kept] /= dtype(bound)
    weights = kernels.Weights(
        p["rotation"], np.concatenate([hidden, one], axis=1), out, n_kept, dtype(bound)
    )
    y = np.ascontiguousarray(((grid - system.goal_) @ system._inverse_frame.T).T, dtype=dtype)
    z = kernels.inverse(np, y, None, weights)[0]
    back = kernels.forward(np, z, None, weights)[0]
    return float(np.linalg.norm(system._frame @ (back - y), axis=0).max())


def measure(options: Options, seed: int, n_steps: int) -> None:
    """Fit all shapes together and print a line a shape."""
    motions = [load_lasa(shape) for shape in options.alone or SINGLE_MOTIONS]
    splits = [motion.split(options.protocol) for motion in motions]
    settings = {} if options.calm else {"calm_weight": 0.0}
    method = ImitationFlow(n_steps=n_steps, n_jobs=options.n_jobs, **settings)
    began, cpu = time.perf_counter(), time.process_time()
    if options.alone:
        systems = [ImitationFlow(method.config).fit(s.fit, seed=seed) for s in splits]
    else:
        systems = method.fit_many([s.fit for s in splits], seeds=[seed] * len(motions))
    seconds, cpu = time.perf_counter() - began, time.process_time() - cpu
    print(
        f"{'shape':18} {'RMSE':>6} {'Fréchet':>8} {'DTW':>6} {'calm':>6} {'fine':>6}  "
        "inverse error f32, f64, rounds"
    )
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
        fine = start_grid(low, high, FINE)
        diagonal = box_diagonal(low, high)
        row = [float(np.mean(metric(shown, made))) for metric in (rmse, frechet, dtw)] + [
            *(fastest(system, points) / motion.peak_speed for points in (grid, fine)),
            inverse_error(system, grid, np.float32) / diagonal,
            inverse_error(system, grid, np.float64) / diagonal,
        ]
        rows.append(row)
        rounds = system.calm_.rounds if system.calm_ else 0
        print(f"{LINE}  {rounds}".format(motion.name[5:], *row))
    table = np.array(rows)
    print(LINE.format("mean", *table.mean(0)))
    print(LINE.format("worst", *table.max(0)))
    restarts = sum(len(system.restarts_) for system in systems)
    print(
        f"{len(motions)} shapes, {options.protocol}, seed {seed}, {n_steps} steps: {seconds:.0f} s "
        f"({cpu:.0f} s of CPU) in {options.n_jobs} processes, {restarts} restarts\n",
        flush=True,
    )


def main() -> None:
    """Measure every combination of seeds and steps."""
    options = tyro.cli(Options, description=__doc__)
    torch.set_num_threads(1)
    for n_steps in options.n_steps:
        for seed in options.seeds:
            measure(options, seed, n_steps)


if __name__ == "__main__":
    main()
