"""Scores of motions that repeat with a period.

Rollouts last eight periods of the demonstrations. The last two are the steady orbit, and the second
half is what the period is found in.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from iflow_gym import metrics
from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.envs.task import PointMassInterface
from iflow_gym.evaluation.common import PerDemonstration, Scores
from iflow_gym.evaluation.rollouts import (
    rollouts_from_starts,
    scored_box,
    stability_rollouts,
)
from iflow_gym.metrics.cycles import ATTRACTION_TOLERANCE, PERIODS, STEADY_PERIODS
from iflow_gym.metrics.stability import PERTURBATION_TIME

PUSHED_PERIODS = 4
"""Of a longer recording the push comes at 40 % of so many periods: the rollout has eight, and what
is left of them to recover."""

SHOWS_PERIOD = 1.5
"""A recording shows its period if it lasts so many of the set's."""


def accuracy(
    policy: Any, task: PointMassInterface, scored: Demonstrations, indices: Sequence[int]
) -> PerDemonstration:
    """Return the scores of rollouts from each scored demonstration's start.

    The orbit is compared with each demonstration's own samples, as trajectories are, so that the
    number does not grow with how many demonstrations there are. The period is compared with the
    mean of theirs: the tempo of one recording is no property of the motion.
    """
    period = mean_period(scored)
    n_steps = PERIODS * max(samples(period, dt) for dt in scored.dt)
    return scores_of(rollouts_from_starts(policy, task, indices, n_steps), scored)


def scores_of(paths: FloatArray, scored: Demonstrations) -> PerDemonstration:
    """Return the scores of rollouts of eight periods, shape (n, T, d), one a demonstration."""
    size = scored.bounding_box.diagonal
    period = mean_period(scored)
    counts = [samples(period, dt) for dt in scored.dt]
    found: PerDemonstration = {}
    for path, recording, dt, n in zip(paths, scored.positions, scored.dt, counts, strict=True):
        path = path[: PERIODS * n + 1]
        steady = path[-STEADY_PERIODS * n :]
        turned = metrics.period(path[len(path) // 2 :], dt, size=size, about=period)
        rounds = [recording[k : k + n] for k in range(0, len(recording) - n + 1, n)]
        row = {
            "dtw": metrics.dtw(recording[:n], path[:n]),
            "orbit_distance": metrics.orbit_distance(steady, recording),
            "orbit_hausdorff": metrics.orbit_hausdorff(steady, recording),
            "period_error": metrics.period_error(turned, period),
            "phase_rmse": np.mean([metrics.phase_rmse(steady, r) for r in rounds])
            if rounds
            else None,
        }
        for name, value in row.items():
            found.setdefault(name, []).append(None if value is None else float(value))
    return found


def stability(
    policy: Any, task: PointMassInterface, indices: Sequence[int], push_seeds: Sequence[int]
) -> tuple[Scores, list[float | None]]:
    """Return the scores of rollouts from the grid, and whether each pushed one came back."""
    demos = task.demonstrations
    low, high = scored_box(demos)
    assert demos.period is not None
    shown = np.concatenate(demos.positions)
    n = samples(demos.period, demos.mean_dt)
    slowest = max(samples(demos.period, demos.dt[i]) for i in indices)
    longest = max(float(demos.durations[i]) for i in indices)
    push_time = PERTURBATION_TIME * min(1.0, PUSHED_PERIODS * demos.period / longest)
    paths, pushed = stability_rollouts(
        policy, task, indices, push_seeds, PERIODS * max(n, slowest), push_time
    )
    tolerance = ATTRACTION_TOLERANCE * metrics.box_diagonal(low, high)
    found: Scores = {
        "attraction": metrics.fraction(metrics.attracted(paths, shown, tolerance, n)),
        "diverged": metrics.fraction(metrics.diverged(paths, low, high)),
    }
    recovered = metrics.attracted(pushed, shown, tolerance, slowest)
    return found, [float(r) for r in recovered]


def mean_period(demonstrations: Demonstrations) -> float:
    """Return the mean of the recordings' periods in seconds; the set's own for short recordings.

    A recording shows its period if it lasts `SHOWS_PERIOD` of the set's.
    """
    assert demonstrations.period is not None
    found = [
        metrics.period(p, dt, about=demonstrations.period)
        for p, dt in zip(demonstrations.positions, demonstrations.dt, strict=True)
        if len(p) * dt >= SHOWS_PERIOD * demonstrations.period
    ]
    finite = [value for value in found if np.isfinite(value)]
    return float(np.mean(finite)) if finite else demonstrations.period


def samples(period: float, dt: float) -> int:
    """Return how many samples a period has, one at least."""
    return max(1, math.ceil(period / dt))
