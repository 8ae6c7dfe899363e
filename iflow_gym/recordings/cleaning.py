"""From recordings as they came to a set of demonstrations, with a report of all that was done."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from tyro.conf import arg

from iflow_gym.demonstrations import GOAL_TOLERANCE, Demonstrations
from iflow_gym.recordings import steps
from iflow_gym.recordings.columns import Reading, shown
from iflow_gym.recordings.kinds import Kind, cut_to_rounds, decide
from iflow_gym.recordings.raw import LEAST_SAMPLES, RawRecording, RecordingError
from iflow_gym.recordings.steps import STILL, Align, BadTimes, Missing, Note

LENGTHS = {"m": 1.0, "dm": 0.1, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "km": 1e3, "in": 0.0254}
"""Metres in units of length."""

MOST_LENGTH = 1e100
"""Of a recording's diagonal, in any unit: the square of more is no number."""


@dataclass(frozen=True)
class CleanUp:
    """What is done to recordings, in the order in which it is done; each step may be left out."""

    unit: Annotated[str | None, shown("UNIT")] = None
    """Unit of the positions that come in; by default what the headings say, else m."""
    to_unit: Annotated[str | None, shown("UNIT")] = None
    """Unit of the demonstrations; by default the same. Another one than --unit scales: both are
    among m, dm, cm, mm, um, km, in."""
    split: Annotated[float | None, shown("SECONDS")] = None
    """Cut recordings at gaps in time longer than this: several demonstrations in a file. Shorter
    gaps are bridged; without it, gaps that hide a piece of the motion are refused."""
    bad_times: BadTimes = "error"
    """Samples whose time repeats or goes back: "error" or "drop"."""
    missing: Missing = "drop"
    """Samples with NaN or nothing in them: "drop", "interpolate" or "error"."""
    trim: bool = True
    """Whether to cut off the stretches at the start and the end in which nothing moves."""
    still: Annotated[float, arg(metavar="FRACTION")] = STILL
    """What is slower than this fraction of the fast speed (95 of 100) is still."""
    resample: bool = True
    """Whether to bring uneven samples to an even grid; methods need one."""
    rate: Annotated[float | None, shown("HERTZ")] = None
    """Samples a second of that grid; by default as many samples as there are."""
    smooth: Annotated[float | None, shown("SECONDS")] = None
    """Seconds of the smoothing window (Savitzky-Golay), which gives velocities as well. 0 smooths
    nothing; by default 7 % of the recording, and nothing where samples hardly scatter."""
    kind: Kind = "auto"
    """Whether the motion ends ("goal") or repeats ("cycle"); "auto" finds out or asks."""
    goal: Annotated[tuple[float, ...] | None, shown("X Y")] = None
    """Where a motion ends, in the demonstrations' unit; by default the mean of the ends."""
    align: Align = "none"
    """Make recordings end at one goal: "shift" moves each as a whole, "bend" moves its end most and
    its start not at all, "none" leaves them and asks that they end close together."""
    goal_tolerance: Annotated[float | None, shown("LENGTH")] = None
    """How far from the goal a recording may end, in the demonstrations' unit; by default
    2 % of the diagonal."""
    period: Annotated[float | None, shown("SECONDS")] = None
    """Seconds a round; found by default."""
    cut: bool = True
    """Whether to cut recordings of cycles to whole rounds."""
    hold_out: Annotated[int, arg(metavar="N")] = 0
    """So many of the last recordings are never fitted on, by any protocol."""
    name: Annotated[str, arg(metavar="NAME")] = "motion"
    """Name of the motion, for tables and pictures; the command takes the output file's."""


@dataclass(frozen=True, eq=False)
class Cleaned:
    """What came of recordings."""

    demonstrations: Demonstrations
    notes: tuple[Note, ...]
    """What was done, in its order."""
    before: tuple[RawRecording, ...] = field(repr=False)
    """The recordings as they came, in the demonstrations' unit, times from 0."""
    after: tuple[RawRecording, ...] = field(repr=False)
    """The recordings as they are now, on the times of `before`."""

    def report(self) -> list[dict[str, Any]]:
        """Return the notes as JSON holds them."""
        return [
            {"step": n.step, "recording": n.recording, "text": n.text, **n.values}
            for n in self.notes
        ]


