"""Whether the drums are hit, which one, and when.

The definitions are those of METRICS.md, "Drumming". A *hit* is a contact of stick and drum head
with a force of at least ``FORCE_THRESHOLD`` that no such force on the same drum preceded within
``REFRACTORY_TIME``. A *score* is what is to be played: the hits that a demonstration implies.

Times are in seconds from the episode's beginning, drums are indices. The hits of a performance and
the notes of a score enter the metrics as ``times`` and ``drums``, arrays of shape (n,), in any
order.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iflow_gym.metrics._validation import FloatArray, positive

FORCE_THRESHOLD = 2.0
"""Force of a hit in N."""
REFRACTORY_TIME = 0.1
"""The head must have been quiet for so many seconds before a hit."""
PEAK_WINDOW = 0.05
"""A hit's force is the largest within so many seconds of its onset."""
TOLERANCE = 0.05
"""A hit within so many seconds of a note of its drum can be that note."""

IntArray = NDArray[np.intp]


class Hit(NamedTuple):
    """A stroke on a drum."""

    time: float
    """Of its onset, in s."""
    drum: int
    force: float
    """Largest within ``PEAK_WINDOW`` of the onset, in N."""


class Matching(NamedTuple):
    """Which hit is which note."""

    notes: IntArray
    """Indices into the score, shape (m,)."""
    hits: IntArray
    """Indices into the performance, shape (m,): hit ``hits[k]`` is note ``notes[k]``."""
    missed: int
    """Notes without a hit."""
    extra: int
    """Hits that are no note."""


def detect_hits(
    forces: ArrayLike,
    dt: float,
    *,
    threshold: float = FORCE_THRESHOLD,
    refractory_time: float = REFRACTORY_TIME,
    peak_window: float = PEAK_WINDOW,
) -> list[Hit]:
    """Find the hits in recorded forces.

    A hit's onset is a sample at or above the threshold while every sample of the same drum within
    the refractory time before it is below. A stick that lies on a head, or trembles on it, has hit
    it once; it must be away for the refractory time to hit it again.

    Parameters
    ----------
    forces
        Normal force of the stick on each head in N, shape (T, n_drums), or (T,) for one drum.
    dt
        Seconds a sample.
    threshold
        In N.
    refractory_time, peak_window
        In s; rounded to samples, the peak window to at least one.

    Returns
    -------
    list of Hit
        In order of time, then drum; a force that is at the threshold in the first sample hits at 0.

    Raises
    ------
    ValueError
        If the shape is another, a force is not finite, or a number is not positive.
    """
    signal = np.asarray(forces, dtype=np.float64)
    if signal.ndim == 1:
        signal = signal[:, None]
    if signal.ndim != 2:
        raise ValueError(f"Expected forces of shape (T, n_drums) or (T,), got {signal.shape}")
    if not np.isfinite(signal).all():
        raise ValueError("Expected finite forces, got nan or infinity")
    step = positive(dt, "dt")
    quiet = round(positive(refractory_time, "refractory_time") / step)
    window = max(1, round(positive(peak_window, "peak_window") / step))
    hits: list[Hit] = []
    for drum, force in enumerate(signal.T):
        above = np.flatnonzero(force >= positive(threshold, "threshold"))
        gaps = np.diff(above, prepend=-quiet - 1)
        hits += [
            Hit(onset * step, drum, float(force[onset : onset + window].max()))
            for onset in above[gaps > quiet].tolist()
        ]
    return sorted(hits)


