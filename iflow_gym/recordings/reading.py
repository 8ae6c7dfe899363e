"""Recordings out of files of any format that is known."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Literal, get_args

from iflow_gym.recordings.columns import Columns, Reading
from iflow_gym.recordings.raw import MOST_BYTES, RecordingError

Format = Literal["csv", "npz", "jsonl", "mat", "rosbag", "minari"]
FORMATS: tuple[Format, ...] = get_args(Format)

READERS: dict[Format, str] = {
    "csv": "text_tables",
    "npz": "numpy_files",
    "jsonl": "json_lines",
    "mat": "matlab",
    "rosbag": "rosbag",
    "minari": "minari_datasets",
}
"""The module of each format, with a function `read(source, columns) -> Reading`."""

SUFFIXES: dict[str, Format] = {
    ".csv": "csv", ".tsv": "csv", ".txt": "csv", ".dat": "csv", ".npz": "npz", ".npy": "npz",
    ".jsonl": "jsonl", ".ndjson": "jsonl", ".json": "jsonl", ".mat": "mat", ".db3": "rosbag",
    ".mcap": "rosbag", ".bag": "rosbag",
}  # fmt: skip


@dataclass(frozen=True)
class Source:
    """Where recordings come from: a path, or content that came without one."""

    name: str
    path: Path | None = None
    content: bytes | None = None

    def read(self) -> bytes:
        """Return the bytes, of a file of a size that memory can hold."""
        content = self._content()
        if not content:
            raise RecordingError(f"Expected a recording in {self.name}, got an empty file.")
        return content

    def _content(self) -> bytes:
        if self.content is not None:
            return self.content
        assert self.path is not None
        if (size := self.path.stat().st_size) > MOST_BYTES:
            raise RecordingError(
                f"Expected {self.name} to have at most {MOST_BYTES >> 20} MiB, got "
                f"{size >> 20}: cut it into pieces."
            )
        return self.path.read_bytes()


def read_recordings(
    sources: Sequence[str | os.PathLike[str] | Source],
    columns: Columns | None = None,
    *,
    format: Format | None = None,
) -> Reading:
    """Read recordings, in the order of their sources.

    Parameters
    ----------
    sources : sequence of paths
        Files; a ROS 2 bag is a folder, a Minari dataset an id.
    columns : Columns, optional
        What is what; guessed by default.
    format : str, optional
        One of `FORMATS`; by default by each name's ending.

    Returns
    -------
    Reading
        The recordings, and notes of what was taken for what.

    Raises
    ------
    RecordingError
        If a file is not what it should be; the message says what was expected, and what to do.
    OSError
        If it cannot be read.
    """
    chosen = Columns() if columns is None else columns
    if not sources:
        raise RecordingError("Expected at least one file of recordings, got none.")
    reading = Reading()
    for source in sources:
        entry = source if isinstance(source, Source) else Source(str(source), Path(source))
        kind = format or format_of(entry)
        if kind != "minari" and entry.content is None:
            assert entry.path is not None
            if not entry.path.exists():
                raise FileNotFoundError(f"Expected a file at {entry.name}, got none.")
            if entry.path.is_dir() and kind != "rosbag":
                raise RecordingError(
                    f"Expected a file of format {kind} at {entry.name}, got a folder."
                )
        module = import_module(f"iflow_gym.recordings.{READERS[kind]}")
        reading = reading + module.read(entry, chosen)
    return reading


def format_of(source: Source) -> Format:
    """Return the format that a source's name says; raise RecordingError if it says none."""
    path = source.path
    if path is not None and path.is_dir():
        return "rosbag"
    suffix = Path(source.name).suffix.lower()
    if suffix in SUFFIXES:
        return SUFFIXES[suffix]
    if path is not None and not path.exists() and "/" in source.name and "-v" in source.name:
        return "minari"
    if path is not None and not path.exists():
        raise FileNotFoundError(f"Expected a file at {source.name}, got none.")
    raise RecordingError(
        f"Expected a name that tells the format of {source.name}, ending in one of "
        f"{', '.join(SUFFIXES)}: say which it is (--format {'|'.join(FORMATS)})."
    )