def clean(
    recordings: Reading | Sequence[RawRecording],
    options: CleanUp | None = None,
    *,
    source: str = "arrays",
) -> Cleaned:
    """Clean recordings and make demonstrations of them.

    Parameters
    ----------
    recordings : Reading or sequence of RawRecording
        Of one motion: what `read_recordings` returned, or recordings of the caller's own.
    options : CleanUp, optional
        What to do.
    source : str
        Where the recordings came from.

    Raises
    ------
    RecordingError
        If a recording cannot be used as the options say; the message says what to do.
    """
    chosen = CleanUp() if options is None else options
    reading = recordings if isinstance(recordings, Reading) else Reading(list(recordings))
    if not reading.recordings:
        raise RecordingError("Expected at least one recording, got none.")
    came_in = chosen.unit or reading.unit or "m"
    factor, unit = _scale(came_in, chosen.to_unit)
    before = tuple(steps.scaled(r, factor) for r in reading.recordings)
    notes: list[Note] = list(reading.notes)
    if chosen.unit is None:
        why = "as the headings say" if reading.unit else "because nothing says another (--unit)"
        notes.append(Note("units", "", f"lengths are in {came_in}, {why}", {"unit": came_in}))
    if factor != 1.0:
        text = f"scaled by {factor:g}, from {came_in} to {unit}"
        notes.append(Note("units", "", text, {"factor": factor}))
    if chosen.split is not None:
        before = _split(before, chosen.split, notes)
    done = [_cleaned(r, chosen, unit, notes) for r in before]
    if chosen.hold_out and not 0 <= chosen.hold_out < len(done):
        raise RecordingError(
            f"Expected to hold out from 0 to {len(done) - 1} recordings, one less than there are, "
            f"got {chosen.hold_out} (--hold-out)."
        )
    if len({r.n_dims for r in done}) > 1:
        dims = sorted({r.n_dims for r in done})
        raise RecordingError(
            f"Expected recordings of the same dimension, got dimensions {dims}: name the same "
            "columns of every file."
        )
    decision = decide(done, chosen.kind if chosen.period is None else "goal")
    kind = decision.kind
    if chosen.period is not None:
        if chosen.kind == "goal":
            raise RecordingError(
                f"Expected a motion that ends or one that repeats, got the kind 'goal' and a "
                f"period of {chosen.period} s: drop one."
            )
        kind = "cycle"
    if chosen.kind == "auto" and chosen.period is None:
        word = "ends at a goal" if kind == "goal" else "goes round and round"
        notes.append(Note("kind", "", f"the motion {word}: {decision.reason}", {"kind": kind}))
    period = None
    if kind == "cycle":
        if chosen.goal is not None or chosen.align != "none":
            raise RecordingError(
                "Expected a motion that repeats to have no goal, got a goal or an alignment to "
                "one: drop it, or say that the motion ends (--kind goal)."
            )
        periods = decision.periods or (float(chosen.period or 0.0),) * len(done)
        period = float(np.mean(periods))
        if not (np.isfinite(period) and period > 0):
            raise RecordingError(f"Expected a period > 0 in seconds, got {chosen.period}.")
        if chosen.cut:
            for i, own in enumerate(periods):
                done[i], note = cut_to_rounds(done[i], own)
                notes.append(note)
    else:
        goal = _goal(chosen, done[0].n_dims)
        done, moved = steps.aligned(done, chosen.align, goal, unit)
        notes += moved
        _check_ends(done, goal, chosen, unit)
    try:
        demonstrations = _demonstrations(done, chosen, unit, period, source)
    except (TypeError, ValueError) as error:
        raise RecordingError(str(error)) from error
    return Cleaned(demonstrations, tuple(notes), before, tuple(done))


def _split(
    recordings: Sequence[RawRecording], seconds: float, notes: list[Note]
) -> tuple[RawRecording, ...]:
    """Return the pieces of all recordings, times from 0, and append what was split."""
    done: list[RawRecording] = []
    for recording in recordings:
        pieces, note = steps.split_at_gaps(recording, seconds)
        done += [steps.scaled(p) for p in pieces]
        notes += [note] if note is not None else []
    return tuple(done)


