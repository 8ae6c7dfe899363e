"""How near the motion of a cyclic system is to the demonstrated cycle, in place and in time.

The definitions are those of the table of limit cycles in METRICS.md. The demonstrations' orbit is
the set of their samples, shape (M, d); the steady orbit is what a rollout does in its last two
periods, shape (T, d). A rollout with a sample that is not finite scores infinity; nothing warns.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from iflow_gym.metrics._validation import (
    BoolArray,
    FloatArray,
    as_rollouts,
    finite_throughout,
    positive,
)

PERIODS = 8
"""Length of a rollout, in periods of the demonstrations."""
STEADY_PERIODS = 2
"""Periods at its end that are the steady orbit."""
ATTRACTION_TOLERANCE = 0.05
"""Distance from the orbit that counts as being on it, as a fraction of the box's diagonal."""
FIRST_PEAK = 0.9
"""A peak of the autocorrelation counts from this fraction of the highest one on."""
LEAST_PEAK = 0.5
"""A peak near the period that is known counts from this fraction of the highest one on."""
AT_REST = 1e-6
"""A signal with a smaller deviation than this fraction of the orbit's size has no period."""


def orbit_distance(orbit: ArrayLike, demonstrations: ArrayLike) -> float:
    r"""Mean distance to the nearest sample, of the orbit's to the demonstrations' and back.

    .. math:: \frac12 \Big( \operatorname{mean}_{x \in O} \min_{y \in D} \lVert x - y \rVert
        + \operatorname{mean}_{y \in D} \min_{x \in O} \lVert x - y \rVert \Big)

    Parameters
    ----------
    orbit
        Samples of the steady orbit O, shape (T, d), in units of length.
    demonstrations
        Samples of the demonstrations D, shape (M, d).

    Returns
    -------
    float
        In units of length; infinity if the orbit is not finite.

    Raises
    ------
    ValueError
        If shapes do not fit, or the demonstrations are not finite.
    """
    distances = _nearest(orbit, demonstrations)
    return np.inf if distances is None else float(np.mean([d.mean() for d in distances]))


def orbit_hausdorff(orbit: ArrayLike, demonstrations: ArrayLike) -> float:
    r"""Hausdorff distance between the orbit's and the demonstrations' samples.

    .. math:: \max \Big( \max_{x \in O} \min_{y \in D} \lVert x - y \rVert, \;
        \max_{y \in D} \min_{x \in O} \lVert x - y \rVert \Big)

    Demonstrations that differ among themselves have no orbit at distance 0: half of their greatest
    spread is the least there is.

    Parameters
    ----------
    orbit, demonstrations
        As in ``orbit_distance``, whose errors are raised.

    Returns
    -------
    float
        In units of length; infinity if the orbit is not finite.
    """
    distances = _nearest(orbit, demonstrations)
    return np.inf if distances is None else float(max(d.max() for d in distances))


def period(
    trajectory: ArrayLike,
    dt: float,
    *,
    size: float | None = None,
    about: float | None = None,
) -> float:
    r"""Period of a trajectory by its autocorrelation.

    With the mean taken off, the autocorrelation at lag k is normalised by the energy of both
    stretches, so that it is 1 where the motion repeats exactly whatever its amplitude does,

    .. math:: r_k = \frac{2 \sum_t \langle x_t, x_{t+k} \rangle}
        {\sum_t \lVert x_t \rVert^2 + \sum_t \lVert x_{t+k} \rVert^2}, \quad t = 0 .. T - 1 - k.

    The period is the lag of the first local maximum that reaches 0.9 of the highest one, among lags
    that leave a third of the trajectory to compare, refined by a parabola through its neighbours. A
    single first peak would take two strokes, there and back on ways close to each other, for two
    rounds. A person's rounds differ in tempo, and two rounds later a recording may be nearer to
    itself than one round later: `about` says which peaks are meant.

    Parameters
    ----------
    trajectory
        Shape (T, d); two periods are the least that shows one.
    dt
        Time between samples, in s.
    size
        Of the demonstrations, in units of length: a trajectory that deviates from its mean by less
        than a millionth of it is at rest. By default only what is exactly constant is.
    about
        Where given, in s: the highest of the peaks between 2/3 and 3/2 of it is taken, unless a
        shorter one reaches 0.9 of it (what turns several times meanwhile is no slower for it), or
        it is below half of the highest of all.

    Returns
    -------
    float
        In s; infinity for a trajectory at rest, without a peak, or not finite.

    Raises
    ------
    ValueError
        If the shape is no (T, d), or dt is not positive.
    """
    x = as_rollouts(np.asarray(trajectory, dtype=np.float64)[None])[0]
    step = positive(dt, "dt")
    if not np.isfinite(x).all():
        return np.inf
    x = x - x.mean(axis=0)
    energy = np.square(x).sum(axis=1)
    if np.sqrt(energy.max()) <= AT_REST * (size or 0.0):
        return np.inf
    n = len(x)
    n_lags = 2 * n // 3
    width = 2 ** int(np.ceil(np.log2(2 * n)))
    spectrum = np.fft.rfft(x, width, axis=0)
    products = np.fft.irfft((np.abs(spectrum) ** 2).sum(axis=1), width)[:n_lags]
    total = np.concatenate([[0.0], np.cumsum(energy)])
    lags = np.arange(n_lags)
    both = total[n - lags] + total[n] - total[lags]
    r = 2 * products / np.where(both > 0, both, 1.0)
    peaks = 1 + np.flatnonzero((r[1:-1] > r[:-2]) & (r[1:-1] >= r[2:]) & (r[1:-1] > 0))
    if len(peaks) == 0:
        return np.inf
    highest = r[peaks].max()
    if about is not None:
        ratio = peaks * step / positive(about, "about")
        near = peaks[(ratio >= 2 / 3) & (ratio <= 3 / 2)]
        if len(near) and (meant := r[near].max()) >= LEAST_PEAK * highest:
            peaks, highest = peaks[peaks <= near[r[near].argmax()]], meant
    k = int(peaks[r[peaks] >= FIRST_PEAK * highest][0])
    before, here, after = r[k - 1 : k + 2]
    bend = before - 2 * here + after
    return float(k + (0.5 * (before - after) / bend if bend < 0 else 0.0)) * step


