"""Whether recordings end at a goal or go round and round, and the rounds of those that do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from iflow_gym.recordings.raw import RawRecording, RecordingError
from iflow_gym.recordings.steps import Note

Kind = Literal["auto", "goal", "cycle"]

SURE_ROUNDS = 1.8
"""What returns for so many rounds, and more, goes round and round."""

ALIKE = 0.6
"""The last round is between this and its inverse of the first one's size, and its centre within
this of the first one's, in units of the size: what shrinks or wanders off may end somewhere."""

CLOSED = 0.1
"""A recording whose ends are this close, as a fraction of its diagonal, comes back to its start."""


@dataclass(frozen=True)
class Decision:
    """What kind of motion recordings are of, and why."""

    kind: Literal["goal", "cycle"]
    reason: str
    periods: tuple[float, ...] = ()
    """Seconds a round of each recording; empty for a motion that ends."""


def decide(recordings: Sequence[RawRecording], kind: Kind = "auto") -> Decision:
    """Say what kind of motion the recordings are of, and find the periods of those that repeat.

    Raises
    ------
    RecordingError
        If ``"auto"`` cannot tell, or recordings of a cycle do not return to where they were.
    """
    if kind == "goal":
        return Decision("goal", "the caller said so")
    found = [_period(recording) for recording in recordings]
    if kind == "cycle":
        for recording, seen in zip(recordings, found, strict=True):
            if isinstance(seen, str):
                raise RecordingError(
                    f"Expected {recording.name} to go round and round, got a recording whose round "
                    f"was not found: {seen} Give the seconds a round takes (period=, --period), "
                    "leave the recording out, or say that the motion ends (--kind goal)."
                )
        periods = tuple(p for p in found if not isinstance(p, str))
        return Decision("cycle", "the caller said so", periods)
    periods = tuple(p for p in found if not isinstance(p, str))
    rounds = [
        _duration(r) / p for r, p in zip(recordings, found, strict=True) if not isinstance(p, str)
    ]
    asked = " Say which it is: --kind goal or --kind cycle (kind=)."
    if not periods:
        looped = [r for r in recordings if _ends_where_it_begins(r)]
        if looped:
            raise RecordingError(
                f"Expected to tell whether the motion ends or repeats, got {looped[0].name}, which "
                "ends where it begins and goes round once: a motion that ends at its start, or one "
                f"round of one that repeats?{asked}"
            )
        return Decision("goal", "no recording comes back to a state that it was in before")
    if len(periods) < len(found):
        raise RecordingError(
            f"Expected recordings of one kind of motion, got {len(periods)} of {len(found)} that "
            f"come back to where they were and others that do not.{asked}"
        )
    if min(rounds) < SURE_ROUNDS:
        at = recordings[int(np.argmin(rounds))]
        raise RecordingError(
            f"Expected to tell whether the motion ends or repeats, got {at.name}, which goes round "
            f"{min(rounds):.1f} times; fewer than {SURE_ROUNDS} rounds say too little.{asked}"
        )
    for recording, period in zip(recordings, periods, strict=True):
        if why := _changing(recording, period):
            raise RecordingError(
                f"Expected to tell whether the motion ends or repeats, got {recording.name}, which "
                f"goes round but {why}.{asked}"
            )
    spread = f"{min(rounds):.1f}" if len(rounds) == 1 else f"{min(rounds):.1f} to {max(rounds):.1f}"
    reason = f"every recording comes back to where it was, for {spread} rounds"
    return Decision("cycle", reason, periods)


def cut_to_rounds(recording: RawRecording, period: float) -> tuple[RawRecording, Note]:
    """Return the recording's whole rounds from its start on, where there are two or more.

    `period` is about how many seconds a round of this recording takes.
    """
    from iflow_gym.rounds import round_starts  # here: it takes scipy half a second

    step = _duration(recording) / (len(recording) - 1)
    total = _duration(recording) / period
    try:
        starts = round_starts(recording.positions, step, period)
    except ValueError as error:
        text = f"left as it is, {total:.1f} rounds of {period:.3g} s: {error}"
        return recording, Note("rounds", recording.name, text, {"rounds": total})
    values = {"rounds": total, "period_seconds": period, "kept": len(starts) - 1}
    if len(starts) < 3 or starts[-1] >= len(recording) - 1:
        text = f"{total:.1f} rounds of {period:.3g} s, all kept"
        return recording, Note("rounds", recording.name, text, {**values, "cut": 0})
    last = int(starts[-1])
    cut = len(recording) - 1 - last
    text = f"{total:.1f} rounds of {period:.3g} s, cut after {len(starts) - 1} ({cut} samples off)"
    return recording.take(slice(0, last + 1)), Note(
        "rounds", recording.name, text, {**values, "cut": cut}
    )


def _period(recording: RawRecording) -> float | str:
    """Return the seconds of a round, or why there is none."""
    from iflow_gym.rounds import period_of

    try:
        return period_of(recording.positions, _duration(recording) / (len(recording) - 1))
    except ValueError as error:
        return str(error)


def _changing(recording: RawRecording, period: float) -> str:
    """Return how the last round differs from the first; empty where they are alike."""
    n = min(round(period / _duration(recording) * (len(recording) - 1)), len(recording))
    first, last = recording.positions[:n], recording.positions[-n:]
    sizes = [
        float(np.sqrt(np.mean(np.sum((p - p.mean(axis=0)) ** 2, axis=1)))) for p in (first, last)
    ]
    if not ALIKE <= sizes[1] / sizes[0] <= 1 / ALIKE:
        return (
            f"changes its size from {sizes[0]:.3g} to {sizes[1]:.3g} between first and last round"
        )
    away = float(np.linalg.norm(last.mean(axis=0) - first.mean(axis=0)))
    return f"moves its centre by {away:.3g}" if away > ALIKE * sizes[0] else ""


def _duration(recording: RawRecording) -> float:
    return float(recording.times[-1] - recording.times[0])


def _ends_where_it_begins(recording: RawRecording) -> bool:
    gap = np.linalg.norm(recording.positions[-1] - recording.positions[0])
    return bool(gap <= CLOSED * recording.diagonal)
