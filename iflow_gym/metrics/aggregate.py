"""Many scores as one number, with its uncertainty and the number of scores behind it.

A score belongs to a cell: one method, one environment, one seed. A cell that failed is nan. It is
counted as missing (n of n_expected), ranks last, and is never dropped in silence. A score of
infinity is a score: a mean that holds it is infinite, so that nothing is gained by running away.

References
----------
- R. Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice", NeurIPS
  2021, and its library rliable: the interquartile mean and the bootstrap stratified by environment.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import rankdata

from iflow_gym.metrics._validation import FloatArray

N_RESAMPLES = 10_000
CONFIDENCE = 0.95
SEED = 0

Interval: TypeAlias = tuple[float, float]
Resampled: TypeAlias = Literal["seeds", "environments", "nothing"]
CellScores: TypeAlias = ArrayLike | Mapping[str, ArrayLike]
"""Environments x seeds: an array of shape (E, S), or seeds' scores by environment, which may differ
in number. nan is a cell that failed."""


@dataclass(frozen=True)
class Bootstrap:
    """Confidence intervals of the mean and of the interquartile mean."""

    mean: Interval
    """Of the mean over all cells."""
    iqm: Interval
    """Of the interquartile mean over all cells."""
    resampled: Resampled
    """What was drawn with replacement, and so what the intervals are an uncertainty about."""


@dataclass(frozen=True)
class Aggregate:
    """Scores of one method and one metric over environments and seeds."""

    mean: float
    """Mean over the cells that have a score; nan if none has."""
    iqm: float
    """Interquartile mean over the cells that have a score; nan if none has."""
    mean_interval: Interval
    """95 % stratified bootstrap interval of the mean."""
    iqm_interval: Interval
    """95 % stratified bootstrap interval of the interquartile mean."""
    resampled: Resampled
    """What the bootstrap drew with replacement."""
    n: int
    """Cells that have a score."""
    n_expected: int
    """Cells that should have one."""

    @property
    def complete(self) -> bool:
        """Whether every expected cell has a score."""
        return self.n == self.n_expected

    @property
    def coverage(self) -> str:
        """How many cells are behind the numbers, as "24 of 26"."""
        return f"{self.n} of {self.n_expected}"


def aggregate_scores(scores: CellScores, *, n_expected: int | None = None) -> Aggregate:
    """Aggregate the scores of one method and one metric.

    Parameters
    ----------
    scores
        Environments x seeds, shape (E, S), or a mapping from environment to its seeds' scores. A
        cell that failed is nan.
    n_expected
        Cells that should have a score, where that is more than came, because some were never run;
        None counts those that came, failed ones included.

    Returns
    -------
    Aggregate
        Over the cells that have a score; ``coverage`` belongs beside its numbers.

    Raises
    ------
    ValueError
        If the shape is another, or more cells came than were expected.
    """
    groups = _groups(scores)
    n_cells = sum(len(group) for group in groups)
    if n_expected is None:
        n_expected = n_cells
    if n_expected < n_cells:
        raise ValueError(f"Expected at most {n_expected} cells, got {n_cells}")
    present = np.concatenate([group[~np.isnan(group)] for group in groups])
    intervals = stratified_bootstrap(scores)
    return Aggregate(
        mean=float(_mean(present)) if present.size else np.nan,
        iqm=interquartile_mean(present) if present.size else np.nan,
        mean_interval=intervals.mean,
        iqm_interval=intervals.iqm,
        resampled=intervals.resampled,
        n=present.size,
        n_expected=n_expected,
    )


def interquartile_mean(scores: ArrayLike) -> float:
    r"""Mean of the middle half of the scores: the 25 % trimmed mean.

    .. math:: \frac{1}{N - 2g} \sum_{i=g+1}^{N-g} s_{(i)}, \qquad g = \lfloor N / 4 \rfloor

    Parameters
    ----------
    scores
        Any shape, without nan; all axes are pooled.

    Returns
    -------
    float
        In the scores' unit. Below 4 scores nothing is trimmed and it is the mean.

    Raises
    ------
    ValueError
        If there are no scores, or some are nan: a failed cell must be counted, not averaged.

    Notes
    -----
    Agarwal et al. 2021, section 4.3; equal to ``scipy.stats.trim_mean(scores, 0.25)``, which
    rliable uses. A fraction of a score is not split.
    """
    values = np.asarray(scores, dtype=np.float64).ravel()
    if values.size == 0 or np.isnan(values).any():
        raise ValueError(
            f"Expected scores without nan, got {int(np.isnan(values).sum())} nan of {values.size}: "
            "use aggregate_scores, which counts the failed cells"
        )
    return float(_iqm(values))


def stratified_bootstrap(
    scores: CellScores,
    *,
    n_resamples: int = N_RESAMPLES,
    confidence: float = CONFIDENCE,
    seed: int = SEED,
) -> Bootstrap:
    """Percentile bootstrap intervals of mean and interquartile mean, stratified by environment.

    Each resample draws, for every environment by itself, as many of its seeds with replacement as
    it has, and pools them all: the uncertainty of the seeds on these environments. Where no
    environment has more than one score there is nothing to draw within it; the environments are
    drawn with replacement instead: the uncertainty of the choice of environments, which is usually
    the larger. ``resampled`` says which; the two are not to be compared.

    Parameters
    ----------
    scores
        Environments x seeds, shape (E, S), or a mapping from environment to its seeds' scores. nan
        is a cell that failed: its environment is resampled among the seeds that have a score, and
        one that has none is left out (``aggregate_scores`` counts them).
    n_resamples
        Number of resamples.
    confidence
        Probability that the interval holds, in (0, 1).
    seed
        Of the resampling: the same scores give the same interval.

    Returns
    -------
    Bootstrap
        Intervals of order statistics of the resamples, widened outwards to the next one rather than
        interpolated. (nan, nan) where there is nothing to resample: one score in all, or none.

    Raises
    ------
    ValueError
        If the shape of the scores is another, or a parameter is out of its range.

    Notes
    -----
    Agarwal et al. 2021, section 4.1 (runs resampled within each task).
    """
    if n_resamples < 1 or not 0 < confidence < 1:
        raise ValueError(
            "Expected n_resamples of at least 1 and a confidence in (0, 1), got "
            f"{n_resamples} and {confidence}"
        )
    strata = [group[~np.isnan(group)] for group in _groups(scores)]
    resampled: Resampled = "seeds"
    if all(len(stratum) <= 1 for stratum in strata):
        resampled = "environments"
        strata = [np.concatenate(strata)]
        if strata[0].size <= 1:
            return Bootstrap((np.nan, np.nan), (np.nan, np.nan), "nothing")
    rng = np.random.default_rng(seed)
    samples = np.concatenate(
        [
            stratum[rng.integers(stratum.size, size=(n_resamples, stratum.size))]
            for stratum in strata
            if stratum.size
        ],
        axis=1,
    )

    def interval(statistic: Callable[[FloatArray], FloatArray]) -> Interval:
        values, tail = statistic(samples), (1.0 - confidence) / 2
        return (
            float(np.quantile(values, tail, method="lower")),
            float(np.quantile(values, 1.0 - tail, method="higher")),
        )

    return Bootstrap(mean=interval(_mean), iqm=interval(_iqm), resampled=resampled)


def mean_ranks(scores: ArrayLike, better: Literal["lower", "higher"]) -> FloatArray:
    """Mean over the environments of each method's rank among the methods; 1 is best.

    Parameters
    ----------
    scores
        Methods x environments, shape (M, E); over seeds, average first. A cell that failed is nan.
    better
        Whether lower or higher scores are better, as ``Metric.better`` says.

    Returns
    -------
    array of shape (M,)
        In [1, M]. Ties share the average of their ranks. A failed cell ranks below every score,
        infinite ones too; failed cells tie with each other.

    Raises
    ------
    ValueError
        If the shape is another, or ``better`` neither "lower" nor "higher".
    """
    values = np.asarray(scores, dtype=np.float64)
    if values.ndim != 2 or 0 in values.shape:
        raise ValueError(f"Expected scores of shape (methods, environments), got {values.shape}")
    if better not in ("lower", "higher"):
        raise ValueError(f'Expected better to be "lower" or "higher", got {better!r}')
    if better == "higher":
        values = -values
    failed = np.isnan(values)
    ranks = np.empty_like(values)
    for column, missing, rank in zip(values.T, failed.T, ranks.T, strict=True):
        rank[~missing] = rankdata(column[~missing])
        n_ranked = np.count_nonzero(~missing)
        rank[missing] = (n_ranked + 1 + len(column)) / 2
    return _mean(ranks)


def _groups(scores: CellScores) -> list[FloatArray]:
    """Scores of each environment, in an order that does not depend on a mapping's."""
    if isinstance(scores, Mapping):
        groups = [np.asarray(scores[name], dtype=np.float64) for name in sorted(scores)]
        if not groups or any(group.ndim != 1 for group in groups):
            raise ValueError(
                "Expected a mapping from environment to its seeds' scores of shape (S,), got "
                f"shapes {[group.shape for group in groups]}"
            )
        return groups
    array = np.asarray(scores, dtype=np.float64)
    if array.ndim != 2 or 0 in array.shape:
        raise ValueError(
            f"Expected scores of shape (environments, seeds), got {array.shape}"
            + (": for one seed pass scores[:, None]" if array.ndim == 1 else "")
        )
    return list(array)


def _mean(values: FloatArray) -> FloatArray:
    """Mean over the last axis; nan, without a warning, where both infinities meet."""
    with np.errstate(invalid="ignore", over="ignore"):
        return np.asarray(values.mean(axis=-1))


def _iqm(values: FloatArray) -> FloatArray:
    """Interquartile mean over the last axis."""
    n = values.shape[-1]
    trimmed = n // 4
    return _mean(np.sort(values, axis=-1)[..., trimmed : n - trimmed])
