"""What a person does to a recording before anything learns from it, one function a step.

Each takes a recording and returns the new one and a `Note` of what was done, or None where there
was nothing to do. Nothing is done in silence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from iflow_gym.demonstrations import UNEVEN_TOLERANCE, FloatArray
from iflow_gym.recordings.raw import LEAST_SAMPLES, RawRecording, RecordingError

Missing = Literal["drop", "interpolate", "error"]
BadTimes = Literal["error", "drop"]
Align = Literal["none", "shift", "bend"]

STILL = 0.03
"""What is slower than this fraction of the recording's fast speed counts as still."""

FAST = 95.0
"""Percentile of the speed that counts as fast."""

LEAST_WAY = 0.01
"""What leads no further than this fraction of the diagonal is no part of the motion by itself."""

SCATTERS = 5.0
"""Nor what leads no further than so many times the scatter of the samples."""

SCATTER = 5e-4
"""Samples that scatter by more than this fraction of the diagonal are smoothed by themselves."""

SHARE = 0.07
"""Window of that smoothing, as a fraction of the recording's duration, at most."""

MOVES = 1.5
"""It is narrowed until it moves samples by no more than so many times their scatter: what it moves
beyond that is the motion. A recording of many rounds is cut off at its corners otherwise."""

MOST_CUT = 0.25
"""What leads over more than this fraction of the diagonal is a motion, however slow it is."""

GAP_SAMPLES = 30
"""A sensor loses a few samples in a row; a gap of more sample times than these is looked at."""

GAP_SHARE = 0.1
"""A gap of more than this fraction of the longest stretch without one hides a piece of the motion
that a cubic cannot know: from a tenth of a motion on, samples of a whole turn may be lost."""

ORDER = 3
"""Of the polynomials of Savitzky and Golay."""


@dataclass(frozen=True)
class Note:
    """What a step did to a recording."""

    step: str
    """Name of the step."""
    recording: str
    """Name of the recording; empty for all of them."""
    text: str
    """What was done, in words."""
    values: dict[str, Any] = field(default_factory=dict)
    """The same in numbers."""

    def __str__(self) -> str:
        return f"{self.recording}: {self.text}" if self.recording else self.text


def in_order(
    recording: RawRecording, bad_times: BadTimes = "error"
) -> tuple[RawRecording, Note | None]:
    """Return the samples whose time is later than that of all before.

    A sample without a time stamp is left to `without_gaps`.

    Raises
    ------
    RecordingError
        If a time repeats or goes back, unless `bad_times` is ``"drop"``.
    """
    stamps = np.where(np.isfinite(recording.times), recording.times, -np.inf)
    before = np.maximum.accumulate(np.concatenate([[-np.inf], stamps[:-1]]))
    bad = np.isfinite(recording.times) & (stamps <= before) & np.isfinite(before)
    if not bad.any():
        return recording, None
    repeated = int((stamps[bad] == before[bad]).sum())
    backward = int(bad.sum()) - repeated
    at = int(np.argmax(bad))
    counts = " and ".join(
        f"{n} {what}" for n, what in ((repeated, "repeated"), (backward, "backward")) if n
    )
    if bad_times == "error":
        raise RecordingError(
            f"Expected increasing times in {recording.name}, got {counts} among {len(recording)} "
            f"time stamps, the first at sample {at}: {recording.times[at]:g} s after "
            f"{before[at]:g} s. Look whether two recordings are in one column (name the column "
            "that tells them apart), or drop these samples (--bad-times drop)."
        )
    note = Note(
        "times",
        recording.name,
        f"dropped {bad.sum()} of {len(recording)} samples by their times: {counts}",
        {"repeated": repeated, "backward": backward},
    )
    return recording.take(~bad), note


def split_at_gaps(
    recording: RawRecording, seconds: float
) -> tuple[list[RawRecording], Note | None]:
    """Return the pieces between gaps in time that are longer than so many seconds."""
    if not seconds > 0:
        raise RecordingError(f"Expected gaps > 0 in seconds to split at (--split), got {seconds}.")
    rows = np.flatnonzero(recording.whole)
    gaps = _gaps(recording)
    wide = gaps > seconds
    if not wide.any():
        return [recording], None
    edges = [0, *(rows[1:][wide]), len(recording)]
    pieces = [
        replace(recording.take(slice(begin, end)), name=f"{recording.name}, part {i}")
        for i, (begin, end) in enumerate(pairwise(edges), start=1)
    ]
    count, least, most = int(wide.sum()), float(gaps[wide].min()), float(gaps[wide].max())
    long = (
        f"a gap of {most:.3g} s" if count == 1 else f"{count} gaps of {least:.3g} to {most:.3g} s"
    )
    values = {"recordings": len(pieces), "least_gap_seconds": least, "longest_gap_seconds": most}
    return pieces, Note("split", recording.name, f"split in {len(pieces)} at {long}", values)


