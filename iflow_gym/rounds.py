"""Rounds of a motion that repeats: where each begins, how long it takes, each sample's phase.

For recordings of cycles as people make them: the tempo drifts, rounds differ, a recording begins
anywhere and ends in the middle of a round. What is compared is the state, position and direction
together. A motion there and back along one line is then one round, not two, and a figure may cross
itself.

1. The lag at which the state recurs gives a first period. Each sample may recur up to `SLACK`
   earlier or later than the lag, so that a drifting tempo does not blur the recurrence; of lags
   that do about equally well the shortest counts, since every multiple of a period is one too.
2. A round that closes well becomes the model of a round. Dynamic programming aligns the whole
   recording with it, monotonically and round after round (dynamic time warping against a closed
   template: Sakoe & Chiba, IEEE T-ASSP 26(1), 1978), and the mean of the rounds aligned so becomes
   the model of the next pass.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter1d, minimum_filter1d

from iflow_gym.demonstrations import FloatArray

SLACK = 0.35
"""How much earlier or later than the mean a sample may recur, as a fraction of the lag."""

LEAST_ROUNDS = 1.3
"""A recording has to be as long as this many rounds: less says too little about its return."""

RECURRENCE = 0.4
"""A state recurs if it comes back to within this distance on average; the spread is 1."""

CANDIDATES = 4
"""So many lags at which the state recurs are tried as the period."""

AS_GOOD = 0.1
"""The shortest counts whose rounds are no further from their mean than by this above the least."""

AWAY = 1.0
"""What recurs has been this far away before, on average."""

SCAN = 1500
"""Samples in which a period is looked for at a time."""

DIRECTION = 0.7
"""Weight of the direction in the state; positions are in units of their spread."""

BINS = 200
"""Phases that a sample is aligned with."""

PER_ROUND = 100
"""About so many samples of a round are aligned; a denser recording is thinned out first."""

FASTEST = 3.0
"""Tempo that the alignment allows, of the usual one."""

PASSES = 3
"""Alignments, each with the mean round of the one before."""

LEAST_SAMPLES = 8
"""In a round."""


def round_starts(positions: ArrayLike, dt: float, period: float | None = None) -> NDArray[np.int64]:
    """Return the samples at which rounds begin, counted from the first sample.

    Parameters
    ----------
    positions : array, shape (n, d)
        One recording of a motion that repeats, evenly sampled.
    dt : float
        Sample time in seconds.
    period : float, optional
        About how long a round takes, in seconds, to within `SLACK`; found where it is not given.

    Returns
    -------
    array of int, shape (k + 1,)
        0 and the nearest sample to each return to the first sample's phase: k whole rounds, of
        which round i is ``positions[starts[i] : starts[i + 1] + 1]``.

    Raises
    ------
    ValueError
        If the recording is not numeric or finite, is shorter than about `LEAST_ROUNDS` rounds, or
        never returns to where it was.
    """
    phase = phases(positions, dt, period)
    half_a_sample = 0.5 * phase[-1] / len(phase)
    whole = np.arange(np.floor(phase[-1] + half_a_sample) + 1)
    crossings = np.interp(whole, phase, np.arange(len(phase)))
    return np.asarray(np.rint(crossings), dtype=np.int64)


def period_of(positions: ArrayLike, dt: float) -> float:
    """Return the mean duration of a round in seconds: the mean time in which a sample recurs.

    All samples that recur count, not the first alone. Parameters and errors are those of
    `round_starts`.
    """
    phase = phases(positions, dt)
    index = np.arange(len(phase), dtype=np.float64)
    recurs = phase <= phase[-1] - 1
    if not recurs.any():
        recurs[0] = True
    later = np.interp(phase[recurs] + 1, phase, index)
    return float(np.mean(later - index[recurs]) * dt)


def phases(positions: ArrayLike, dt: float, period: float | None = None) -> FloatArray:
    """Return each sample's phase in rounds, shape (n,): 0 at the first, and never falling.

    Samples at phases that differ by a whole number are at the same place of the cycle, whatever
    the tempo was in between. Parameters and errors are those of `round_starts`.
    """
    points = np.array(positions, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] == 0 or not np.isfinite(points).all():
        raise ValueError(
            f"Expected finite positions of shape (samples, dimensions), got shape {points.shape}"
            + ("." if points.ndim != 2 else " with NaN or infinity.")
        )
    if not (np.isfinite(dt) and dt > 0):
        raise ValueError(f"Expected dt > 0 in seconds, got {dt}.")
    if len(points) < LEAST_SAMPLES or not np.ptp(points, axis=0).any():
        raise ValueError(
            f"Expected a recording of a motion with at least {LEAST_SAMPLES} samples a round, got "
            f"{len(points)} samples" + (", too few." if len(points) < LEAST_SAMPLES else " alike.")
        )
    longest = len(points) / LEAST_ROUNDS
    if period is None:
        lag = _recurrence(points)
    else:
        lag = period / dt
        if not LEAST_SAMPLES <= lag <= longest:
            raise ValueError(
                f"Expected a period between {LEAST_SAMPLES} samples and the recording's length / "
                f"{LEAST_ROUNDS}, {LEAST_SAMPLES * dt:g} s to {longest * dt:g} s, got {period:g} s."
            )
    states, short_lag = _thinned(_states(_smoothed(points, max(0.01 * lag, 0.5))), lag)
    coarse, _ = _align(states, short_lag)
    stride = round(lag / short_lag)
    at = np.arange(len(points)) / stride
    phase = np.interp(at, np.arange(len(coarse)), coarse)
    # After the last sample that was kept the phase goes on at the last rate.
    beyond = np.maximum(at - (len(coarse) - 1), 0)
    phase += beyond * (coarse[-1] - coarse[-2])
    return np.asarray(phase - phase[0])


def turning(positions: ArrayLike) -> float:
    """Return by how many turns the direction of a planar path turns, anticlockwise positive.

    Over a round of a closed curve that does not cross itself this is 1 or -1 (Hopf's
    Umlaufsatz): a check on rounds that knows nothing of returns.

    Parameters
    ----------
    positions : array, shape (n, 2)
        The path; smooth it first where it is noisy.
    """
    steps = np.diff(np.asarray(positions, dtype=np.float64), axis=0)
    steps = steps[steps.any(axis=1)]
    if steps.ndim != 2 or steps.shape[1] != 2 or len(steps) < 2:
        raise ValueError(f"Expected a moving path of shape (n, 2), got {np.shape(positions)}.")
    angles = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    return float((angles[-1] - angles[0]) / (2 * np.pi))


def _smoothed(samples: FloatArray, width: float) -> FloatArray:
    """Smooth samples, shape (n, d), by a Gaussian; beyond the ends they go on point-reflected."""
    reach = min(round(4 * width) + 1, len(samples) - 1)
    padded = np.pad(samples, ((reach, reach), (0, 0)), mode="reflect", reflect_type="odd")
    return np.asarray(gaussian_filter1d(padded, width, axis=0)[reach:-reach])


def _states(points: FloatArray) -> FloatArray:
    """Return positions in units of their spread, and directions beside them, shape (n, 2 d)."""
    centred = points - points.mean(axis=0)
    velocity = np.gradient(points, axis=0)
    speed = np.linalg.norm(velocity, axis=1, keepdims=True)
    rms = np.sqrt(np.mean(speed**2))
    # At a pause the direction is noise; there it counts for little.
    direction = velocity / np.hypot(speed, 0.3 * rms)
    spread = np.sqrt(np.mean(np.sum(centred**2, axis=1)))
    return np.concatenate([centred / spread, DIRECTION * direction], axis=1)


def _thinned(states: FloatArray, lag: float) -> tuple[FloatArray, float]:
    """Keep about `PER_ROUND` states a lag; return them and the lag in samples that were kept."""
    stride = max(1, int(lag // PER_ROUND))
    return states[::stride], lag / stride


def _recurrence(points: FloatArray) -> float:
    """Return the shortest lag, in samples, at which the state recurs.

    Looked for in the first `SCAN` samples, then in twice as long a beginning at half the
    resolution, and so on until something recurs or the recording is over.
    """
    stride = 1
    while True:
        path = _smoothed(points[: SCAN * stride], max(1.0, 0.5 * stride))[::stride]
        states = _states(path)
        lags = _recurrent_lags(states)
        if lags:
            return float(_period_among(states, lags) * stride)
        if len(points) <= SCAN * stride:
            raise ValueError(
                "Expected a recording that returns to where it was, in position and direction, "
                f"and is at least {LEAST_ROUNDS} rounds long, got one that never does: record more "
                "rounds."
            )
        stride *= 2


def _period_among(states: FloatArray, lags: list[int]) -> int:
    """Return the first of some lags whose rounds are about as much alike as any's."""
    residuals: list[float] = []
    for lag in lags:
        residuals.append(_align(*_thinned(states, lag))[1])
        if residuals[-1] <= AS_GOOD:  # then no other is better by more
            break
    good = np.array(residuals) <= min(residuals) + AS_GOOD
    return lags[int(np.argmax(good))]