class HitDetector:
    """``detect_hits`` while the forces come in, one sample after the other.

    A hit is reported when its peak window has passed. ``flush`` reports those still open.
    """

    def __init__(self, n_drums: int, dt: float) -> None:
        self._n_drums, self._dt = n_drums, positive(dt, "dt")
        self._quiet = round(REFRACTORY_TIME / dt)
        self._window = max(1, round(PEAK_WINDOW / dt))
        self.reset()

    def reset(self) -> None:
        """Forget everything; the next sample is at time 0."""
        self._sample = 0
        self._last = [-self._quiet - 1] * self._n_drums
        self._open: list[tuple[int, int, float]] = []

    def update(self, forces: Sequence[float]) -> list[Hit]:
        """Take the forces of one sample in N, one a drum; return the hits decided by now."""
        now = self._sample
        if self._open:
            self._open = [(s, d, max(peak, forces[d])) for s, d, peak in self._open]
        for drum, force in enumerate(forces):
            if force >= FORCE_THRESHOLD:
                if now - self._last[drum] > self._quiet:
                    self._open.append((now, drum, force))
                self._last[drum] = now
        self._sample = now + 1
        if not self._open or now - self._open[0][0] < self._window - 1:
            return []
        decided = [hit for hit in self._open if now - hit[0] >= self._window - 1]
        self._open = self._open[len(decided) :]
        return [Hit(s * self._dt, d, peak) for s, d, peak in decided]

    def flush(self) -> list[Hit]:
        """Return the hits whose window is still open, with the force so far, and forget them."""
        rest, self._open = self._open, []
        return [Hit(s * self._dt, d, peak) for s, d, peak in rest]


def implied_score(
    positions: ArrayLike,
    dt: float,
    heads: ArrayLike,
    radii: ArrayLike,
    *,
    tip_radius: float,
    refractory_time: float = REFRACTORY_TIME,
) -> tuple[FloatArray, IntArray]:
    """Return the score that a recording of the tip implies: when it comes down to which head.

    A note is where the bead's lowest point reaches the plane of a head from above, within the
    head's rim. The instant is interpolated between samples. As with hits, the bead must have been
    above for the refractory time.

    Parameters
    ----------
    positions
        Centre of the bead in m, shape (T, 3), z up.
    dt
        Seconds a sample.
    heads, radii
        Centres of the level heads in m, shape (n_drums, 3), and their radii, shape (n_drums,).
    tip_radius
        Of the bead, in m.

    Returns
    -------
    times, drums : arrays of shape (n,)
        In order of time.

    Raises
    ------
    ValueError
        If shapes do not fit or the positions are not finite.
    """
    path = np.asarray(positions, dtype=np.float64)
    centres = np.asarray(heads, dtype=np.float64)
    rims = np.asarray(radii, dtype=np.float64)
    if path.ndim != 2 or path.shape[1] != 3 or not np.isfinite(path).all():
        raise ValueError(f"Expected finite positions of shape (T, 3), got {path.shape}")
    if centres.ndim != 2 or centres.shape[1] != 3 or rims.shape != centres.shape[:1]:
        raise ValueError(
            f"Expected heads of shape (n, 3) and radii of shape (n,), got {centres.shape} and "
            f"{rims.shape}"
        )
    step = positive(dt, "dt")
    quiet = round(positive(refractory_time, "refractory_time") / step)
    notes = []
    for drum, (centre, rim) in enumerate(zip(centres, rims, strict=True)):
        height = path[:, 2] - centre[2] - tip_radius
        within = np.linalg.norm(path[:, :2] - centre[:2], axis=1) <= rim
        down = np.flatnonzero(within & (height <= 0.0))
        for k in down[np.diff(down, prepend=-quiet - 1) > quiet].tolist():
            before, after = (height[k - 1], height[k]) if k else (0.0, 0.0)
            part = before / (before - after) if before > 0.0 else 1.0
            notes.append((max(k - 1 + part, 0.0) * step, drum))
    notes.sort()
    times = np.array([t for t, _ in notes], dtype=np.float64)
    return times, np.array([d for _, d in notes], dtype=np.intp)


