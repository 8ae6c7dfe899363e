"""Recordings from NumPy's files, .npz and .npy; nothing in them is executed."""

from __future__ import annotations

import io
import math
import zipfile
import zlib
from typing import Any

import numpy as np

from iflow_gym.recordings.columns import Columns, Reading, from_arrays
from iflow_gym.recordings.raw import MOST_BYTES, RecordingError
from iflow_gym.recordings.reading import Source

KINDS = "fiubU"
"""Kinds of arrays that are read: numbers and words. Objects would have to be unpickled."""


def read(source: Source, columns: Columns) -> Reading:
    """Read arrays; see `iflow_gym.recordings.columns.from_arrays` for what they may be.

    Raises
    ------
    RecordingError
        If it is no file of NumPy's, holds objects, or claims to be larger than it is.
    """
    content = source.read()
    try:
        arrays = _arrays(content)
    except RecordingError:
        raise
    except (
        ArithmeticError,
        EOFError,
        LookupError,
        MemoryError,
        NotImplementedError,
        OSError,
        RuntimeError,
        SyntaxError,
        TypeError,
        ValueError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise RecordingError(
            f"Expected {source.name} to be a file of NumPy's (numpy.savez or numpy.save), got "
            f"something else or a damaged one: {str(error).rstrip('.')}."
        ) from error
    return from_arrays(arrays, columns, source.name)


def _arrays(content: bytes) -> dict[str, np.ndarray[Any, Any]]:
    if content[:6] == b"\x93NUMPY":
        return {"positions": _array(content, "it")}
    arrays = {}
    left = MOST_BYTES
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        for info in archive.infolist():
            if not info.filename.endswith(".npy"):
                continue
            # What a member claims to unpack to is a claim: no more than that is ever unpacked.
            with archive.open(info) as member:
                unpacked = member.read(left + 1)
            left -= len(unpacked)
            if left < 0:
                raise ValueError(f"it unpacks to more than {MOST_BYTES >> 20} MiB")
            arrays[info.filename.removesuffix(".npy")] = _array(unpacked, info.filename)
    return arrays


def _array(content: bytes, name: str) -> np.ndarray[Any, Any]:
    """Return the array of a .npy file, whose header has to agree with its length."""
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    readers = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    if version not in readers:
        raise ValueError(f"{name} has the unknown version {version}")
    shape, columnwise, dtype = readers[version](stream)
    if dtype.hasobject or dtype.kind not in KINDS or dtype.subdtype is not None:
        raise ValueError(f"{name} holds {dtype}, and only numbers and words are read")
    count = math.prod(shape)
    expected, came = count * dtype.itemsize, len(content) - stream.tell()
    if expected != came or dtype.itemsize == 0:
        raise ValueError(f"{name} of shape {shape} takes {expected} bytes, and has {came}")
    flat = np.frombuffer(content, dtype, count, offset=stream.tell())
    return flat.reshape(shape, order="F" if columnwise else "C")