def _recurrent_lags(states: FloatArray) -> list[int]:
    """Return the shortest lags, further apart than `SLACK`, at which states recur."""
    n = len(states)
    longest = int(n / LEAST_ROUNDS)
    square = np.sum(states**2, axis=1)
    apart = np.sqrt(np.maximum(square[:, None] + square - 2 * states @ states.T, 0))
    # later[t, lag]: how far the state is, so much later, from where it was at t
    later = np.full((n, longest + 1), np.inf)
    for lag in range(longest + 1):
        later[: n - lag, lag] = np.diagonal(apart, lag)
    strict, loose = np.empty(longest + 1), np.empty(longest + 1)
    for lag in range(longest + 1):
        width = max(1, round(SLACK * lag))
        window = later[: n - lag, max(0, lag - width) : lag + width + 1]
        strict[lag] = later[: n - lag, lag].mean()
        loose[lag] = window.min(axis=1).mean()
    # What recurs has been away before.
    away = np.maximum.accumulate(strict) > AWAY
    low = minimum_filter1d(strict, 3, mode="nearest") == strict
    lags = np.flatnonzero(
        low & away & (loose <= RECURRENCE) & (np.arange(longest + 1) >= LEAST_SAMPLES)
    )
    found: list[int] = []
    while len(lags) and len(found) < CANDIDATES:
        near = lags[lags <= lags[0] * (1 + SLACK)]
        found.append(int(near[np.argmin(strict[near])]))
        lags = lags[lags > found[-1] * (1 + SLACK)]
    return found


