"""Scores of drumming: those of a cycle on the tip that the physics moved, and the hits.

Rollouts are those of `iflow_gym.evaluation.cycles`. The hits of as long as a demonstration lasts
are compared with the score that it implies; those of the whole rollout with the rhythm that all
scored demonstrations have in common.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from iflow_gym import metrics
from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.evaluation import cycles
from iflow_gym.evaluation.common import PerDemonstration, Scores
from iflow_gym.evaluation.rollouts import rollouts, scored_box
from iflow_gym.metrics import drumming as hits
from iflow_gym.metrics.cycles import ATTRACTION_TOLERANCE, PERIODS
from iflow_gym.metrics.stability import PERTURBATION_SIZE, PERTURBATION_TIME

if TYPE_CHECKING:
    from typing import Any

    from iflow_gym.envs.drumming.env import DrummingEnv

STARTS = 100
"""Starts of the grid that the arm can reach; an arm is simulated for each."""

START_PERIODS = 4
"""Length of the rollouts from there, in periods of the demonstrations."""

RECOVERY_PERIODS = 2
"""Periods after a push within which a rollout has to be back on the orbit."""


def accuracy(
    policy: Any, task: DrummingEnv, scored: Demonstrations, indices: Sequence[int]
) -> PerDemonstration:
    """Return the scores of rollouts from each scored demonstration's start."""
    n = cycles.samples(cycles.mean_period(scored), task.dt)
    arms = task.like(len(indices), horizon=PERIODS * n)
    first, _ = arms.reset(seed=0, options={"demonstration": np.array(indices)})
    paths = rollouts(policy, [arms], first, PERIODS * n)
    found = cycles.scores_of(paths, scored)
    targets = np.stack(arms.targets, axis=1)
    rhythm = _rhythm(task, indices)
    period, duration = cycles.mean_period(scored), PERIODS * n * task.dt
    for i, index in enumerate(indices):
        notes = task.score_of(index)
        length = len(task.demonstrations.positions[index])
        played = [hit for hit in arms.hits[i] if hit.time <= (length - 1) * task.dt]
        together = (*notes, *_played(played))
        row = {
            "hit_f1": hits.hit_f1(*together),
            "sequence_f1": hits.sequence_f1(*together),
            "rhythm_f1": None
            if rhythm is None
            else hits.rhythm_f1(rhythm, *_played(arms.hits[i]), period, duration),
            "timing_error": hits.timing_error(*together),
            "tempo_error": None
            if rhythm is None
            else hits.tempo_error(*notes, *_played(arms.hits[i])),
            "missed": float(hits.missed(*together)),
            "extra": float(hits.extra(*together)),
            "tracking_rmse": hits.tracking_rmse(targets[i], paths[i, 1:]),
        }
        for name, value in row.items():
            found.setdefault(name, []).append(None if value is None else float(value))
    return found


def stability(
    policy: Any, task: DrummingEnv, indices: Sequence[int], push_seeds: Sequence[int]
) -> tuple[Scores, list[float | None]]:
    """Return the scores of rollouts from reachable starts, and what share of pushes was made up.

    Every scored demonstration's rollout is pushed twice, by a displacement at 40 % of the way and,
    in another rollout, by a force half way; it has two periods to be back, and a third to stay.
    """
    from iflow_gym.envs.drumming.arguments import ForcePush
    from iflow_gym.envs.task import Push

    demos = task.demonstrations
    assert demos.period is not None
    low, high = scored_box(demos)
    shown = np.concatenate(demos.positions)
    n = cycles.samples(demos.period, task.dt)
    tolerance = ATTRACTION_TOLERANCE * metrics.box_diagonal(low, high)
    starts = reachable_starts(task)
    free = task.like(len(starts), horizon=START_PERIODS * n)
    first, _ = free.reset(seed=0, options={"start": starts})
    paths = rollouts(policy, [free], first, START_PERIODS * n)
    found: Scores = {
        "attraction": metrics.fraction(metrics.attracted(paths, shown, tolerance, n)),
        "diverged": metrics.fraction(metrics.diverged(paths, low, high)),
    }
    back = []
    pushes = (Push(PERTURBATION_TIME, PERTURBATION_SIZE), ForcePush())
    for push in pushes:
        lengths = [len(demos.positions[i]) - 1 for i in indices]
        n_steps = round(push.fraction * max(lengths)) + (RECOVERY_PERIODS + 1) * n
        arms = task.like(len(indices), horizon=n_steps, perturbation=push)
        first, _ = arms.reset(seed=list(push_seeds), options={"demonstration": np.array(indices)})
        pushed = rollouts(policy, [arms], first, n_steps)
        back.append(metrics.attracted(pushed, shown, tolerance, n))
    return found, [float(share) for share in np.mean(back, axis=0)]


def reachable_starts(task: DrummingEnv) -> FloatArray:
    """Return up to `STARTS` points of the grid of starts that the arm can reach, evenly taken."""
    low, high = scored_box(task.demonstrations)
    grid = metrics.start_grid(low, high)
    reached = grid[task.like().reachable(grid)]
    chosen = np.linspace(0, len(reached) - 1, min(STARTS, len(reached))).round().astype(int)
    return np.asarray(reached[chosen])


def _rhythm(task: DrummingEnv, indices: Sequence[int]) -> FloatArray | None:
    """Return the demonstrations' common rhythm; None if one has a single round or lacks a drum."""
    try:
        return hits.rhythm([task.score_of(index) for index in indices])
    except ValueError:
        return None


def _played(played: Sequence[hits.Hit]) -> tuple[FloatArray, hits.IntArray]:
    times = np.array([hit.time for hit in played], dtype=np.float64)
    return times, np.array([hit.drum for hit in played], dtype=np.intp)
