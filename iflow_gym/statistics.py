"""Whether one method is better than another, and by how much one may trust that.

Scores belong to cells: environments x seeds. The environments are the data sets of these
statistics; the seeds of one environment are repetitions on it, and never count as data sets of
their own. A cell that failed is nan: it is worse than every score, infinite ones too, ties with
other failed cells, and is never dropped.

References
----------
- R. Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice", NeurIPS
  2021: probability of improvement, score distributions, the bootstrap stratified by environment.
- J. Demšar, "Statistical comparisons of classifiers over multiple data sets", JMLR 7, 2006:
  Friedman's test, Nemenyi's critical difference, its diagram.
- E. D. Dolan and J. J. Moré, "Benchmarking optimization software with performance profiles",
  Mathematical Programming 91, 2002.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import chi2, rankdata, studentized_range

FloatArray: TypeAlias = NDArray[np.float64]
Better: TypeAlias = Literal["lower", "higher"]
Interval: TypeAlias = tuple[float, float]
Resampled: TypeAlias = Literal["seeds", "environments", "nothing"]
Strata: TypeAlias = Sequence[ArrayLike]
"""Scores of one method, shape (S_e,) for each environment e; an array (E, S) is one, too."""

N_RESAMPLES = 2000
CONFIDENCE = 0.95
SEED = 0


# Two methods --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Improvement:
    """How likely one method is better than another."""

    probability: float
    """Mean over the environments of P(X better than Y) + P(X as good as Y) / 2, in [0, 1]."""
    interval: Interval
    """Bootstrap interval of it; (nan, nan) where there is nothing to resample."""
    resampled: Resampled
    """What was drawn with replacement."""
    n_environments: int
    """Environments that the mean is over."""


def probability_of_improvement(
    x: Strata,
    y: Strata,
    better: Better,
    *,
    n_resamples: int = N_RESAMPLES,
    confidence: float = CONFIDENCE,
    seed: int = SEED,
) -> Improvement:
    r"""Probability that a run of X is better than a run of Y on an environment drawn at random.

    .. math:: P(X > Y) = \frac{1}{E} \sum_e \frac{1}{S_e T_e} \sum_{i,j} w(x_{ei}, y_{ej})

    with w = 1 where x is better, 1/2 where they are equal, 0 where y is better: Mann and Whitney's
    U of each environment over its greatest value.

    Parameters
    ----------
    x, y
        Scores of the two methods on the same environments in the same order: shape (S_e,) and
        (T_e,) for environment e. nan is a cell that failed.
    better
        Whether lower or higher scores are better.
    n_resamples, confidence, seed
        Of the bootstrap.

    Returns
    -------
    Improvement
        The percentile interval resamples the seeds of either method within each environment; where
        neither has more than one seed anywhere, it resamples the environments instead. The two are
        uncertainties about different things, and ``resampled`` says which.

    Raises
    ------
    ValueError
        If there are no environments, another number of them for x than for y, an environment
        without a cell, or parameters out of their range.

    Notes
    -----
    Agarwal et al. 2021, appendix A.3 and section 4.3; the ties' half is theirs.
    """
    _check_bootstrap(n_resamples, confidence)
    ours, theirs = _costs(x, better), _costs(y, better)
    if len(ours) != len(theirs):
        raise ValueError(
            f"Expected scores on the same environments, got {len(ours)} and {len(theirs)}"
        )
    wins = [_wins(a, b) for a, b in zip(ours, theirs, strict=True)]
    each = np.array([w.mean() for w in wins])
    rng = np.random.default_rng(seed)
    resampled: Resampled = "seeds"
    if all(w.size == 1 for w in wins):
        resampled = "environments" if len(wins) > 1 else "nothing"
        draws = _weights(rng, n_resamples, len(wins)) @ each
    else:
        draws = np.zeros(n_resamples)
        for w in wins:
            rows, columns = (_weights(rng, n_resamples, n) for n in w.shape)
            draws += np.einsum("ri,ij,rj->r", rows, w, columns) / len(wins)
    interval = (np.nan, np.nan) if resampled == "nothing" else _percentiles(draws, confidence)
    return Improvement(float(each.mean()), interval, resampled, len(wins))


def _wins(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return 1 where x costs less than y, 1/2 where as much, shape (len(x), len(y))."""
    better, equal = x[:, None] < y, x[:, None] == y
    return np.asarray(better + 0.5 * equal, dtype=np.float64)


