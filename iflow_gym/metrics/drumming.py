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
    hits = []
    for drum, force in enumerate(signal.T):
        above = np.flatnonzero(force >= positive(threshold, "threshold"))
        gaps = np.diff(above, prepend=-quiet - 1)
        for onset in above[gaps > quiet].tolist():
            hits.append(Hit(onset * step, drum, float(force[onset : onset + window].max())))
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