def match(
    score_times: ArrayLike,
    score_drums: ArrayLike,
    hit_times: ArrayLike,
    hit_drums: ArrayLike,
    tolerance: float = TOLERANCE,
) -> Matching:
    """Match notes and hits one to one.

    A hit can be a note of its own drum that is at most the tolerance away. Of all matchings, one
    with the most pairs is taken, and among those one with the least sum of time differences (a
    linear assignment).

    Parameters
    ----------
    score_times, score_drums
        What is to be played, shape (n,) each: seconds and indices.
    hit_times, hit_drums
        What was played, shape (m,) each.
    tolerance
        In s, inclusive (to a nanosecond).

    Raises
    ------
    ValueError
        If shapes do not fit, times are not finite, drums are not whole numbers, or the tolerance
        is not positive.
    """
    from scipy.optimize import linear_sum_assignment

    notes_at, notes_on = _played(score_times, score_drums, "score")
    hits_at, hits_on = _played(hit_times, hit_drums, "hit")
    apart = np.abs(notes_at[:, None] - hits_at[None, :])
    allowed = (notes_on[:, None] == hits_on[None, :]) & (
        apart <= positive(tolerance, "tolerance") + 1e-9
    )
    # Any number of allowed pairs is together cheaper than one more pair that is not allowed.
    forbidden = (min(apart.shape) + 1) * (tolerance + 1e-9)
    rows, columns = linear_sum_assignment(np.where(allowed, apart, forbidden))
    kept = allowed[rows, columns]
    pairs = int(kept.sum())
    return Matching(
        np.asarray(rows[kept], dtype=np.intp),
        np.asarray(columns[kept], dtype=np.intp),
        missed=len(notes_at) - pairs,
        extra=len(hits_at) - pairs,
    )


def hit_f1(
    score_times: ArrayLike,
    score_drums: ArrayLike,
    hit_times: ArrayLike,
    hit_drums: ArrayLike,
    tolerance: float = TOLERANCE,
) -> float:
    r"""F1 of the hits: the harmonic mean of the notes' share hit and the hits' share in the score.

    .. math:: F_1 = \frac{2 m}{n_\text{notes} + n_\text{hits}}

    with m pairs of `match`.

    Parameters
    ----------
    score_times, score_drums, hit_times, hit_drums, tolerance
        As in `match`, whose errors are raised.

    Returns
    -------
    float
        In [0, 1]; 1 for silence that was asked for.
    """
    notes, hits = np.size(score_times), np.size(hit_times)
    pairs = len(match(score_times, score_drums, hit_times, hit_drums, tolerance).notes)
    return 2.0 * pairs / (notes + hits) if notes + hits else 1.0


def sequence_f1(
    score_times: ArrayLike, score_drums: ArrayLike, hit_times: ArrayLike, hit_drums: ArrayLike
) -> float:
    r"""F1 of the drums' order alone, whenever they are hit.

    .. math:: F_1 = \frac{2 \ell}{n_\text{notes} + n_\text{hits}}

    with l the length of the longest common subsequence of the drums in the score and those that
    were hit, each in order of time. It tells a performance at another tempo, which `hit_f1` counts
    as all wrong, from one that hits the wrong drum, one twice, or none.

    Parameters
    ----------
    score_times, score_drums, hit_times, hit_drums
        As in `match`, whose errors are raised.

    Returns
    -------
    float
        In [0, 1], at least `hit_f1` where matched hits are in the score's order; 1 for silence that
        was asked for.
    """
    notes_at, notes_on = _played(score_times, score_drums, "score")
    hits_at, hits_on = _played(hit_times, hit_drums, "hit")
    notes = notes_on[np.argsort(notes_at, kind="stable")].tolist()
    hits = hits_on[np.argsort(hits_at, kind="stable")].tolist()
    if not notes and not hits:
        return 1.0
    lengths = [0] * (len(hits) + 1)
    for note in notes:
        diagonal = 0
        for j, hit in enumerate(hits, start=1):
            above = lengths[j]
            lengths[j] = diagonal + 1 if note == hit else max(above, lengths[j - 1])
            diagonal = above
    return 2.0 * lengths[-1] / (len(notes) + len(hits))