def period_error(found: float, demonstrated: float) -> float:
    r"""Error of a period, relative to the demonstrations'.

    .. math:: \lvert \hat T - T \rvert / T

    Parameters
    ----------
    found, demonstrated
        Periods in s, as ``period`` gives them; the found one may be infinite.

    Returns
    -------
    float
        1 means twice as slow; infinity where nothing repeats.

    Raises
    ------
    ValueError
        If the demonstrated period is not finite and positive.
    """
    true = positive(demonstrated, "period")
    return float(abs(found - true) / true)


def phase_rmse(orbit: ArrayLike, demonstration: ArrayLike) -> float:
    r"""RMSE against a round of the demonstration, at the best shift in time.

    .. math:: \min_s \sqrt{\operatorname{mean}_t \lVert o_{t+s} - x_t \rVert^2}

    Parameters
    ----------
    orbit
        The steady orbit, shape (T, d), at the demonstration's sample time: two periods, so that
        every shift of a round lies in it.
    demonstration
        One round, shape (N, d), N <= T.

    Returns
    -------
    float
        In units of length; infinity if the orbit is not finite.

    Raises
    ------
    ValueError
        If shapes do not fit, the round is longer than the orbit, or not finite.
    """
    made, shown = _pair(orbit, demonstration)
    n, m = len(made), len(shown)
    if m > n:
        raise ValueError(
            f"Expected an orbit of at least the {m} samples of the round, got {n}: pass two periods"
        )
    if not np.isfinite(made).all():
        return np.inf
    # |o - x|^2 = |o|^2 + |x|^2 - 2 <o, x>, the last for all shifts at once; about the round's mean,
    # so that little cancels.
    centre = shown.mean(axis=0)
    made, shown = made - centre, shown - centre
    total = np.concatenate([[0.0], np.cumsum(np.square(made).sum(axis=1))])
    crossed = sum(np.correlate(made[:, k], shown[:, k], "valid") for k in range(made.shape[1]))
    squares = total[m:] - total[: n - m + 1] + np.square(shown).sum() - 2 * crossed
    best = int(np.argmin(squares))
    return float(np.sqrt(np.square(made[best : best + m] - shown).sum(axis=1).mean()))


def attracted(
    trajectories: ArrayLike, demonstrations: ArrayLike, tolerance: float, n_samples: int
) -> BoolArray:
    """Which rollouts stay near the demonstrations' orbit over their last period.

    Parameters
    ----------
    trajectories
        Rollouts, shape (n, T, d), in units of length.
    demonstrations
        Samples of the demonstrations, shape (M, d).
    tolerance
        In units of length; the suite's is 5 % of the box's diagonal.
    n_samples
        Samples of the last period.

    Returns
    -------
    array of shape (n,)
        False as well for a rollout with a sample anywhere that is not finite. A rollout that stands
        still on the orbit is attracted: that it does not go round is the period's error.

    Raises
    ------
    ValueError
        If shapes do not fit, the tolerance is not positive, or there are fewer samples.
    """
    rollouts = as_rollouts(trajectories)
    limit = positive(tolerance, "tolerance")
    if not 1 <= n_samples <= rollouts.shape[1]:
        raise ValueError(
            f"Expected n_samples from 1 to the {rollouts.shape[1]} of the rollouts, got {n_samples}"
        )
    finite = finite_throughout(rollouts)
    last = np.where(finite[:, None, None], rollouts[:, -n_samples:], 0.0)
    flat, shown = _pair(last.reshape(-1, rollouts.shape[2]), demonstrations)
    distances = np.asarray(cKDTree(shown).query(flat)[0]).reshape(last.shape[:2])
    return np.asarray((distances <= limit).all(axis=1) & finite)


def _nearest(orbit: ArrayLike, demonstrations: ArrayLike) -> tuple[FloatArray, FloatArray] | None:
    """Return the distances to the nearest sample, both ways; None if the orbit is not finite."""
    made, shown = _pair(orbit, demonstrations)
    if not np.isfinite(made).all():
        return None
    return np.asarray(cKDTree(shown).query(made)[0]), np.asarray(cKDTree(made).query(shown)[0])


def _pair(orbit: ArrayLike, demonstrations: ArrayLike) -> tuple[FloatArray, FloatArray]:
    made = np.asarray(orbit, dtype=np.float64)
    shown = np.asarray(demonstrations, dtype=np.float64)
    if made.ndim != 2 or shown.ndim != 2 or 0 in made.shape or 0 in shown.shape:
        raise ValueError(
            f"Expected an orbit (T, d) and demonstrations (M, d), got {made.shape} and "
            f"{shown.shape}"
        )
    if made.shape[1] != shown.shape[1]:
        raise ValueError(
            f"Expected samples of one dimension, got {made.shape[1]} and {shown.shape[1]}"
        )
    if not np.isfinite(shown).all():
        raise ValueError(
            "Expected finite demonstrations, got nan or infinity: the arguments are (orbit, "
            "demonstrations), in this order"
        )
    return made, shown