# Many methods -------------------------------------------------------------------------------


@dataclass(frozen=True)
class RankComparison:
    """Friedman's test of many methods on many environments, and Nemenyi's after it."""

    mean_ranks: FloatArray
    """Mean over the environments of each method's rank, shape (M,); 1 is best."""
    n_environments: int
    """Blocks of the test."""
    statistic: float
    """Friedman's chi squared, corrected for ties; nan where every method ties everywhere."""
    p_value: float
    """Of there being no difference between the methods, by chi squared with M - 1 degrees."""
    alpha: float
    critical_difference: float
    """Mean ranks that are further apart differ at the level alpha, by Nemenyi's test."""
    groups: tuple[tuple[int, ...], ...]
    """Largest sets of methods, best first, that the test cannot tell apart; of two or more."""


def compare_ranks(scores: ArrayLike, better: Better, *, alpha: float = 0.05) -> RankComparison:
    r"""Compare methods by their ranks on many environments.

    .. math:: CD = q_\alpha \sqrt{\frac{M (M + 1)}{6 E}}

    Parameters
    ----------
    scores
        Methods x environments, shape (M, E): one number for an environment, so average over seeds
        first. nan is a cell that failed; it ranks last.
    better
        Whether lower or higher scores are better.
    alpha
        Level of Nemenyi's test, in (0, 1).

    Raises
    ------
    ValueError
        If the shape is another, there are fewer than two methods or environments, or alpha is out
        of its range.

    Notes
    -----
    Demšar 2006, section 3.2.2. Both tests are asymptotic: he asks for more than ten environments
    and more than five methods. Nemenyi's controls the error over all pairs, and is conservative.
    """
    values = np.asarray(scores, dtype=np.float64)
    if values.ndim != 2 or min(values.shape) < 2:
        raise ValueError(
            "Expected scores of shape (methods, environments), at least two of either, got "
            f"{values.shape}"
        )
    if not 0 < alpha < 1:
        raise ValueError(f"Expected alpha in (0, 1), got {alpha}")
    ranks = np.stack([_ranks(column) for column in _as_costs(values, better).T], axis=1)
    n_methods, n_environments = ranks.shape
    means = ranks.mean(axis=1)
    # Friedman's statistic as a ratio of variances is right with ties as it is.
    middle = (n_methods + 1) / 2
    spread = ((ranks - middle) ** 2).sum() / (n_environments * (n_methods - 1))
    statistic = n_environments * ((means - middle) ** 2).sum() / spread if spread else np.nan
    p_value = float(chi2.sf(statistic, n_methods - 1)) if spread else 1.0
    difference = nemenyi_quantile(n_methods, alpha) * np.sqrt(
        n_methods * (n_methods + 1) / (6 * n_environments)
    )
    return RankComparison(
        mean_ranks=means,
        n_environments=n_environments,
        statistic=float(statistic),
        p_value=p_value,
        alpha=alpha,
        critical_difference=float(difference),
        groups=_groups(means, float(difference)),
    )


@functools.cache
def nemenyi_quantile(n_methods: int, alpha: float) -> float:
    """Return q_alpha: the studentized range's quantile of infinite degrees of freedom, over √2."""
    return float(studentized_range.ppf(1 - alpha, n_methods, np.inf)) / float(np.sqrt(2))


