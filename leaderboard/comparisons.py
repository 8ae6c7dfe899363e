"""Statistics of a board: which competitors can be told apart, on the metric it is known by."""

from __future__ import annotations

import itertools
import math

import numpy as np
from board import MAIN, Board, Row, common_ground

from iflow_gym.metrics import get_metric
from iflow_gym.statistics import (
    Improvement,
    Profile,
    RankComparison,
    compare_ranks,
    performance_profile,
    probability_of_improvement,
)

FEWEST_ENVIRONMENTS = 10
"""Below this the tests of ranks, which are asymptotic, are not made (Demšar 2006, sec. 3.2.2)."""

N_THRESHOLDS = 80
"""Points of a profile."""


def compared(board: Board) -> list[Row]:
    """Return the competitors that the main metric applies to, failed ones included."""
    metric = MAIN[board.motion]
    return [row for row in board.competitors if row.applies(metric) or not row.n_scored]


def ranked(board: Board) -> tuple[list[Row], list[str]]:
    """Return those of `compared` whose ranks are tested, and the environments that all were run on.

    A cell that was never run says nothing of a method, and is no defeat.
    """
    return common_ground(compared(board))


def rank_comparison(board: Board) -> RankComparison | None:
    """Return Friedman's and Nemenyi's tests by the main metric; a block is an environment.

    Of the methods and environments of `ranked`. A score of a block is the mean over the seeds, so
    that seeds do not count as data sets of their own. None below `FEWEST_ENVIRONMENTS`, or three
    methods.
    """
    metric = MAIN[board.motion]
    rows, ground = ranked(board)
    if len(ground) < FEWEST_ENVIRONMENTS or len(rows) < 3:
        return None
    scores = np.stack([row.run_means(metric, ground) for row in rows])
    return compare_ranks(scores, get_metric(metric).better)


def improvements(board: Board) -> dict[tuple[str, str], Improvement]:
    """Return how likely each competitor is better than each other by the main metric.

    Over the environments and seeds that were run: a failed cell is the worst, one that was never
    run says nothing. A pair that was never run on the same environment is left out.
    """
    metric = MAIN[board.motion]
    scores = {row.method: row.run_scores(metric) for row in compared(board)}
    found = {}
    for one, other in itertools.permutations(scores, 2):
        shared = [e for e in scores[one] if e in scores[other]]
        if shared:
            found[one, other] = probability_of_improvement(
                [scores[one][e] for e in shared],
                [scores[other][e] for e in shared],
                get_metric(metric).better,
            )
    return found


def profiles(board: Board) -> dict[str, Profile]:
    """Return the distributions of all fitted methods' scores by the main metric.

    Of the cells that were run; none where fewer than two environments were.
    Thresholds span the finite scores, evenly on a logarithmic scale where all are positive and the
    metric is an error, and else evenly.
    """
    metric = MAIN[board.motion]
    rows = [row for row in board.methods if row.applies(metric)]
    if len({environment for row in rows for environment, _ in row.cells}) < 2:
        return {}
    scores = {row.method: list(row.run_scores(metric).values()) for row in rows}
    pooled = np.concatenate([np.concatenate(own) for own in scores.values()])
    finite = pooled[np.isfinite(pooled)]
    better = get_metric(metric).better
    if better == "lower" and (finite > 0).all() and len(finite):
        low, high = math.log(float(finite.min())), math.log(float(finite.max()))
        at = np.exp(np.linspace(low - 0.03 * (high - low), high, N_THRESHOLDS))
        at[-1] = max(at[-1], finite.max())
    else:
        at = np.linspace(0.0, float(finite.max(initial=1.0)), N_THRESHOLDS)
    return {name: performance_profile(own, at, better) for name, own in scores.items()}


def is_logarithmic(found: dict[str, Profile]) -> bool:
    """Whether profiles' thresholds are evenly spaced on a logarithmic scale."""
    return all(profile.thresholds[0] > 0 for profile in found.values())
