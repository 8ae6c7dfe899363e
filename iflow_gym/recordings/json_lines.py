"""Recordings from JSON lines: a sample or a whole recording a line."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from iflow_gym.recordings.columns import (
    STACKS,
    Column,
    Columns,
    Reading,
    from_arrays,
    from_table,
)
from iflow_gym.recordings.raw import RecordingError
from iflow_gym.recordings.reading import Source


def read(source: Source, columns: Columns) -> Reading:
    """Read JSON lines.

    A line is a sample, ``{"t": 0.1, "x": 1.0, "y": 2.0}`` or ``{"t": 0.1, "position": [1.0, 2]}``,
    or a recording, ``{"times": [...], "positions": [[1.0, 2.0], ...]}``. A file with one list of
    such objects will do as well. null is a missing number.

    Raises
    ------
    RecordingError
        If a line is no JSON object, or is unlike the others.
    """
    objects = _objects(source)
    keys = list(objects[0])
    for i, entry in enumerate(objects):
        if set(entry) != set(keys):
            raise RecordingError(
                f"Expected the keys {', '.join(keys)} in every object of {source.name}, got "
                f"{', '.join(map(str, entry)) or 'none'} in object {i + 1}."
            )
    try:
        if _is_recording(objects[0]):
            reading = Reading()
            for i, entry in enumerate(objects):
                arrays = {k: _array(v) for k, v in entry.items()}
                name = source.name if len(objects) == 1 else f"{source.name}, line {i + 1}"
                reading = reading + from_arrays(arrays, columns, name)
            return reading
        return from_table(_table(objects, source.name), columns, source.name)
    except RecordingError:
        raise
    except (ArithmeticError, MemoryError, RecursionError, TypeError, ValueError) as error:
        raise RecordingError(
            f"Expected numbers and lists of numbers in {source.name}, got something else: {error}."
        ) from error


def _objects(source: Source) -> list[dict[str, Any]]:
    content = source.read()
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise RecordingError(
            f"Expected {source.name} to be JSON lines in UTF-8, got other bytes ({error.reason} at "
            f"byte {error.start}): save it as UTF-8, or say what format it is (--format)."
        ) from error
    objects: list[Any]
    try:
        whole = json.loads(text)
        objects = whole if isinstance(whole, list) else [whole]
    except (RecursionError, ValueError):
        objects = []
        for number, line in enumerate(text.splitlines(), start=1):
            if not line.strip():
                continue
            try:
                objects.append(json.loads(line))
            except (RecursionError, ValueError) as error:
                raise RecordingError(
                    f"Expected a JSON object in line {number} of {source.name}, got "
                    f"{line.strip()[:40]!r}: {error}."
                ) from error
    if not objects or not all(isinstance(entry, dict) and entry for entry in objects):
        raise RecordingError(
            f"Expected JSON objects in {source.name}, a sample or a recording a line, got "
            f"{'nothing' if not objects else 'something else'}."
        )
    return objects


def _is_recording(entry: dict[str, Any]) -> bool:
    """Whether an object holds a list of samples."""
    lists = [v for v in entry.values() if isinstance(v, list) and v]
    nested = any(isinstance(v[0], list) for v in lists)
    scalars = [v for v in entry.values() if not isinstance(v, list)]
    names = {str(k).lower() for k, v in entry.items() if isinstance(v, list)}
    # {"t": 0.1, "position": [1, 2]} is a sample: its time is one number.
    return bool(lists) and (nested or (not scalars and not names <= set(STACKS[:3])))


def _array(value: Any) -> np.ndarray[Any, Any]:
    if isinstance(value, str):
        return np.array([value], dtype=np.str_)
    return np.array(_without_null(value), dtype=np.float64)


def _without_null(value: Any) -> Any:
    if isinstance(value, list):
        return [_without_null(entry) for entry in value]
    return np.nan if value is None else value


def _table(objects: list[dict[str, Any]], name: str) -> dict[str, Column]:
    """Return columns; a list of d numbers becomes d of them, ``position.0`` and so on."""
    table: dict[str, Column] = {}
    for key, first in objects[0].items():
        values = [entry[key] for entry in objects]
        if isinstance(first, list):
            rows = np.array([_without_null(v) for v in values], dtype=np.float64)
            if rows.ndim != 2:
                raise RecordingError(
                    f"Expected as many numbers in {key!r} of every sample of {name}, got others."
                )
            table |= {f"{key}.{i}": column for i, column in enumerate(rows.T)}
        elif any(isinstance(v, str) for v in values):
            table[str(key)] = np.array([str(v) for v in values], dtype=np.str_)
        else:
            table[str(key)] = np.array([_without_null(v) for v in values], dtype=np.float64)
    return table
