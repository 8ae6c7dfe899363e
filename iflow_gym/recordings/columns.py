"""Which columns of a table, or arrays of a file, are time, positions, velocities and recording.

What the caller does not name is guessed by the names that people use, and the guess is reported.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from tyro.conf import arg

from iflow_gym.demonstrations import FloatArray
from iflow_gym.recordings.raw import RawRecording, RecordingError
from iflow_gym.recordings.steps import Note, scaled

SLOW = 1.0
"""Seconds between samples from which a unit that nothing says is doubted."""

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0}
"""Seconds in units of time."""

LENGTH_UNITS = ("m", "dm", "cm", "mm", "um", "km", "in", "px")
"""Units that a heading may state."""

TIMES = ("t", "time", "times", "timestamp", "timestamps", "stamp", "sec", "secs", "seconds")
GROUPS = (
    "demo", "demos", "demonstration", "recording", "trial", "episode", "repetition", "rep",
    "stroke",
)  # fmt: skip
STACKS = (
    "positions", "position", "pos", "x", "points", "path", "paths", "trajectory", "trajectories",
    "demos", "data", "q",
)  # fmt: skip
"""Names of arrays of positions, from the likeliest on."""
SPEEDS = ("velocities", "velocity", "vel", "v", "dx", "xd", "dq", "qd")

_AXES = re.compile(r"(?:(?:p|pos|position|positions)[._ ]?)?([xyz])")
_NUMBERED = re.compile(r"(?:x|p|q|joint|pos|position|positions)[._ ]?(\d+)")
_SPEED_AXES = re.compile(r"(?:d|v|vel|velocity|velocities)[._ ]?([xyz])")
_SPEED_NUMBERED = re.compile(r"(?:v|dx|dq|qd|vel|velocity|velocities)[._ ]?(\d+)")
_UNIT = re.compile(r"(.*?)[ _]*(?:[\[(/] *([A-Za-zµ]+) *[\])]?|_(s|ms|us|ns|mm|cm))")


def shown(metavar: str) -> Any:
    """Return how the command's help shows an option whose text says what its default is."""
    return arg(metavar=metavar, help_behavior_hint=lambda default: "")


MOST_GUESSED = 12
"""Columns that are taken to be coordinates where no name says so."""

Column = np.ndarray[Any, Any]
"""Numbers, nan for what is missing, or words (of the column that tells recordings apart)."""


@dataclass(frozen=True)
class Columns:
    """What is what in a file; whatever is None is guessed by its name."""

    time: Annotated[str | None, shown("COLUMN")] = None
    """Column or array of the time stamps."""
    positions: Annotated[tuple[str, ...] | None, shown("COLUMN...")] = None
    """Columns of the coordinates, or one array of shape (samples, dimensions)."""
    velocities: Annotated[tuple[str, ...] | None, shown("COLUMN...")] = None
    """Columns of the velocities, or one array; nothing after it: take none, estimate them."""
    group: Annotated[str | None, shown("COLUMN")] = None
    """Column that tells the recordings in a file apart, of numbers or words."""
    time_unit: Annotated[str | None, shown("UNIT")] = None
    """Unit of the time stamps: s, ms, us, ns, min; by default what the heading says, else s."""
    dt: Annotated[float | None, shown("SECONDS")] = None
    """Seconds a sample, for files without time stamps."""
    delimiter: Annotated[str | None, shown("CHARACTER")] = None
    """Of a text file; found by default."""
    topic: Annotated[str | None, shown("TOPIC")] = None
    """Of a ROS 2 bag."""

    def __post_init__(self) -> None:
        if self.time_unit not in (None, *SECONDS):
            raise RecordingError(
                f"Expected a unit of time, one of {', '.join(SECONDS)}, got {self.time_unit!r}."
            )
        if self.dt is not None and not (np.isfinite(self.dt) and self.dt > 0):
            raise RecordingError(f"Expected dt > 0 in seconds, got {self.dt}.")
        if self.time is not None and self.dt is not None:
            raise RecordingError(
                f"Expected time stamps or a sample time, got the column {self.time!r} and dt = "
                f"{self.dt}: drop one."
            )


