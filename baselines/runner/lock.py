"""One run at a time writes into a folder of results."""

from __future__ import annotations

import contextlib
import json
import os
import socket
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import IO

from iflow_gym.baselines.runner.store import cannot_write

LOCK_NAME = ".lock"
"""Name of the file, in the folder of results, that a run holds."""


class FolderInUseError(RuntimeError):
    """Another run writes into the folder."""


@contextlib.contextmanager
def output_lock(folder: Path) -> Iterator[None]:
    """Hold a folder of results for this process.

    The lock is the operating system's (`flock`), on a file that names its holder. It goes with the
    process, however that ends: what a killed run leaves is a file that nobody holds, and the next
    run takes it. Folders that machines share are covered as far as their file system carries
    `flock` across, as NFS does on Linux. Without `fcntl`, on Windows, nothing is locked.

    Raises
    ------
    FolderInUseError
        If another process holds it.
    CannotWriteError
        If it cannot be written into.
    """
    try:
        import fcntl
    except ImportError:
        yield
        return
    path = folder / LOCK_NAME
    while True:
        try:
            file = path.open("a+", encoding="utf-8")
        except OSError as error:
            raise cannot_write(error, folder) from error
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            with file:
                raise FolderInUseError(_in_use(folder, file)) from None
        except OSError:  # a file system without locks
            with file:
                yield
            return
        if _is_still(path, file):
            break
        file.close()  # its holder removed it after it was opened here
    with file:
        file.truncate(0)
        holder = {
            "pid": os.getpid(),
            "host": socket.gethostname(),
            "since": datetime.now(UTC).isoformat(timespec="seconds"),
        }
        with contextlib.suppress(OSError):  # a full disk: the lock holds without its text
            os.write(file.fileno(), (json.dumps(holder) + "\n").encode())
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def _is_still(path: Path, file: IO[str]) -> bool:
    """Whether an open file is the one that its path names."""
    try:
        named, held = path.stat(), os.fstat(file.fileno())
    except FileNotFoundError:
        return False
    return (named.st_dev, named.st_ino) == (held.st_dev, held.st_ino)


def _in_use(folder: Path, file: IO[str]) -> str:
    file.seek(0)
    try:
        holder = json.loads(file.read())
        who = f"process {holder['pid']} on {holder['host']}, since {holder['since']}"
    except (ValueError, TypeError, KeyError):
        who = "another process"
    return (
        f"Another run writes into {folder} ({who}): wait until it ends, or give another --output. "
        "Nothing was changed."
    )
