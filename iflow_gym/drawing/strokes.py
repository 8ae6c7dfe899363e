"""Strokes of a pen made into demonstrations.

A stroke is what a browser hands over: samples (t, x, y) in seconds and millimetres, unevenly spaced
in time, on a whole number of pixels, with a hand that rests before it sets off and before it lifts.
Made even of it is what the methods expect:

1. A wait is cut out: a gap between two samples longer than `WAIT` in which the pen hardly moved. A
   field has one velocity at a place, so that a motion which waits and goes on is none. What is left
   is the time that the move takes at the stroke's pace.
2. Rest at both ends is trimmed: samples within `STILL` of the first, and of the last.
3. The rest is interpolated linearly on an even grid and smoothed in time by a Gaussian, whose
   standard deviation is `SMOOTHING`; the ends stay where they are.
4. Strokes that end are shifted, each as a whole, to end at the mean of their ends. Strokes that
   repeat have a period instead (`iflow_gym.rounds`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.rounds import period_of

Kind = Literal["goal", "cycle"]
"""Whether strokes end at a point or go round and round."""
KINDS: tuple[Kind, ...] = get_args(Kind)

WAIT, WAIT_PACE = 0.1, 0.2
"""A gap of more seconds in which the pen moves at less than this fraction of its pace is a wait."""

STILL = 0.5
"""Millimetres about an end within which the pen rests."""

SAMPLE_TIME = 0.01
"""Seconds a sample of a stroke that needs neither more nor fewer than `N_SAMPLES`."""

N_SAMPLES = (100, 1000)
"""The least and the most samples of a stroke."""

SMOOTHING = 0.02
"""Seconds."""

LEAST_SIZE, LEAST_DURATION = 5.0, 0.1
"""Millimetres and seconds of a stroke."""

FARTHEST = 1e4
"""Millimetres from the sheet's centre, which no pen reaches."""

FAR_ENDS = 0.5
"""Ends may lie this far from their mean, as a fraction of the largest stroke's diagonal."""

WORTH_SAYING = 1.0
"""Millimetres of a shift, and above, that are told."""

LEAST_ROUNDS = 1.5
"""Rounds that a stroke which repeats has at least."""

UNEVEN_TEMPO = 1.5
"""The slowest stroke's period in the fastest's, from which that is told."""

CROSSING_NEAR, CROSSING_ANGLE = 0.01, 60.0
"""What counts as a crossing: nearer than this fraction of the diagonal, at more than so many
degrees."""

CROSSING_WINDOW = 0.04
"""Directions there are those over so much of the way to either side, as a fraction of the diagonal:
a sharp corner is no crossing."""

NEAR_GOAL = 0.12
"""Where strokes come together at the goal, as a fraction of the diagonal, nothing is a crossing."""

ROUND_AREA = 0.1
"""Rounds that enclose less, as a fraction of their box, have no sense of rotation."""


class DrawingError(ValueError):
    """Strokes that cannot be learned from; the message is for the person who drew them."""


@dataclass(frozen=True)
class Drawing:
    """Demonstrations that were drawn.

    Attributes
    ----------
    demonstrations : Demonstrations
        In millimetres.
    notices : tuple of str
        What was done to the strokes, or is to be known about them.
    """

    demonstrations: Demonstrations
    notices: tuple[str, ...] = ()


