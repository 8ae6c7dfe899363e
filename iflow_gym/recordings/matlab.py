"""Recordings from MATLAB's files, versions 4 to 7.2."""

from __future__ import annotations

import io
import warnings
import zlib
from typing import Any

import numpy as np

from iflow_gym.recordings.columns import Columns, Reading, from_arrays
from iflow_gym.recordings.raw import MOST_BYTES, RecordingError
from iflow_gym.recordings.reading import Source

COMPRESSED = 15
"""miCOMPRESSED, the type of an element that has to be unpacked."""


def read(source: Source, columns: Columns) -> Reading:
    """Read a MAT file: matrices, or cells or structures that hold a recording each.

    Structures have fields such as ``pos``, ``t``, ``vel``, as those of the LASA data. Samples may
    be rows or columns.

    Raises
    ------
    RecordingError
        If it is no MAT file, is of version 7.3, or unpacks to more than memory should hold.
    """
    import scipy.io

    content = source.read()
    if content[:8] == b"\x89HDF\r\n\x1a\n" or content[:10] == b"MATLAB 7.3":
        raise RecordingError(
            f"Expected {source.name} to be a MAT file of version 7.2 or earlier, got version 7.3: "
            "save it in MATLAB with save(name, '-v7')."
        )
    try:
        _check_size(content)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of variables that are read under another name
            variables = scipy.io.loadmat(
                io.BytesIO(content),  # type: ignore[arg-type]
                struct_as_record=False,
                verify_compressed_data_integrity=True,
            )
    except Exception as error:  # whatever scipy makes of bytes that are no MAT file
        raise RecordingError(
            f"Expected {source.name} to be a MAT file, got something else or a damaged one: "
            f"{str(error).rstrip('.')}."
        ) from error
    arrays = {k: np.asarray(v) for k, v in variables.items() if not k.startswith("__")}
    cells = {k: a for k, a in arrays.items() if a.dtype == object and a.size}
    if not cells or (columns.positions and columns.positions[0] in arrays.keys() - cells.keys()):
        return from_arrays(
            {k: a for k, a in arrays.items() if a.dtype != object}, columns, source.name
        )
    chosen = next((k for k in cells if columns.positions == (k,)), next(iter(cells)))
    reading = Reading()
    for i, cell in enumerate(cells[chosen].reshape(-1)):
        name = f"{source.name}, {chosen} {i + 1}"
        reading = reading + from_arrays(_fields(cell, name), columns, name)
    return reading


def _fields(cell: Any, name: str) -> dict[str, np.ndarray[Any, Any]]:
    """Return the arrays of a structure, or a matrix as the positions."""
    array = np.asarray(cell)
    if array.dtype == object and array.size == 1:
        cell = array.reshape(-1)[0]
    if hasattr(cell, "_fieldnames"):
        fields = {f: np.asarray(getattr(cell, f)) for f in cell._fieldnames}
        return {f: a for f, a in fields.items() if a.dtype != object}
    array = np.asarray(cell)
    if array.dtype.kind not in "fiu" or array.ndim != 2:
        raise RecordingError(
            f"Expected a matrix or a structure of matrices in {name}, got {type(cell).__name__}."
        )
    return {"positions": array}


def _check_size(content: bytes) -> None:
    """Raise ValueError if the elements of a file of version 5 unpack to too much."""
    if len(content) < 128 or content[126:128] not in (b"IM", b"MI"):
        return  # version 4, which packs nothing, or no MAT file at all
    order: Any = "little" if content[126:128] == b"IM" else "big"
    at, left = 128, MOST_BYTES
    while at + 8 <= len(content):
        kind = int.from_bytes(content[at : at + 4], order)
        length = int.from_bytes(content[at + 4 : at + 8], order)
        body = content[at + 8 : at + 8 + length]
        if kind == COMPRESSED:
            unpacker = zlib.decompressobj()
            left -= len(unpacker.decompress(body, left + 1))
        else:
            left -= len(body)
        if left < 0:
            raise ValueError(f"it unpacks to more than {MOST_BYTES >> 20} MiB")
        at += 8 + length