def check_gaps(recording: RawRecording) -> None:
    """Raise RecordingError for a gap in time out of all proportion, across which something moved.

    That is one of more than `GAP_SAMPLES` sample times (the median) and `GAP_SHARE` of the longest
    stretch without one. Where nothing moved across it, a recorder that writes changes only was
    waiting. Call `in_order` first.
    """
    kept = recording.take(recording.whole)
    gaps = _gaps(recording)
    if len(gaps) < LEAST_SAMPLES:
        return
    usual = float(np.median(gaps))
    wide = np.flatnonzero(gaps > GAP_SAMPLES * usual)
    ends = kept.times[np.concatenate([wide, [len(kept) - 1]])]
    stretch = float((ends - kept.times[np.concatenate([[0], wide + 1])]).max())
    way = np.linalg.norm(kept.positions[wide + 1] - kept.positions[wide], axis=1)
    wide = wide[(gaps[wide] > GAP_SHARE * stretch) & (way > LEAST_WAY * recording.diagonal)]
    if not len(wide):
        return
    at = wide[int(np.argmax(gaps[wide]))]
    several = f"{len(wide)} gaps, the longest" if len(wide) > 1 else "a gap"
    begin, end = kept.times[at], kept.times[at + 1]
    raise RecordingError(
        f"Expected samples of one motion in {recording.name}, some {usual:.3g} s apart, got "
        f"{several} of {gaps[at]:.3g} s, from {begin:.5g} to {end:.5g} s, in which the position "
        "changed: what happened there nobody knows. If these are several recordings, split them "
        f"there (--split {_one_digit(gaps[wide].min() / 2):g}) or name the column that tells them "
        "apart (--group); to bridge gaps, split at longer ones only "
        f"(--split {_one_digit(gaps[at], 1):g})."
    )


def _gaps(recording: RawRecording) -> FloatArray:
    """Return the seconds from the latest whole sample so far to each that follows."""
    times = recording.times[recording.whole]
    return np.asarray(times[1:] - np.maximum.accumulate(times)[:-1])


def _one_digit(value: float, more: int = 0) -> float:
    """Return a value cut to its first digit, or so much more in that digit."""
    digit = 10 ** np.floor(np.log10(value))
    return float((np.floor(value / digit) + more) * digit)


def without_gaps(
    recording: RawRecording, missing: Missing = "drop"
) -> tuple[RawRecording, Note | None]:
    """Return the samples with none missing: dropped, or interpolated in time.

    A missing time stamp cannot be interpolated: its sample goes either way, and so do missing
    samples at either end. Call `in_order` first.

    Raises
    ------
    RecordingError
        If `missing` is ``"error"`` and there are any, or if hardly any sample is whole.
    """
    whole = recording.whole
    if whole.all():
        return recording, None
    n, lost = len(recording), int((~whole).sum())
    first = int(np.argmin(whole))
    if missing == "error" or n - lost < LEAST_SAMPLES:
        raise RecordingError(
            f"Expected whole samples in {recording.name}, got {lost} of {n} with NaN, infinity or "
            f"nothing in them, the first at sample {first}."
            + (
                " Drop or interpolate them (--missing drop, --missing interpolate)."
                if n - lost >= LEAST_SAMPLES
                else f" At least {LEAST_SAMPLES} whole ones are needed: look at the columns' names."
            )
        )
    kept = recording.take(whole)
    gap = float(np.diff(kept.times).max())
    ends = np.flatnonzero(whole)[[0, -1]]
    inner = np.isfinite(recording.times) & ~whole
    inner &= (np.arange(n) > ends[0]) & (np.arange(n) < ends[1])
    values = {"missing": lost, "first": first, "longest_gap_seconds": gap}
    if missing == "drop" or not inner.any():
        text = f"dropped {lost} of {n} samples that were not whole; the longest gap is {gap:.3g} s"
        return kept, Note("missing", recording.name, text, {**values, "interpolated": 0})
    rows = whole | inner
    times = recording.times[rows]
    filled = RawRecording(
        recording.name,
        times,
        _interpolated(kept.positions, kept.times, times),
        None if kept.velocities is None else _interpolated(kept.velocities, kept.times, times),
    )
    count = int(inner.sum())
    text = f"interpolated {count} samples of {n} that were not whole"
    if lost > count:
        text += f", dropped {lost - count} at the ends or without a time"
    text += f"; the longest gap was {gap:.3g} s"
    return filled, Note("missing", recording.name, text, {**values, "interpolated": count})