def _groups(means: FloatArray, difference: float) -> tuple[tuple[int, ...], ...]:
    """Return the largest runs of methods, by mean rank, whose ends are within a difference."""
    order = [int(i) for i in np.argsort(means, kind="stable")]
    found: list[tuple[int, ...]] = []
    reached = 0
    for first in range(len(order)):
        last = first
        while last + 1 < len(order) and means[order[last + 1]] - means[order[first]] <= difference:
            last += 1
        if last > first and last + 1 > reached:
            found.append(tuple(order[first : last + 1]))
            reached = last + 1
    return tuple(found)


# Distributions ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Profile:
    """Fraction of a method's cells that reach each threshold."""

    thresholds: FloatArray
    """Shape (T,), in the scores' unit."""
    fraction: FloatArray
    """Of the cells whose score is as good as the threshold or better, shape (T,), in [0, 1]."""
    low: FloatArray
    """Lower ends of the pointwise bootstrap intervals, shape (T,)."""
    high: FloatArray
    """Upper ends."""
    resampled: Resampled
    """What was drawn with replacement."""


def performance_profile(
    scores: Strata,
    thresholds: ArrayLike,
    better: Better,
    *,
    n_resamples: int = N_RESAMPLES,
    confidence: float = CONFIDENCE,
    seed: int = SEED,
) -> Profile:
    r"""Distribution of a method's scores over all its cells.

    .. math:: \hat F(\tau) = \frac{1}{E} \sum_e \frac{1}{S_e} \sum_i
        \mathbb{1}[s_{ei} \text{ as good as } \tau]

    Parameters
    ----------
    scores
        Shape (S_e,) for each environment. A cell that failed is nan and reaches no threshold.
    thresholds
        Shape (T,), in the scores' unit.
    better
        Whether lower or higher scores are better.
    n_resamples, confidence, seed
        Of the bootstrap, stratified as in `probability_of_improvement`.

    Raises
    ------
    ValueError
        If a shape is another, or a parameter is out of its range.

    Notes
    -----
    Run-score distributions, Agarwal et al. 2021, section 4.2, here "as good as" in place of "better
    than" so that 0 can be reached. Dolan and Moré's profiles are of ratios to the best method on
    each problem; they change with every method that is added, and these do not.
    """
    _check_bootstrap(n_resamples, confidence)
    at = np.asarray(thresholds, dtype=np.float64)
    if at.ndim != 1 or not len(at) or np.isnan(at).any():
        raise ValueError(f"Expected thresholds of shape (T,), without nan, got shape {at.shape}")
    strata = _raw(scores)
    reached = [
        (stratum[:, None] <= at) if better == "lower" else (stratum[:, None] >= at)
        for stratum in strata
    ]  # nan compares as False
    each = np.stack([r.mean(axis=0) for r in reached])
    rng = np.random.default_rng(seed)
    resampled: Resampled = "seeds"
    if all(len(r) == 1 for r in reached):
        resampled = "environments" if len(reached) > 1 else "nothing"
        draws = _weights(rng, n_resamples, len(reached)) @ each
    else:
        draws = sum(
            (_weights(rng, n_resamples, len(r)) @ r for r in reached),
            start=np.zeros((n_resamples, len(at))),
        ) / len(reached)
    # Shares, whose sums some processors round to a little more than 1.
    draws = np.round(draws, 12)
    low, high = np.quantile(draws, [(1 - confidence) / 2, (1 + confidence) / 2], axis=0)
    fraction = each.mean(axis=0)
    if resampled == "nothing":
        low = high = np.full(len(at), np.nan)
    return Profile(at, fraction, low, high, resampled)


# One environment ----------------------------------------------------------------------------


