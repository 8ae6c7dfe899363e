"""What commands share: talk on standard error, progress, data and files in and out."""

from __future__ import annotations

import json
import math
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

PIPE = "-"
"""Stands for standard input and standard output."""


class Command(Protocol):
    """A command with its arguments."""

    def run(self) -> int:
        """Do it, and return the exit status."""


class UsageError(ValueError):
    """A command that was not understood: exit status 2."""


def say(text: str) -> None:
    """Print to standard error."""
    print(text, file=sys.stderr)


def complain(text: str) -> None:
    """Print what went wrong to standard error, without anything that could steer a terminal."""
    plain = "".join(c if c.isprintable() or c == "\n" else "?" for c in text)
    say(f"iflow-gym: {plain}")


def print_json(value: Any) -> None:
    """Print JSON to standard output; infinity becomes ``"inf"`` and nan null, as in records."""
    print(json.dumps(_json(value), indent=1, ensure_ascii=False))


def _json(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _json(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_json(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else ("inf" if value > 0 else "-inf")
    if isinstance(value, Path):
        return str(value)
    return value


# Progress -------------------------------------------------------------------------------------


@contextmanager
def progress(text: str) -> Iterator[None]:
    """Show on a terminal's standard error that something goes on, and for how long.

    For what cannot say how far it is.
    """
    if not sys.stderr.isatty():
        yield
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = [TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()]
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        bar.add_task(text, total=None)
        yield


@contextmanager
def counted(text: str, total: int) -> Iterator[Callable[[], None]]:
    """Show a bar on a terminal's standard error; the function that comes counts one step."""
    if not sys.stderr.isatty():
        yield lambda: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(text, total=total)
        yield lambda: bar.advance(task)


# Files ----------------------------------------------------------------------------------------


@contextmanager
def input_path(path: str) -> Iterator[Path]:
    """Give a file's path; of standard input, ``-``, that of a copy that lasts as long."""
    if path != PIPE:
        yield Path(path)
        return
    with tempfile.TemporaryDirectory(prefix="iflow-gym-") as folder:
        copy = Path(folder) / "stdin"
        copy.write_bytes(input_bytes())
        yield copy


def input_bytes() -> bytes:
    """Return standard input."""
    if sys.stdin.isatty():
        raise UsageError("Expected a file on standard input (-), got a terminal.")
    return sys.stdin.buffer.read()


@contextmanager
def output_path(path: str, suffix: str = "") -> Iterator[Path]:
    """Give a path to write to; what is written for ``-`` goes to standard output afterwards."""
    if path != PIPE:
        target = Path(path)
        if target.is_dir():
            raise UsageError(f"Expected a file to write at {path}, got a folder.")
        if not target.parent.is_dir():
            raise UsageError(
                f"Expected a folder at {target.parent} to write {target.name} into, got none."
            )
        yield target
        return
    if sys.stdout.isatty():
        raise UsageError("Expected a pipe or a file for what is no text (-), got a terminal.")
    with tempfile.TemporaryDirectory(prefix="iflow-gym-") as folder:
        target = Path(folder) / f"stdout{suffix}"
        yield target
        sys.stdout.buffer.write(target.read_bytes())
        sys.stdout.buffer.flush()


def only_one_pipe(*paths: str) -> None:
    """Raise UsageError if more than one input is standard input."""
    if paths.count(PIPE) > 1:
        raise UsageError("Expected one of the inputs on standard input (-), got several.")


def save_picture(figure: Any, path: str) -> None:
    """Write a matplotlib figure; ``-`` is a PNG on standard output."""
    suffix = ".png" if path == PIPE else Path(path).suffix.lower()
    known = (".png", ".svg", ".pdf")
    if suffix not in known:
        raise UsageError(f"Expected a picture ending in {', '.join(known)}, got {path}.")
    with output_path(path, suffix) as target:
        partial = target.with_name(f"{target.stem}.{os.getpid()}.partial{suffix}")
        figure.savefig(partial, dpi=150)
        partial.replace(target)