def trimmed(recording: RawRecording, still: float = STILL) -> tuple[RawRecording, Note | None]:
    """Return the samples from where the motion begins to where it ends.

    What is slower than `still` times the fast speed is still, and so is what the samples' scatter
    does not let tell from it, three deviations of a slope. The speed is that of a parabola
    through a twenty-fifth of the recording (Savitzky and Golay, Analytical Chemistry 36(8), 1964).
    Of samples that scatter a still hand seems to move now and then: what leads no further than
    `LEAST_WAY` of the diagonal, or `SCATTERS` times the scatter, counts as still as well. Pauses
    within the motion stay.
    """
    from scipy.signal import savgol_filter

    n = len(recording)
    window = _odd(max(n / 25, 5))
    if n < 3 * window:
        return recording, None
    grid = np.linspace(recording.times[0], recording.times[-1], n)
    path = _interpolated(recording.positions, recording.times, grid)
    step = float(grid[1] - grid[0])
    slopes = savgol_filter(path, window, 2, deriv=1, delta=step, axis=0)
    smooth = savgol_filter(path, window, 2, axis=0)
    speed = np.linalg.norm(slopes, axis=1)
    rough = scatter(recording)
    # Of a straight line through m samples that scatter by s, the slope scatters by this.
    noise = rough * np.sqrt(12 / window**3) / step
    usual = float(np.percentile(speed, FAST))
    least_speed = max(still * usual, 3 * noise)
    fast = speed > least_speed
    edges = np.flatnonzero(np.diff(np.concatenate([[False], fast, [False]]).astype(np.int8)))
    least = max(LEAST_WAY * recording.diagonal, SCATTERS * rough)
    runs = [
        (begin, end)
        for begin, end in edges.reshape(-1, 2)
        if np.linalg.norm(np.ptp(smooth[begin:end], axis=0)) > least
    ]
    if not runs:
        return recording, None
    moving = (runs[0][0], runs[-1][1] - 1)
    half = step / 2
    inside = recording.times >= grid[moving[0]] - half
    inside &= recording.times <= grid[moving[-1]] + half
    start, end = int(np.argmax(inside)), int(np.argmax(inside[::-1]))
    if start + end == 0 or inside.sum() < LEAST_SAMPLES:
        return recording, None
    kept = recording.take(slice(start, n - end))
    cut = [recording.take(slice(0, start + 1)), recording.take(slice(n - end - 1, n))]
    share = max(r.diagonal for r in cut) / recording.diagonal
    if share > MOST_CUT:
        raise RecordingError(
            f"Expected still stretches to cut off {recording.name}, got {start + end} of {n} "
            f"samples below {still:g} of the fast speed, which lead over {share:.0%} of its "
            "diagonal: count less as still (--still 0.03 by default), or cut nothing off "
            "(--no-trim)."
        )
    times = recording.times
    seconds = (float(times[start] - times[0]), float(times[-1] - times[n - 1 - end]))
    parts = [
        f"{count} samples ({long:.2g} s) at the {where}"
        for count, long, where in zip((start, end), seconds, ("start", "end"), strict=True)
        if count
    ]
    values = {"start": start, "end": end, "start_seconds": seconds[0], "end_seconds": seconds[1]}
    why = "still"
    if least_speed > still * usual:
        why = (
            f"slower than {least_speed / usual:.0%} of the fast speed, where its scatter hides "
            f"whether it moves; they lead over {share:.1%} of its diagonal (--no-trim keeps them)"
        )
    return kept, Note("trim", recording.name, f"trimmed {' and '.join(parts)}: {why}", values)