@dataclass(frozen=True, eq=False)
class Reading:
    """What was read."""

    recordings: list[RawRecording] = field(default_factory=list)
    notes: list[Note] = field(default_factory=list)
    """What was taken for what."""
    unit: str | None = None
    """Unit of length that the headings state, if they do."""

    def __add__(self, other: Reading) -> Reading:
        if None not in (self.unit, other.unit) and self.unit != other.unit:
            raise RecordingError(
                f"Expected recordings of one unit, got {self.unit} and {other.unit}: import them "
                "one by one and scale them (--unit, --to-unit)."
            )
        recordings = [*self.recordings, *other.recordings]
        return Reading(recordings, [*self.notes, *other.notes], self.unit or other.unit)


def from_table(
    table: Mapping[str, Column], columns: Columns, name: str, lines: Sequence[int] | None = None
) -> Reading:
    """Make recordings of named columns of one length; the samples' lines in a text are for errors.

    Raises
    ------
    RecordingError
        If a column is missing or holds no numbers, or none can be guessed.
    """
    names = list(table)
    plain = {n: _plain(n) for n in names}
    time = columns.time
    if time is not None:
        time = _known(time, names, name)
    elif columns.dt is None:
        time = next((n for n in names if plain[n][0] in TIMES), None)
    group = columns.group
    if group is not None:
        group = _known(group, names, name)
    else:
        group = next((n for n in names if plain[n][0] in GROUPS), None)
    taken = {time, group}
    speeds = columns.velocities
    if speeds is not None:
        speeds = tuple(_known(c, names, name) for c in speeds)
    else:
        speeds = _guess(plain, taken, _SPEED_AXES, _SPEED_NUMBERED)
    positions = columns.positions
    if positions is not None:
        positions = tuple(_known(c, names, name) for c in positions)
    else:
        positions = _guess(plain, {*taken, *speeds}, _AXES, _NUMBERED)
    if not positions:
        left = [n for n in names if n not in {*taken, *speeds} and table[n].dtype.kind == "f"]
        if not 1 <= len(left) <= MOST_GUESSED:
            raise RecordingError(
                f"Expected coordinates in {name}, such as x, y, got the columns "
                f"{', '.join(names[:20])}: name those of the positions (--positions)."
            )
        positions = tuple(left)
    dropped_speeds: tuple[str, ...] = ()
    if columns.velocities is None and speeds and len(speeds) != len(positions):
        dropped_speeds, speeds = speeds, ()
    points = _numbers(table, positions, name, lines)
    moving = _numbers(table, speeds, name, lines) if speeds else None
    if moving is not None and moving.shape != points.shape:
        raise RecordingError(
            f"Expected a velocity for each of the positions {', '.join(positions)} of {name}, got "
            f"{', '.join(speeds)}."
        )
    said = plain[time][1] if time is not None else None
    told = columns.time_unit or (said if said in SECONDS else None)
    unit = told or "s"
    stamps = None if time is None else _numbers(table, (time,), name, lines)[:, 0]
    headless = names == [str(i) for i in range(len(names))]
    recordings = []
    for label, rows in _groups(table, group, name, lines):
        word = "recording" if headless and group is not None else group
        own = f"{name}, {word} {label}" if group is not None else name
        chosen = points[rows]
        part = stamps[rows] if stamps is not None else None
        times = _times(part, len(chosen), columns, own, names)
        recording = RawRecording(own, times, chosen, None if moving is None else moving[rows])
        recordings.append(
            _in_seconds(recording, SECONDS[unit]) if stamps is not None else recording
        )
    left_out = [n for n in names if n not in {time, group, *positions, *speeds}]
    text = _said(time, unit, columns.dt, positions, speeds, group, left_out)
    text += _doubt(told, recordings) if stamps is not None else ""
    if dropped_speeds:
        text += f" ({', '.join(dropped_speeds)}: no velocity for each coordinate)"
    values = {
        "time": time,
        "positions": list(positions),
        "velocities": list(speeds),
        "group": group,
        "left_out": left_out,
    }
    lengths = {plain[p][1] for p in positions if plain[p][1] in LENGTH_UNITS}
    return Reading(
        recordings,
        [Note("columns", name, text, values)],
        lengths.pop() if len(lengths) == 1 else None,
    )