def rhythm(scores: Sequence[tuple[ArrayLike, ArrayLike]]) -> FloatArray:
    r"""When in a round each drum is hit, the mean of several scores of one note a drum and round.

    Each score's phases are its times over its own round, relative to drum 0; their circular mean
    over the notes and the scores is taken.

    Parameters
    ----------
    scores
        Times in s and drums, shape (n,) each.

    Returns
    -------
    array of shape (n_drums,)
        In rounds, from 0 to 1; drum 0 is at 0.

    Raises
    ------
    ValueError
        If `match`'s conditions do not hold, or a score has no drum with two notes or lacks a drum.
    """
    means = []
    for times, drums in scores:
        at, on = _played(times, drums, "score")
        period = _round(at, on)
        if period is None or set(on.tolist()) != set(range(int(on.max()) + 1)):
            raise ValueError(
                "Expected scores of two rounds with a note for every drum, got drums "
                f"{on.tolist()}: a shorter one has no rhythm"
            )
        turns = np.exp(2j * np.pi * at / period)
        phases = np.array([turns[on == drum].mean() for drum in range(int(on.max()) + 1)])
        means.append(phases / phases[0])
    together = np.mean([phases / np.abs(phases) for phases in means], axis=0)
    return np.asarray(np.angle(together) / (2 * np.pi) % 1.0)


def rhythm_f1(
    phases: ArrayLike,
    hit_times: ArrayLike,
    hit_drums: ArrayLike,
    period: float,
    duration: float,
    tolerance: float = TOLERANCE,
) -> float:
    r"""F1 of the hits against a rhythm that goes round at the performance's own tempo.

    The notes are at s + (k + phi_d) T^ for all k, with T^ the median interval between successive
    hits of one drum, from the first hit to the end, and the shift s that matches best. So a steady
    drummer of the right rhythm scores 1 at any tempo up to twice or half as fast (`tempo_error`
    says how far off it is), and one who is uneven, misses, doubles, stops, or hits the drums at
    wrong times of the round does not.

    Parameters
    ----------
    phases
        When in a round each drum is hit, shape (n_drums,), as `rhythm` gives it.
    hit_times, hit_drums, tolerance
        As in `match`.
    period
        Of a round of the demonstrations, in s.
    duration
        Of the performance, in s: notes are due until its end.

    Returns
    -------
    float
        In [0, 1]; 0 where no drum was hit twice, where the tempo is beyond twice or half the
        demonstrations', and where the first hit comes after more than two rounds.

    Raises
    ------
    ValueError
        If `match`'s conditions do not hold.
    """
    shares = np.asarray(phases, dtype=np.float64)
    times, drums = _played(hit_times, hit_drums, "hit")
    known, end = positive(period, "period"), positive(duration, "duration")
    found = _round(times, drums)
    if found is None or not 0.5 <= found / known <= 2.0 or times.min() > 2 * known:
        return 0.0
    best = 0.0
    first, last = times.min(), times.max()
    rounds = np.arange(-1, np.ceil((max(end, last) - first) / found) + 2)
    notes_on = np.tile(np.arange(len(shares)), len(rounds))
    # A note in the last moment may still be played after it.
    until = max(end - tolerance, last + tolerance)
    # What matches changes only where a note is at the tolerance from a hit.
    for time, drum in zip(times.tolist(), drums.tolist(), strict=True):
        for early in (0.0, -tolerance, tolerance):
            start = first + (time + early - shares[drum] * found - first) % found
            notes_at = (start + (rounds[:, None] + shares) * found).ravel()
            due = (notes_at >= first - tolerance - 1e-9) & (notes_at <= until + 1e-9)
            best = max(best, hit_f1(notes_at[due], notes_on[due], times, drums, tolerance))
    return best


def missed(
    score_times: ArrayLike,
    score_drums: ArrayLike,
    hit_times: ArrayLike,
    hit_drums: ArrayLike,
    tolerance: float = TOLERANCE,
) -> int:
    """Count the notes that no hit matches; parameters as in `match`."""
    return match(score_times, score_drums, hit_times, hit_drums, tolerance).missed


def extra(
    score_times: ArrayLike,
    score_drums: ArrayLike,
    hit_times: ArrayLike,
    hit_drums: ArrayLike,
    tolerance: float = TOLERANCE,
) -> int:
    """Count the hits that match no note; parameters as in `match`."""
    return match(score_times, score_drums, hit_times, hit_drums, tolerance).extra