def resampled(
    recording: RawRecording, rate: float | None = None
) -> tuple[RawRecording, Note | None]:
    """Return the recording on an even grid of times, with cubics that do not overshoot.

    Parameters
    ----------
    recording : RawRecording
        Whole and in order.
    rate : float, optional
        Samples a second; by default as many samples as there are.

    Notes
    -----
    The interpolant is Fritsch and Carlson's, "Monotone piecewise cubic interpolation", SIAM
    Journal on Numerical Analysis 17(2), 1980. What is even already stays as it is, bit for bit.
    """
    from scipy.interpolate import PchipInterpolator

    times = recording.times
    duration = float(times[-1] - times[0])
    steps = np.diff(times)
    mean = duration / len(steps)
    uneven = bool(np.abs(steps - mean).max() > UNEVEN_TOLERANCE * mean)
    if rate is None and not uneven:
        return recording, None
    if rate is not None and not (np.isfinite(rate) and rate > 0):
        raise RecordingError(f"Expected a rate > 0 in samples a second, got {rate}.")
    n = len(recording) if rate is None else round(duration * rate) + 1
    if not LEAST_SAMPLES <= n <= 10_000_000:
        raise RecordingError(
            f"Expected a rate that leaves {LEAST_SAMPLES} to 10 million samples of "
            f"{recording.name}, which lasts {duration:.3g} s, got {n} by {rate:g} a second."
        )
    # With a rate the last sample lies beside the recording's, by half a step at most: the grid is
    # stretched to end there, because that is where the motion ends.
    grid = np.linspace(times[0], times[-1], n)

    def on_grid(values: FloatArray) -> FloatArray:
        return np.asarray(PchipInterpolator(times, values, axis=0)(grid))

    speeds = None if recording.velocities is None else on_grid(recording.velocities)
    even = RawRecording(recording.name, grid, on_grid(recording.positions), speeds)
    step = float(grid[1] - grid[0])
    was = f"{steps.min():.3g} to {steps.max():.3g} s" if uneven else f"{mean:.3g} s"
    text = f"resampled from {len(recording)} samples {was} apart to {n} every {step:.4g} s"
    values = {
        "samples_before": len(recording),
        "samples": n,
        "step_seconds": step,
        "least_step_seconds": float(steps.min()),
        "longest_step_seconds": float(steps.max()),
    }
    return even, Note("resample", recording.name, text, values)


def scatter(recording: RawRecording) -> float:
    """Return by how much samples scatter about a smooth motion, in the recording's length.

    The robust standard deviation of each sample from the cubic through its two neighbours on either
    side, over all coordinates. Of a whole recording in order; 0 where there are too few samples.
    """
    t, x = recording.times, recording.positions
    if len(t) < LEAST_SAMPLES:
        return 0.0
    at = t[2:-2]
    near = np.stack([t[:-4], t[1:-3], t[3:-1], t[4:]])
    weights = np.ones_like(near)
    for i in range(4):
        for j in range(4):
            if i != j:
                weights[i] *= (at - near[j]) / (near[i] - near[j])
    points = np.stack([x[:-4], x[1:-3], x[3:-1], x[4:]])
    away = x[2:-2] - np.einsum("in,ind->nd", weights, points)
    away /= np.sqrt(1 + (weights**2).sum(axis=0))[:, None]
    return float(1.4826 * np.linalg.norm(np.median(np.abs(away), axis=0)))