def from_arrays(arrays: Mapping[str, np.ndarray[Any, Any]], columns: Columns, name: str) -> Reading:
    """Make recordings of named arrays.

    Either columns of one length, as `from_table` takes, or positions of shape (samples, d), of
    several recordings (recordings, samples, d), or ``positions.0``, ``positions.1``; times,
    velocities and the sample time ``dt`` in the same way. Matrices with samples as columns, as in
    MATLAB, are turned.

    Raises
    ------
    RecordingError
        If there are no positions among them.
    """
    numbers = {
        k: np.asarray(a, dtype=np.float64)
        for k, a in arrays.items()
        if np.asarray(a).dtype.kind in "fiub"
    }
    chosen = columns.positions
    if chosen is not None and len(chosen) == 1 and chosen[0] in numbers:
        keys = [chosen[0]]
    else:
        keys = [] if chosen is not None else _stack_names(numbers)
    if not keys or all(numbers[k].ndim == 1 or 1 in numbers[k].shape for k in keys):
        return _table_of(arrays, numbers, columns, name)
    result = Reading()
    for key in keys:
        number = re.search(r"[._ ]?\d+$", key)
        suffix = number[0] if number else ""
        result = result + _stack(key, suffix, numbers, arrays, columns, name, len(keys) > 1)
    return result


# Tables ---------------------------------------------------------------------------------------


def _table_of(
    arrays: Mapping[str, np.ndarray[Any, Any]],
    numbers: Mapping[str, FloatArray],
    columns: Columns,
    name: str,
) -> Reading:
    flat = {k: a.reshape(-1) for k, a in numbers.items() if a.size == max(a.shape, default=0)}
    words = {
        k: np.asarray(a).reshape(-1)
        for k, a in arrays.items()
        if np.asarray(a).dtype.kind == "U" and np.asarray(a).ndim >= 1
    }
    sizes = [a.size for a in flat.values() if a.size > 1]
    n = max(set(sizes), key=sizes.count) if sizes else 0
    table: dict[str, Column] = {k: a for k, a in (flat | words).items() if a.size == n}
    if n < 2 or not table:
        shapes = ", ".join(f"{k} {np.shape(a)}" for k, a in list(arrays.items())[:12]) or "nothing"
        raise RecordingError(
            f"Expected positions in {name}, an array of shape (samples, dimensions) or columns of "
            f"one length, got {shapes}: name the array (--positions)."
        )
    if columns.dt is None and "dt" in flat and flat["dt"].size == 1:
        found = next((k for k in table if _plain(k)[0] in TIMES), None)
        if found is None and columns.time is None:
            columns = _with_dt(columns, float(flat["dt"][0]))
    return from_table(table, columns, name)


def _stack(
    key: str,
    suffix: str,
    numbers: Mapping[str, FloatArray],
    arrays: Mapping[str, np.ndarray[Any, Any]],
    columns: Columns,
    name: str,
    several: bool,
) -> Reading:
    """Return the recordings of an array of positions, and of its times and velocities."""
    points = numbers[key]
    label = f"{name}, {key}" if several or suffix else name
    if points.ndim not in (2, 3):
        raise RecordingError(
            f"Expected {key} of {name} of shape (samples, dimensions) or (recordings, samples, "
            f"dimensions), got {points.shape}."
        )
    turn = points.shape[-2] < points.shape[-1]
    if turn:
        points = np.swapaxes(points, -1, -2)
    speed_key = _named(SPEEDS, suffix, numbers, columns.velocities, name)
    time_key = _named(TIMES, suffix, numbers, (columns.time,) if columns.time else None, name)
    speeds = None if speed_key is None else numbers[speed_key]
    if speeds is not None and turn and speeds.ndim == points.ndim:
        speeds = np.swapaxes(speeds, -1, -2)
    stacked = points if points.ndim == 3 else points[None]
    n, t, _ = stacked.shape
    if speeds is not None and speeds.size != points.size:
        raise RecordingError(
            f"Expected {speed_key} of {name} of the shape of {key}, {points.shape}, got "
            f"{speeds.shape}."
        )
    if speeds is not None:
        speeds = speeds.reshape(stacked.shape)
    if columns.dt is None and time_key is None:
        dt_key = next((k for k in (f"dt{suffix}", "dt") if k in numbers), None)
        if dt_key is not None and numbers[dt_key].size == 1:
            columns = _with_dt(columns, float(numbers[dt_key].reshape(-1)[0]))
    stamps = None
    if time_key is not None and columns.dt is None:
        stamps = numbers[time_key]
        if stamps.size not in (t, n * t):
            raise RecordingError(
                f"Expected {time_key} of {name} to have a time for each of {t} samples, got shape "
                f"{stamps.shape}."
            )
        stamps = np.broadcast_to(stamps.reshape(-1, t), (n, t))
    unit = columns.time_unit or "s"
    group_key = columns.group or next((k for k in arrays if k.lower() in GROUPS and k != key), None)
    if group_key is not None and n == 1:
        if group_key not in arrays:
            raise RecordingError(f"Expected an array {group_key!r} in {name}, got none.")
        labels = np.asarray(arrays[group_key]).reshape(-1)
        if labels.size != t:
            raise RecordingError(
                f"Expected {group_key} of {name} to have a value for each of {t} samples, got "
                f"{labels.size}."
            )
        parts = _groups({group_key: labels}, group_key, name)
    else:
        group_key, parts = None, [("", np.ones(t, dtype=bool))]
    recordings = []
    for i in range(n):
        for word, rows in parts:
            own = label if n == 1 else f"{label}[{i}]"
            own = f"{own}, {group_key} {word}" if group_key else own
            chosen = stacked[i][rows]
            part = None if stamps is None else stamps[i][rows]
            times = _times(part, len(chosen), columns, own, list(arrays))
            recording = RawRecording(
                own, times, chosen, None if speeds is None else speeds[i][rows]
            )
            recordings.append(
                recording if stamps is None else _in_seconds(recording, SECONDS[unit])
            )
    text = _said(
        time_key if stamps is not None else None,
        unit,
        columns.dt,
        (f"{key} {numbers[key].shape}",),
        (speed_key,) if speed_key else (),
        group_key,
        [],
    )
    text += _doubt(columns.time_unit, recordings) if stamps is not None else ""
    if turn:
        text += "; turned, because it has more columns than rows"
    values = {
        "time": time_key if stamps is not None else None,
        "positions": [key],
        "velocities": [speed_key] if speed_key else [],
        "group": group_key,
        "turned": turn,
    }
    return Reading(recordings, [Note("columns", label, text, values)])