def timing_error(
    score_times: ArrayLike,
    score_drums: ArrayLike,
    hit_times: ArrayLike,
    hit_drums: ArrayLike,
    tolerance: float = TOLERANCE,
) -> float:
    """Mean absolute time between matched notes and hits, in ms.

    Parameters
    ----------
    score_times, score_drums, hit_times, hit_drums, tolerance
        As in `match`, whose errors are raised.

    Returns
    -------
    float
        At most the tolerance: what lies beyond it is no match, and shows in `hit_f1`. Infinity
        where nothing matches, 0 for silence that was asked for.
    """
    pairs = match(score_times, score_drums, hit_times, hit_drums, tolerance)
    if len(pairs.notes) == 0:
        return 0.0 if pairs.missed + pairs.extra == 0 else float("inf")
    apart = (
        np.asarray(score_times, dtype=np.float64)[pairs.notes]
        - np.asarray(hit_times, dtype=np.float64)[pairs.hits]
    )
    return 1000.0 * float(np.abs(apart).mean())


def tempo_error(
    score_times: ArrayLike, score_drums: ArrayLike, hit_times: ArrayLike, hit_drums: ArrayLike
) -> float:
    r"""How far off the tempo is, as a fraction of the score's.

    .. math:: |\hat T - T| / T

    with T the duration of a round: the median interval between successive notes of the same drum,
    over all drums, and T^ the same of the hits.

    Parameters
    ----------
    score_times, score_drums, hit_times, hit_drums
        As in `match`.

    Returns
    -------
    float
        Infinity where no drum was hit twice.

    Raises
    ------
    ValueError
        If `match`'s conditions do not hold, or the score has no drum with two notes.
    """
    wanted = _round(*_played(score_times, score_drums, "score"))
    if wanted is None:
        raise ValueError("Expected a score with two notes on one drum: a shorter one has no tempo")
    found = _round(*_played(hit_times, hit_drums, "hit"))
    return float("inf") if found is None else abs(found - wanted) / wanted


def tracking_rmse(commanded: ArrayLike, reached: ArrayLike) -> float:
    r"""How far the tip is from where it was commanded to be, in mm.

    .. math:: 1000 \sqrt{\frac{1}{T} \sum_t \lVert x_t - \hat x_t \rVert^2}

    Parameters
    ----------
    commanded, reached
        Positions of the tip at the same instants in m, shape (T, d).

    Returns
    -------
    float
        Infinity if a position that was reached is not finite.

    Raises
    ------
    ValueError
        If the shapes differ or are no trajectories, or a command is not finite.
    """
    wanted = np.asarray(commanded, dtype=np.float64)
    found = np.asarray(reached, dtype=np.float64)
    if wanted.ndim != 2 or wanted.shape != found.shape or wanted.size == 0:
        raise ValueError(
            f"Expected two trajectories of one shape (T, d), got {wanted.shape} and {found.shape}"
        )
    if not np.isfinite(wanted).all():
        raise ValueError("Expected finite commands, got nan or infinity")
    if not np.isfinite(found).all():
        return float("inf")
    return 1000.0 * float(np.sqrt(((wanted - found) ** 2).sum(axis=1).mean()))


def _played(times: ArrayLike, drums: ArrayLike, name: str) -> tuple[FloatArray, IntArray]:
    at, on = np.asarray(times, dtype=np.float64), np.asarray(drums)
    if at.ndim != 1 or at.shape != on.shape:
        raise ValueError(
            f"Expected {name}_times and {name}_drums of one shape (n,), got {at.shape} and "
            f"{on.shape}"
        )
    if not np.isfinite(at).all():
        raise ValueError(f"Expected finite {name}_times, got nan or infinity")
    if at.size and on.dtype.kind not in "iu":
        raise ValueError(f"Expected {name}_drums to be whole numbers, got {on.dtype}")
    return at, on.astype(np.intp)


def _round(times: FloatArray, drums: IntArray) -> float | None:
    """Return the median interval between successive strokes on the same drum, if there is one."""
    intervals = [np.diff(np.sort(times[drums == drum])) for drum in np.unique(drums)]
    together = np.concatenate(intervals) if intervals else np.zeros(0)
    return float(np.median(together)) if together.size else None