def smoothed(
    recording: RawRecording,
    window: float | None = None,
    roughness: float | None = None,
    unit: str = "",
) -> tuple[RawRecording, Note | None]:
    """Return the recording with positions and velocities of cubics fitted to a moving window.

    Savitzky and Golay, "Smoothing and differentiation of data by simplified least squares
    procedures", Analytical Chemistry 36(8), 1964.

    Parameters
    ----------
    recording : RawRecording
        Evenly sampled.
    window : float, optional
        Seconds; 0 smooths nothing. By default `SHARE` of the duration, less where that would move
        samples by more than `MOVES` times their scatter, and nothing for samples that scatter by
        less than `SCATTER` of the diagonal.
    roughness : float, optional
        What `scatter` says of the recording before it was resampled; by default of this one.
    unit : str
        Of length, for the note.

    Notes
    -----
    Velocities are the cubics' slopes; recorded ones are smoothed in the same way instead.
    """
    from scipy.signal import savgol_filter

    n = len(recording)
    times = recording.times
    step = float(times[-1] - times[0]) / (n - 1)
    rough = scatter(recording) if roughness is None else roughness
    if window is None:
        if rough <= SCATTER * recording.diagonal:
            return recording, None
        samples = _odd(max(SHARE * n, 7))
        samples = samples if samples <= n else _odd(n - 1, down=True)
        while samples > ORDER + 2:
            straight = savgol_filter(recording.positions, samples, ORDER, axis=0)
            off = np.linalg.norm(straight - recording.positions, axis=1)
            if np.sqrt(np.mean(off**2)) <= MOVES * rough:
                break
            samples = _odd(0.8 * samples, down=True)
    elif not (np.isfinite(window) and window >= 0):
        raise RecordingError(f"Expected a smoothing window >= 0 in seconds, got {window}.")
    elif window == 0:
        return recording, None
    else:
        samples = _odd(window / step)
        if samples > n:
            raise RecordingError(
                f"Expected a smoothing window shorter than {recording.name}, which lasts "
                f"{(n - 1) * step:.3g} s, got {window:g} s."
            )
    if samples <= ORDER + 1:
        if window is None:
            return recording, None
        raise RecordingError(
            f"Expected a smoothing window of {ORDER + 2} samples at least, {(ORDER + 2) * step:.3g}"
            f" s of {recording.name}, got {window:g} s; 0 smooths nothing."
        )

    def filtered(values: FloatArray, order: int = 0) -> FloatArray:
        return np.asarray(savgol_filter(values, samples, ORDER, deriv=order, delta=step, axis=0))

    positions = filtered(recording.positions)
    speeds = filtered(recording.positions, 1)
    if recording.velocities is not None:
        speeds = filtered(recording.velocities)
    moved = np.linalg.norm(positions - recording.positions, axis=1)
    rms, most = float(np.sqrt(np.mean(moved**2))), float(moved.max())
    own = unit and f" {unit}"
    text = (
        f"smoothed by cubics over {samples * step:.3g} s ({samples} samples), which moved samples "
        f"by {rms:.3g}{own} RMS and {most:.3g}{own} at most; they scattered by {rough:.3g}{own}"
    )
    values = {
        "window_seconds": samples * step,
        "window_samples": samples,
        "moved_rms": rms,
        "moved_most": most,
        "scatter": rough,
    }
    smooth = replace(recording, positions=positions, velocities=speeds)
    return smooth, Note("smooth", recording.name, text, values)


def scaled(
    recording: RawRecording, length: float = 1.0, time: float = 1.0, zero: bool = True
) -> RawRecording:
    """Return the recording in other units: lengths and times are multiplied.

    Times begin at 0, unless `zero` is false.
    """
    times = recording.times
    if zero and np.isfinite(times).any():
        times = times - times[np.isfinite(times)][0]
    speeds = recording.velocities
    return RawRecording(
        recording.name,
        times * time,
        recording.positions * length,
        None if speeds is None else speeds * (length / time),
    )


def aligned(
    recordings: Sequence[RawRecording], how: Align, goal: FloatArray | None = None, unit: str = ""
) -> tuple[list[RawRecording], list[Note]]:
    """Return recordings that all end at one goal.

    Parameters
    ----------
    recordings : sequence of RawRecording
    how : str
        ``"shift"`` moves a whole recording; ``"bend"`` moves its end, less and less towards its
        start, in proportion to the way covered; ``"none"`` nothing.
    goal : array, shape (d,), optional
        By default the mean of the ends.
    unit : str
        Of length, for the notes.
    """
    if how == "none":
        return list(recordings), []
    ends = np.stack([r.positions[-1] for r in recordings])
    target = ends.mean(axis=0) if goal is None else goal
    done, notes = [], []
    for recording, end in zip(recordings, ends, strict=True):
        offset = target - end
        far = float(np.linalg.norm(offset))
        if far == 0:
            done.append(recording)
            continue
        share = np.ones(len(recording))
        speeds = recording.velocities
        if how == "bend":
            strides = np.linalg.norm(np.diff(recording.positions, axis=0), axis=1)
            way = np.concatenate([[0.0], np.cumsum(strides)])
            share = way / way[-1] if way[-1] > 0 else share
            if speeds is not None:
                speeds = speeds + np.gradient(share, recording.times)[:, None] * offset
        positions = recording.positions + share[:, None] * offset
        positions[-1] = target
        done.append(replace(recording, positions=positions, velocities=speeds))
        word = "shifted" if how == "shift" else "bent"
        text = f"{word} by {far:.4g}{unit and f' {unit}'} to end at the goal"
        notes.append(Note("align", recording.name, text, {"how": how, "distance": far}))
    return done, notes


def _interpolated(values: FloatArray, times: FloatArray, at: FloatArray) -> FloatArray:
    return np.stack([np.interp(at, times, column) for column in values.T], axis=1)


def _odd(value: float, *, down: bool = False) -> int:
    """Return an odd whole number next to a value."""
    count = round(value)
    return count if count % 2 else count + (-1 if down else 1)
