"""Recordings from MATLAB's files, versions 4 to 7.2."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np

from iflow_gym.recordings.columns import Columns, Reading, from_arrays
from iflow_gym.recordings.mat_format import read_mat
from iflow_gym.recordings.raw import MOST_BYTES, RecordingError
from iflow_gym.recordings.reading import Source

MOST_RECORDINGS = 10_000


def read(source: Source, columns: Columns) -> Reading:
    """Read a MAT file: matrices, or a cell or a structure array that holds a recording each.

    Structures have fields such as ``pos``, ``t``, ``vel``, as those of the LASA data. Samples may
    be rows or columns.

    Raises
    ------
    RecordingError
        If it is no MAT file, is of version 7.3, or unpacks to more than memory should hold.
    """
    content = source.read()
    if content[:8] == b"\x89HDF\r\n\x1a\n" or content[:10] == b"MATLAB 7.3":
        raise RecordingError(
            f"Expected {source.name} to be a MAT file of version 7.2 or earlier, got version 7.3: "
            "save it in MATLAB with save(name, '-v7')."
        )
    try:
        variables = read_mat(content, MOST_BYTES)
    except (ArithmeticError, LookupError, MemoryError, ValueError, zlib.error) as error:
        raise RecordingError(
            f"Expected {source.name} to be a MAT file, got something else or a damaged one: "
            f"{str(error).rstrip('.')}."
        ) from error
    arrays = {k: v for k, v in variables.items() if isinstance(v, np.ndarray)}
    nested = {k: v for k, v in variables.items() if isinstance(v, list) and v}
    named = columns.positions[0] if columns.positions else None
    if not nested or named in arrays:
        return from_arrays(arrays, columns, source.name)
    chosen = named if named in nested else next(iter(nested))
    cells = nested[chosen]
    if len(cells) > MOST_RECORDINGS:
        raise RecordingError(
            f"Expected at most {MOST_RECORDINGS} recordings in {source.name}, got {len(cells)}."
        )
    own = Columns(
        columns.time,
        None if named == chosen else columns.positions,
        columns.velocities,
        columns.group,
        columns.time_unit,
        columns.dt,
    )
    reading = Reading()
    for i, cell in enumerate(cells):
        name = source.name if len(cells) == 1 else f"{source.name}, {chosen} {i + 1}"
        reading = reading + from_arrays(_fields(cell, name), own, name)
    return reading


def _fields(cell: Any, name: str) -> dict[str, np.ndarray[Any, Any]]:
    """Return the arrays of a structure, or a matrix as the positions."""
    if isinstance(cell, list) and len(cell) == 1:  # a structure in a cell
        cell = cell[0]
    if isinstance(cell, dict):
        return {k: v for k, v in cell.items() if isinstance(v, np.ndarray)}
    if isinstance(cell, np.ndarray) and cell.dtype.kind == "f":
        return {"positions": cell}
    raise RecordingError(
        f"Expected a matrix or a structure of matrices in {name}, got "
        f"{'words' if isinstance(cell, np.ndarray) else 'cells'}."
    )
