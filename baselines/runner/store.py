"""How a cell's record and model get into a folder of results: whole, or not at all."""

from __future__ import annotations

import contextlib
import errno
import json
from pathlib import Path

from iflow_gym.results import Result, result_text, write_whole

NO_ROOM = frozenset(
    getattr(errno, name) for name in ("ENOSPC", "EDQUOT", "EROFS", "EFBIG") if hasattr(errno, name)
)
"""Errors of a disk that is full, beyond a quota or read-only: no method's fault."""


class CannotWriteError(RuntimeError):
    """Results cannot be written; what was written before is whole."""


def cannot_write(error: OSError, folder: Path) -> CannotWriteError:
    """Return the error that says what keeps results from being written, and into which folder.

    Of a full disk the system names no file.
    """
    named = "" if error.filename is not None else f", in {folder}"
    remedy = ""
    if isinstance(error, PermissionError):
        remedy = "; you need the right to read and write there, or another --output"
    elif isinstance(error, FileExistsError | NotADirectoryError | IsADirectoryError):
        remedy = "; move it away, or give another --output"
    return CannotWriteError(f"{type(error).__name__}: {error}{named}{remedy}")


def no_room(error: BaseException | None) -> bool:
    """Whether an error, or what it was raised from, is that of a disk without room."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in NO_ROOM:
            return True
        error = error.__cause__ or error.__context__
    return False


def store(folder: Path, result: Result, model: bytes | None) -> None:
    """Write a record, and its model before it; without a model, remove what an earlier run left.

    Raises
    ------
    OSError
        If the disk is full or worse. An earlier record is then still there, and its model, too.
    TypeError, ValueError, RecursionError
        If the record holds what JSON cannot.
    """
    target = folder / result.path
    target.parent.mkdir(parents=True, exist_ok=True)
    files = {target: result_text(result).encode()}
    beside = target.with_suffix(".safetensors")
    if model is not None:
        files = {beside: model, **files}
    write_whole(files)
    if model is None:
        beside.unlink(missing_ok=True)


def sweep(folder: Path) -> None:
    """Remove what killed processes were writing."""
    for path in folder.glob("*/*.partial"):
        with contextlib.suppress(OSError):
            path.unlink()


def model_is_whole(path: Path) -> bool:
    """Whether a safetensors file is as long as its header says; its numbers are not read."""
    try:
        with path.open("rb") as file:
            size = int.from_bytes(file.read(8), "little")
            length = path.stat().st_size
            if not 0 < size <= length - 8:
                return False
            header = json.loads(file.read(size))
        ends = [entry["data_offsets"][1] for key, entry in header.items() if key != "__metadata__"]
        return bool(length == 8 + size + max(ends, default=0))
    except (OSError, ValueError, TypeError, KeyError, IndexError, AttributeError):
        return False