def _stack_names(numbers: Mapping[str, FloatArray]) -> list[str]:
    """Return the names of the arrays that look like positions: one, or several with numbers."""
    lowered = {k.lower(): k for k in numbers}
    for base in STACKS:
        if base in lowered and numbers[lowered[base]].ndim >= 2:
            return [lowered[base]]
        pattern = re.compile(rf"{base}[._ ]?(\d+)")
        found = [(int(m[1]), k) for low, k in lowered.items() if (m := pattern.fullmatch(low))]
        if found and all(numbers[k].ndim == 2 for _, k in found):
            return [k for _, k in sorted(found)]
    matrices = [k for k, a in numbers.items() if a.ndim >= 2 and min(a.shape) > 1]
    return matrices if len(matrices) == 1 else []


def _named(
    known: Sequence[str],
    suffix: str,
    numbers: Mapping[str, FloatArray],
    said: tuple[str, ...] | None,
    name: str,
) -> str | None:
    """Return the array that the caller named, or the one of a known name and the same number."""
    if said == ():
        return None
    lowered = {k.lower(): k for k in numbers}
    candidates = [f"{k}{suffix}" for k in said or known] + list(said or ())
    found = next((lowered[c.lower()] for c in candidates if c.lower() in lowered), None)
    if said and found is None:
        found = _known(said[0], list(numbers), name)
    if found is None and suffix:  # times that all recordings share
        found = next((lowered[k] for k in known if k in lowered), None)
    return found


# Both -----------------------------------------------------------------------------------------


def _plain(heading: str) -> tuple[str, str | None]:
    """Return a heading without its unit, in lower case, and the unit."""
    text = heading.strip()
    match = _UNIT.fullmatch(text)
    if match is None or not match[1]:
        return text.lower(), None
    return match[1].strip().lower(), (match[2] or match[3]).replace("µ", "u")


def _guess(
    plain: Mapping[str, tuple[str, str | None]],
    taken: Iterable[str | None],
    axes: re.Pattern[str],
    numbered: re.Pattern[str],
) -> tuple[str, ...]:
    for pattern in (axes, numbered):
        found = [
            (m[1] if pattern is axes else f"{int(m[1]):09d}", n)
            for n, (base, _) in plain.items()
            if n not in taken and (m := pattern.fullmatch(base))
        ]
        if found and len({order for order, _ in found}) == len(found):
            return tuple(n for _, n in sorted(found))
    return ()