def drawing_of(strokes: Sequence[ArrayLike], kind: Kind) -> Drawing:
    """Make demonstrations of strokes.

    Parameters
    ----------
    strokes : sequence of n arrays, shape (T_i, 3)
        Samples (t, x, y) in seconds and millimetres.
    kind : "goal" or "cycle"

    Raises
    ------
    DrawingError
        If there is no stroke; if one is too short, too quick or not finite; if ends are far apart;
        if a stroke that is to repeat is shorter than `LEAST_ROUNDS` rounds; or if some go round one
        way and some the other.
    """
    if kind not in KINDS:
        raise DrawingError(f"Expected a motion of kind {' or '.join(KINDS)}, got {kind!r}.")
    if len(strokes) == 0:
        raise DrawingError("There is nothing to fit yet: draw the motion, three times if you can.")
    tidied = [_tidied(stroke, number) for number, stroke in enumerate(strokes, 1)]
    positions, steps = [t.positions for t in tidied], [t.dt for t in tidied]
    notices = []
    if (waited := sum(t.waited for t in tidied)) >= WAIT:
        notices.append(
            f"Waits of {waited:.1f} s in all were cut out: a field has one velocity at each place."
        )
    if kind == "goal":
        positions, told = _brought_together(positions)
        notices += told
        demonstrations = Demonstrations.from_arrays(
            positions, dt=steps, name="drawing", length_unit="mm", source="drawn"
        )
    else:
        period, told = _common_period(positions, steps)
        notices += told
        demonstrations = Demonstrations.from_arrays(
            positions, dt=steps, period=period, name="drawing", length_unit="mm", source="drawn"
        )
    if _crosses(demonstrations):
        notices.append(
            "The motion crosses itself. A field has one direction at each place, so that it cannot "
            "follow a crossing."
        )
    if len(strokes) < 3:
        notices.append("Three strokes or more say better what belongs to the motion.")
    return Drawing(demonstrations, tuple(notices))


@dataclass(frozen=True)
class _Tidied:
    positions: FloatArray
    dt: float
    waited: float
    """Seconds that were cut out along the way."""


def _tidied(stroke: ArrayLike, number: int) -> _Tidied:
    try:
        samples = np.array(stroke, dtype=np.float64)
    except (TypeError, ValueError):
        samples = np.empty(0)
    if (
        samples.ndim != 2
        or samples.shape[1] != 3
        or not np.isfinite(samples).all()
        or (len(samples) and np.abs(samples[:, 1:]).max() > FARTHEST)
    ):
        raise DrawingError(
            f"Expected stroke {number} as samples (t, x, y) of finite numbers in seconds and "
            f"millimetres, not beyond {FARTHEST:g} mm: draw it again."
        )
    times, points = samples[:, 0], samples[:, 1:]
    later = np.r_[True, times[1:] > np.maximum.accumulate(times)[:-1]][: len(times)]
    times, points = times[later], points[later]
    size = float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 0.0
    if len(points) < 3 or size < LEAST_SIZE:
        raise DrawingError(
            f"Stroke {number} is {size:.1f} mm across, and {LEAST_SIZE:g} mm are the least to be "
            "learned from: draw it larger, or delete it."
        )
    first = int(np.argmax(np.linalg.norm(points - points[0], axis=1) > STILL)) - 1
    last = len(points) - int(np.argmax(np.linalg.norm(points - points[-1], axis=1)[::-1] > STILL))
    times, points = times[first : last + 1], points[first : last + 1]
    gaps, moves = np.diff(times), np.linalg.norm(np.diff(points, axis=0), axis=1)
    pace = moves.sum() / np.minimum(gaps, WAIT).sum()
    kept = np.where((gaps > WAIT) & (moves < WAIT_PACE * pace * gaps), moves / pace, gaps)
    # A wait before the first move and after the last one is rest at an end.
    waited = float((gaps - kept)[1:-1].sum())
    times = np.r_[0.0, np.cumsum(kept)]
    if times[-1] < LEAST_DURATION:
        raise DrawingError(
            f"Stroke {number} took {times[-1]:.2f} s, and {LEAST_DURATION:g} s are the least to be "
            "learned from: draw it slower, or delete it."
        )
    n_samples = int(np.clip(round(times[-1] / SAMPLE_TIME) + 1, *N_SAMPLES))
    even = np.linspace(0.0, times[-1], n_samples)
    path = np.stack([np.interp(even, times, column) for column in points.T], axis=1)
    return _Tidied(_smoothed(path, SMOOTHING / even[1]), float(even[1]), waited)


def _smoothed(path: FloatArray, width: float) -> FloatArray:
    """Smooth samples, shape (n, 2), by a Gaussian; point-reflected at the ends, which stay."""
    reach = min(round(4 * width) + 1, len(path) - 1)
    padded = np.pad(path, ((reach, reach), (0, 0)), mode="reflect", reflect_type="odd")
    return np.asarray(gaussian_filter1d(padded, width, axis=0)[reach:-reach])