def _align(states: FloatArray, lag: float) -> tuple[FloatArray, float]:
    """Align states that repeat at about a lag, in samples, with their mean round.

    Returns phases in rounds, shape (n,), and how far states are from the mean round on average.
    """
    n = len(states)
    template = _closed_round(states, lag)
    moves = np.arange(round(FASTEST * BINS / lag) + 1)
    penalty = 0.02 * (moves * lag / BINS - 1) ** 2
    for _ in range(PASSES):
        bins = _best_path(states, template, moves, penalty)
        residual = float(np.mean(np.linalg.norm(states - template[bins % BINS], axis=1)))
        phase = _smoothed((bins / BINS)[:, None], 0.02 * lag)[:, 0]
        template = _mean_round(states, phase)
    # Strictly increasing, so that it can be inverted; the slope added is far below a bin.
    return np.asarray(phase + np.arange(n) * 1e-9), residual


def _closed_round(states: FloatArray, lag: float) -> FloatArray:
    """Return the round that closes best, at BINS phases, its gap spread over its length."""
    n = len(states)
    lengths = np.arange(max(2, round((1 - SLACK) * lag)), min(n - 1, round((1 + SLACK) * lag)) + 1)
    starts = np.arange(0, n - lengths[0])
    ends = starts[:, None] + lengths
    gaps = np.linalg.norm(states[starts][:, None] - states[np.minimum(ends, n - 1)], axis=2)
    gaps = np.where(ends < n, gaps, np.inf)
    # A single state may recur by chance: what counts is that its neighbours do.
    width = max(1, round(0.05 * lag))
    scores = gaussian_filter1d(np.where(np.isfinite(gaps), gaps, 10.0), width, axis=0)
    scores = np.where(np.isfinite(gaps), scores, np.inf)
    start, k = np.unravel_index(int(np.argmin(scores)), scores.shape)
    length = lengths[k]
    at = start + np.arange(BINS) / BINS * length
    index = np.arange(n)
    cut = np.stack([np.interp(at, index, column) for column in states.T], axis=1)
    gap = states[start + length] - states[start]
    return np.asarray(cut - gap * (np.arange(BINS) / BINS - 0.5)[:, None])


def _best_path(
    states: FloatArray, template: FloatArray, moves: NDArray[np.int64], penalty: FloatArray
) -> NDArray[np.int64]:
    """Return the bins, unwrapped, of the cheapest monotone alignment with the template."""
    n = len(states)
    costs = (
        np.sum(states**2, axis=1)[:, None] + np.sum(template**2, axis=1) - 2 * states @ template.T
    )
    # before[m, b]: the bin m moves before b, round the cycle
    before = (np.arange(BINS) - moves[:, None]) % BINS
    total = costs[0]
    chosen = np.zeros((n, BINS), dtype=np.int64)
    here = np.arange(BINS)
    for t in range(1, n):
        options = total[before] + penalty[:, None]
        best = np.argmin(options, axis=0)
        chosen[t] = best
        total = options[best, here] + costs[t]
    steps = np.zeros(n, dtype=np.int64)
    at = int(np.argmin(total))
    for t in range(n - 1, 0, -1):
        steps[t] = moves[chosen[t, at]]
        at = (at - steps[t]) % BINS
    return at + np.cumsum(steps)


def _mean_round(states: FloatArray, phase: FloatArray) -> FloatArray:
    """Return the mean state at each of BINS phases, over a kernel of three bins, round the cycle.

    Shape (BINS, 2 d). A phase that no sample comes near takes the nearest samples.
    """
    bins = np.arange(BINS) / BINS
    away = np.abs((phase[:, None] - bins + 0.5) % 1 - 0.5)
    nearest = away.min(axis=0)
    width = np.maximum(1.5 / BINS, nearest)
    weights = np.exp(-0.5 * (away / width) ** 2)
    return np.asarray((weights.T @ states) / weights.sum(axis=0)[:, None])
