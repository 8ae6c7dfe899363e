"""Scores of motions that end at a goal."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from iflow_gym import metrics
from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.envs.task import PointMassInterface
from iflow_gym.evaluation.common import PerDemonstration, Scores, each
from iflow_gym.evaluation.rollouts import (
    rollouts_from_starts,
    scored_box,
    stability_rollouts,
)


def accuracy(
    policy: Any, task: PointMassInterface, scored: Demonstrations, indices: Sequence[int]
) -> PerDemonstration:
    """Return the scores of rollouts from each scored demonstration's start."""
    n_steps = max(len(p) for p in scored.positions) - 1
    paths = rollouts_from_starts(policy, task, indices, n_steps)
    made = [path[: len(p)] for path, p in zip(paths, scored.positions, strict=True)]
    return trajectory_scores(scored.positions, made)


def trajectory_scores(
    demonstrated: Sequence[FloatArray], made: Sequence[FloatArray]
) -> PerDemonstration:
    """Return RMSE, Fréchet distance, DTW and swept area of each pair of trajectories.

    Parameters
    ----------
    demonstrated, made : sequences of n arrays, shape (T_i, d)
        What was shown, and what was made of it, in units of length.

    Returns
    -------
    dict
        Name of the metric to n values; the area has a name in 2-D and another in 3-D.
    """
    functions: dict[str, Callable[[Any, Any], Any]] = {
        "rmse": metrics.rmse,
        "frechet": metrics.frechet,
        "dtw": metrics.dtw,
    }
    if demonstrated[0].shape[1] == 2:
        functions["swept_area"] = metrics.swept_area
    if demonstrated[0].shape[1] == 3:
        functions["swept_surface"] = metrics.swept_surface
    return {name: each(f, demonstrated, made) for name, f in functions.items()}


def stability(
    policy: Any, task: PointMassInterface, indices: Sequence[int], push_seeds: Sequence[int]
) -> tuple[Scores, list[float | None]]:
    """Return the scores of rollouts from the grid, and whether each pushed one converged."""
    demos = task.demonstrations
    low, high = scored_box(demos)
    goal = demos.attractor
    n_steps = math.ceil(metrics.HORIZON * float(demos.durations.max()) / demos.mean_dt)
    free_paths, pushed_paths = stability_rollouts(policy, task, indices, push_seeds, n_steps)
    tolerance = metrics.convergence_tolerance(low, high)
    duration = float(demos.durations.mean())
    gone = metrics.diverged(free_paths, low, high)
    found: Scores = {
        "converged": metrics.fraction(metrics.converged(free_paths, goal, tolerance)),
        "settling_time": metrics.settling_time(
            free_paths, goal, tolerance, demos.mean_dt, duration
        ),
        # A rollout that leaves ends at the environment's wall, which is no attractor of the method.
        "spurious_attractors": float(
            metrics.spurious_attractors(free_paths[~gone], goal, tolerance) if not gone.all() else 0
        ),
        "diverged": metrics.fraction(gone),
    }
    recovered = metrics.converged(pushed_paths, goal, tolerance)
    return found, [float(r) for r in recovered]