def mean_intervals(
    values: ArrayLike,
    *,
    n_resamples: int = N_RESAMPLES,
    confidence: float = CONFIDENCE,
    seed: int = SEED,
) -> tuple[FloatArray, FloatArray]:
    """Bootstrap intervals of many means over the same number of values.

    Parameters
    ----------
    values
        Shape (K, n): K sets of n values, such as one environment's scores of its demonstrations.
    n_resamples, confidence, seed
        Of the bootstrap. All sets share the draws, so that each interval is what it would be alone.

    Returns
    -------
    low, high
        Shape (K,). nan where a set holds nan, or one value only; a mean that holds an infinity is
        infinite.

    Raises
    ------
    ValueError
        If the shape is another, or a parameter is out of its range.
    """
    _check_bootstrap(n_resamples, confidence)
    sets = np.asarray(values, dtype=np.float64)
    if sets.ndim != 2 or sets.shape[1] < 1:
        raise ValueError(f"Expected values of shape (K, n), got {sets.shape}")
    low, high = np.full((2, len(sets)), np.nan)
    if sets.shape[1] == 1:
        return low, high
    weights = _weights(np.random.default_rng(seed), n_resamples, sets.shape[1])
    for start in range(0, len(sets), 256):  # by the piece: (n_resamples, 256) at a time
        piece = sets[start : start + 256]
        whole = ~np.isnan(piece).any(axis=1)
        finite = np.where(np.isfinite(piece), piece, 0.0)
        draws = weights @ finite.T
        for sign in (-np.inf, np.inf):
            hit = weights @ (piece == sign).T.astype(np.float64) > 0
            draws = np.where(hit, sign, draws)
        tail = (1 - confidence) / 2
        piece_low = np.quantile(draws, tail, axis=0, method="lower")
        piece_high = np.quantile(draws, 1 - tail, axis=0, method="higher")
        low[start : start + 256] = np.where(whole, piece_low, np.nan)
        high[start : start + 256] = np.where(whole, piece_high, np.nan)
    return low, high


# Helpers ------------------------------------------------------------------------------------


def _check_bootstrap(n_resamples: int, confidence: float) -> None:
    if n_resamples < 1 or not 0 < confidence < 1:
        raise ValueError(
            "Expected n_resamples of at least 1 and a confidence in (0, 1), got "
            f"{n_resamples} and {confidence}"
        )


def _raw(scores: Strata) -> list[FloatArray]:
    strata = [np.asarray(stratum, dtype=np.float64) for stratum in scores]
    if not strata or any(stratum.ndim != 1 or not len(stratum) for stratum in strata):
        raise ValueError(
            "Expected scores of shape (S,), at least one, for each of one or more environments, "
            f"got shapes {[stratum.shape for stratum in strata]}"
        )
    return strata


def _as_costs(values: FloatArray, better: Better) -> FloatArray:
    """Return scores where lower is better."""
    if better not in ("lower", "higher"):
        raise ValueError(f'Expected better to be "lower" or "higher", got {better!r}')
    return values if better == "lower" else -values


def _costs(scores: Strata, better: Better) -> list[FloatArray]:
    """Return places in the order of all that can come: failed cells come after infinity."""
    return [_order(_as_costs(stratum, better)) for stratum in _raw(scores)]


def _order(costs: FloatArray) -> FloatArray:
    """Return costs with nan above infinity: largest numbers stand in for both."""
    limits = np.finfo(np.float64)
    clipped = np.clip(costs, np.nextafter(limits.min, 0), np.nextafter(limits.max, 0))
    ordered = np.where(np.isposinf(costs), limits.max, clipped)
    return np.where(np.isnan(costs), np.inf, ordered)


def _ranks(costs: FloatArray) -> FloatArray:
    """Return ranks from 1, ties by their average, nan last."""
    return np.asarray(rankdata(_order(costs)), dtype=np.float64)


def _weights(rng: np.random.Generator, n_resamples: int, n: int) -> FloatArray:
    """Return how often each of n is drawn in n draws with replacement, over n; shape (R, n)."""
    return rng.multinomial(n, np.full(n, 1 / n), size=n_resamples) / n


def _percentiles(draws: FloatArray, confidence: float) -> Interval:
    tail = (1 - confidence) / 2
    return (
        float(np.quantile(draws, tail, method="lower")),
        float(np.quantile(draws, 1 - tail, method="higher")),
    )