def _cleaned(
    recording: RawRecording, chosen: CleanUp, unit: str, notes: list[Note]
) -> RawRecording:
    """Return what concerns one recording alone done to it, and append what was done."""

    def noted(done: tuple[RawRecording, Note | None]) -> RawRecording:
        if done[1] is not None:
            notes.append(done[1])
        return done[0]

    recording = noted(steps.in_order(recording, chosen.bad_times))
    if chosen.split is None:
        with np.errstate(over="ignore"):  # what is too large is told below
            steps.check_gaps(recording)
    recording = noted(steps.without_gaps(recording, chosen.missing))
    if len(recording) < LEAST_SAMPLES:
        raise RecordingError(
            f"Expected at least {LEAST_SAMPLES} samples of {recording.name}, got {len(recording)}."
        )
    with np.errstate(over="ignore"):
        diagonal = recording.diagonal
    if not diagonal < MOST_LENGTH:
        raise RecordingError(
            f"Expected {recording.name} to go no farther than {MOST_LENGTH:g}, got {diagonal:g}: "
            "look at the columns and at the file."
        )
    if chosen.trim:
        if not (np.isfinite(chosen.still) and 0 <= chosen.still < 1):
            raise RecordingError(f"Expected still from 0 to below 1, got {chosen.still}.")
        recording = noted(steps.trimmed(recording, chosen.still))
    rough = steps.scatter(recording)
    if chosen.resample:
        recording = noted(steps.resampled(recording, chosen.rate))
    else:
        _, note = steps.resampled(recording)
        if note is not None:
            raise RecordingError(
                f"Expected even samples of {recording.name}, because resampling was left out; they "
                f"are {note.values['least_step_seconds']:.3g} to "
                f"{note.values['longest_step_seconds']:.3g} s apart: resample them (leave out "
                "--no-resample)."
            )
    return noted(steps.smoothed(recording, chosen.smooth, rough, unit))


def _scale(unit: str, to_unit: str | None) -> tuple[float, str]:
    if to_unit is None or to_unit == unit:
        return 1.0, unit
    for name in (unit, to_unit):
        if name not in LENGTHS:
            raise RecordingError(
                f"Expected a unit of length to convert, one of {', '.join(LENGTHS)}, got {name!r}."
            )
    return LENGTHS[unit] / LENGTHS[to_unit], to_unit


def _goal(chosen: CleanUp, n_dims: int) -> np.ndarray[Any, np.dtype[np.float64]] | None:
    if chosen.goal is None:
        return None
    goal = np.array(chosen.goal, dtype=np.float64)
    if goal.shape != (n_dims,) or not np.isfinite(goal).all():
        raise RecordingError(
            f"Expected a goal of {n_dims} numbers, as the recordings have coordinates, got "
            f"{list(chosen.goal)}."
        )
    return goal


def _check_ends(
    done: Sequence[RawRecording],
    goal: np.ndarray[Any, np.dtype[np.float64]] | None,
    chosen: CleanUp,
    unit: str,
) -> None:
    ends = np.stack([r.positions[-1] for r in done])
    target = ends.mean(axis=0) if goal is None else goal
    samples = np.concatenate([r.positions for r in done])
    diagonal = float(np.linalg.norm(np.ptp(samples, axis=0)))
    if chosen.goal_tolerance is not None and not chosen.goal_tolerance >= 0:
        raise RecordingError(f"Expected a goal tolerance >= 0, got {chosen.goal_tolerance}.")
    allowed = GOAL_TOLERANCE * diagonal if chosen.goal_tolerance is None else chosen.goal_tolerance
    away = np.linalg.norm(ends - target, axis=1)
    if away.max() > allowed:
        raise RecordingError(
            f"Expected the recordings to end within {allowed:.3g} {unit} of one goal, "
            f"{np.array2string(target, precision=4)}, got {done[int(away.argmax())].name}, which "
            f"ends {away.max():.3g} {unit} away: make them end there (--align shift moves them, "
            "--align bend keeps their starts), give the goal (--goal), or accept the spread "
            "(--goal-tolerance). Of a motion that repeats say --kind cycle."
        )


def _demonstrations(
    done: Sequence[RawRecording], chosen: CleanUp, unit: str, period: float | None, source: str
) -> Demonstrations:
    speeds = [r.velocities for r in done]
    given = [s for s in speeds if s is not None]
    if 0 < len(given) < len(done):  # some are smoothed, some are not
        given = [
            np.gradient(r.positions, r.times, axis=0) if s is None else s
            for r, s in zip(done, speeds, strict=True)
        ]
    return Demonstrations.from_arrays(
        [r.positions for r in done],
        dt=[float(r.times[-1] - r.times[0]) / (len(r) - 1) for r in done],
        velocities=given or None,
        goal=None if period is not None or chosen.goal is None else list(chosen.goal),
        goal_tolerance=None if period is not None else chosen.goal_tolerance,
        period=period,
        name=chosen.name,
        length_unit=unit,
        source=source,
        held_out=chosen.hold_out,
    )