def _known(column: str, names: Sequence[str], where: str) -> str:
    """Return the column of a name, with its unit or without; raise RecordingError if none is."""
    if column not in names:
        plain = [n for n in names if _plain(n)[0] == column.lower()]
        if len(plain) == 1:
            return plain[0]
        near = difflib.get_close_matches(column, names, n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise RecordingError(
            f"Expected a column {column!r} in {where}, got {', '.join(names[:20])}.{hint}"
        )
    return column


def _doubt(unit: str | None, recordings: Sequence[RawRecording]) -> str:
    """Return a word on times that are taken for seconds and hardly are."""
    known = [r.times[np.isfinite(r.times)] for r in recordings]
    apart = [float(np.median(np.abs(np.diff(times)))) for times in known if len(times) > 1]
    if unit is not None or not apart or min(apart) < SLOW:
        return ""
    return (
        f"; its samples are {min(apart):.3g} s apart then: if they are milliseconds, say so "
        "(--time-unit ms)"
    )


def _numbers(
    table: Mapping[str, Column], names: Sequence[str], where: str, lines: Sequence[int] | None
) -> FloatArray:
    for column in names:
        if table[column].dtype.kind != "f":
            row, cell = _first_word(table[column])
            raise RecordingError(
                f"Expected numbers in column {column!r} of {where}, got {cell!r} in "
                f"{_place(row, lines)}: mend the cell, or name other columns (--positions, --time)."
            )
    return np.stack([np.asarray(table[c], dtype=np.float64) for c in names], axis=1)


def _place(row: int, lines: Sequence[int] | None) -> str:
    return f"sample {row + 1}" if lines is None else f"line {lines[row]}"


def _first_word(column: Column) -> tuple[int, str]:
    for i, cell in enumerate(column):
        try:
            float(str(cell) or "nan")
        except ValueError:
            return i, str(cell)[:40]
    return 0, str(column[0])[:40]


def _groups(
    table: Mapping[str, Column],
    group: str | None,
    name: str,
    lines: Sequence[int] | None = None,
) -> list[tuple[str, np.ndarray[Any, np.dtype[np.bool_]]]]:
    """Return the rows of each recording, in the order in which they come."""
    if group is None:
        n = len(next(iter(table.values())))
        return [("", np.ones(n, dtype=bool))]
    labels = table[group]
    if labels.dtype.kind == "f" and not np.isfinite(labels).all():
        row = int(np.argmin(np.isfinite(labels)))
        raise RecordingError(
            f"Expected a value in column {group!r} of {name} for every sample, got none in "
            f"{_place(row, lines)}."
        )
    values, first = np.unique(labels, return_index=True)
    if len(values) > 10_000:
        raise RecordingError(
            f"Expected column {group!r} of {name} to tell recordings apart, got {len(values)} "
            "different values."
        )
    ordered = values[np.argsort(first)]
    return [
        (f"{v:g}" if labels.dtype.kind in "fiu" else str(v), np.asarray(labels == v))
        for v in ordered
    ]


def _times(
    stamps: FloatArray | None, n: int, columns: Columns, name: str, came: Sequence[str]
) -> FloatArray:
    if stamps is not None:
        return stamps
    if columns.dt is None:
        raise RecordingError(
            f"Expected time stamps in {name}, in a column such as t or time, got "
            f"{', '.join(came[:20])}: name their column (--time), or give the seconds a sample "
            "(--dt)."
        )
    return np.asarray(np.arange(n) * columns.dt, dtype=np.float64)


def _in_seconds(recording: RawRecording, factor: float) -> RawRecording:
    """Return a recording with its time stamps in seconds; velocities are a second's already."""
    if factor == 1.0:
        return recording
    times = scaled(recording, time=factor, zero=True).times
    return RawRecording(recording.name, times, recording.positions, recording.velocities)


def _with_dt(columns: Columns, dt: float) -> Columns:
    return Columns(
        None, columns.positions, columns.velocities, columns.group, columns.time_unit, dt
    )


def _said(
    time: str | None,
    unit: str,
    dt: float | None,
    positions: Sequence[str],
    speeds: Sequence[str],
    group: str | None,
    left_out: Sequence[str],
) -> str:
    parts = [f"time {time} ({unit})" if time is not None else f"a sample every {dt:g} s"]
    parts.append(f"positions {', '.join(positions)}")
    if speeds:
        parts.append(f"velocities {', '.join(speeds)}")
    if group is not None:
        parts.append(f"a recording for each {group}")
    text = "took " + "; ".join(parts)
    return text + (f"; left out {', '.join(left_out[:12])}" if left_out else "")