def _brought_together(positions: list[FloatArray]) -> tuple[list[FloatArray], list[str]]:
    """Shift strokes to end at the mean of their ends; say so where it is worth it."""
    ends = np.stack([p[-1] for p in positions])
    shifts = ends.mean(axis=0) - ends
    lengths = np.linalg.norm(shifts, axis=1)
    size = max(float(np.linalg.norm(np.ptp(p, axis=0))) for p in positions)
    if lengths.max() > FAR_ENDS * size:
        worst = int(lengths.argmax())
        raise DrawingError(
            f"Stroke {worst + 1} ends {lengths[worst]:.0f} mm from the mean of the ends, which is "
            f"far for strokes {size:.0f} mm across: end all of them at one point, or choose "
            "“Goes round”."
        )
    told = []
    if lengths.max() >= WORTH_SAYING:
        told.append(
            f"The strokes were shifted by up to {lengths.max():.1f} mm, to end at the mean of "
            "their ends."
        )
    return [p + shift for p, shift in zip(positions, shifts, strict=True)], told


def _common_period(positions: list[FloatArray], steps: list[float]) -> tuple[float, list[str]]:
    """Return the mean period of strokes that repeat, in seconds, and what is to be said."""
    found = []
    for number, (path, dt) in enumerate(zip(positions, steps, strict=True), 1):
        try:
            period = period_of(path, dt)
        except ValueError:
            raise DrawingError(
                f"Stroke {number} does not come back to where it was, in place and direction: go "
                f"round at least {LEAST_ROUNDS:g} times without lifting the pen, better three "
                "times, or choose “Ends at a point”."
            ) from None
        rounds = (len(path) - 1) * dt / period
        if rounds < LEAST_ROUNDS:
            raise DrawingError(
                f"Stroke {number} goes round {rounds:.2f} times, and {LEAST_ROUNDS:g} times are "
                "the least: go round longer without lifting the pen."
            )
        found.append(period)
    senses = [_sense(p, t, dt) for p, t, dt in zip(positions, found, steps, strict=True)]
    if 1 in senses and -1 in senses:
        ways = [[str(i) for i, s in enumerate(senses, 1) if s == way] for way in (1, -1)]
        raise DrawingError(
            "Some strokes go round anticlockwise (" + ", ".join(ways[0]) + ") and some clockwise ("
            + ", ".join(ways[1]) + "): draw all of them the same way round."
        )  # fmt: skip
    told = []
    if max(found) > UNEVEN_TEMPO * min(found):
        told.append(
            f"A round takes from {min(found):.1f} to {max(found):.1f} s; the mean is learned."
        )
    return float(np.mean(found)), told


def _sense(path: FloatArray, period: float, dt: float) -> int:
    """Return 1 for rounds anticlockwise, -1 for clockwise, 0 where neither is clear."""
    x, y = (path - path.mean(axis=0)).T
    rounds = (len(path) - 1) * dt / period
    area = float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1])) / 2 / rounds
    box = float(np.prod(np.ptp(path, axis=0)))
    return int(np.sign(area)) if abs(area) > ROUND_AREA * box else 0


def _crosses(demonstrations: Demonstrations) -> bool:
    """Return whether strokes pass one place in directions that no field can have there."""
    diagonal = demonstrations.bounding_box.diagonal
    near, window = CROSSING_NEAR * diagonal, CROSSING_WINDOW * diagonal
    places, directions = [], []
    for path in demonstrations.positions:
        way = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))]
        at = np.arange(window, way[-1] - window, near / 2)
        here, ahead, behind = (
            np.stack([np.interp(at + shift, way, column) for column in path.T], axis=1)
            for shift in (0.0, window, -window)
        )
        places.append(here)
        directions.append(ahead - behind)
    place, direction = np.concatenate(places), np.concatenate(directions)
    if demonstrations.goal is not None:
        away = np.linalg.norm(place - demonstrations.goal, axis=1) > NEAR_GOAL * diagonal
        place, direction = place[away], direction[away]
    one, other = cKDTree(place).query_pairs(near, output_type="ndarray").T
    lengths = np.linalg.norm(direction, axis=1)
    alike = np.einsum("ij,ij->i", direction[one], direction[other])
    limit = np.cos(np.radians(CROSSING_ANGLE)) * lengths[one] * lengths[other]
    return bool((alike < limit).any())
