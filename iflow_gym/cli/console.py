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
def progress(
    text: str, total: int | None = None, what: str = ""
) -> Iterator[Callable[[int], None]]:
    """Show on a terminal's standard error how far something is, and for how long it has gone on.

    The function that comes is told how many of the total are done. Without a total, and while
    something goes on after the last of them, the bar moves to and fro.
    """
    if not sys.stderr.isatty():
        yield lambda done: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    counts = TextColumn("{task.fields[counts]}")
    columns = [TextColumn("{task.description}"), BarColumn(), counts, TimeElapsedColumn()]
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(text, total=total, counts="")

        def told(done: int) -> None:
            if total is None or bar.tasks[0].finished:
                return
            bar.update(task, completed=min(done, total))
            seconds = bar.tasks[0].time_remaining
            left = "" if seconds is None else f", {seconds:.0f} s left"
            counts = f"{done / total:.0%}, {done} of {total} {what}".rstrip() + left
            bar.update(task, counts=counts, visible=done < total, refresh=True)
            if done >= total:
                bar.add_task(f"{text}: finishing", total=None, counts="")

        yield told


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
    if sys.stdin is None or sys.stdin.isatty():
        came = "a closed one" if sys.stdin is None else "a terminal"
        raise UsageError(f"Expected a file on standard input (-), got {came}.")
    return sys.stdin.buffer.read()


def check_output(path: str, *inputs: str, suffix: str = "") -> None:
    """Raise UsageError for what cannot be written to, is one of the inputs, or is named wrongly.

    A name may end in anything but what says another format than the suffix.
    """
    target = Path(path)
    if path == PIPE:
        if sys.stdout.isatty():
            raise UsageError("Expected a pipe or a file for what is no text (-), got a terminal.")
    elif not path or target.is_dir():
        came = "a folder" if path else "an empty name"
        raise UsageError(f"Expected a file to write at {path!r}, got {came}.")
    elif target.exists() and not target.is_file():
        raise UsageError(
            f"Expected a file to write at {path!r}, got a device or a pipe, which a file would "
            "replace: - writes standard output."
        )
    elif not target.parent.is_dir():
        raise UsageError(
            f"Expected a folder at {target.parent} to write {target.name} into, got none: make it."
        )
    elif not os.access(target.parent, os.W_OK):
        raise UsageError(
            f"Expected a folder that may be written to at {target.parent}, got one that may not: "
            "write elsewhere."
        )
    elif any(target.exists() and Path(i).exists() and target.samefile(i) for i in inputs):
        raise UsageError(f"Expected an output beside the inputs, got {path}, which is one of them.")
    elif suffix and _format(target.suffix.lower()) not in (None, _format(suffix)):
        raise UsageError(
            f"Expected a name in {suffix}, such as {target.stem}{suffix}, because that is what is "
            f"written, got {path}."
        )


def _format(suffix: str) -> str | None:
    """Return the format that a name's ending says, None for one that says nothing."""
    from iflow_gym.recordings.reading import SUFFIXES

    own = {s: s for s in (".safetensors", ".onnx", *PICTURES)}
    return own.get(suffix) or SUFFIXES.get(suffix)


@contextmanager
def output_path(path: str, suffix: str = "") -> Iterator[Path]:
    """Give a path to write to; what is written for ``-`` goes to standard output afterwards."""
    check_output(path, suffix=suffix)
    if path != PIPE:
        replaced = Path(path).exists()
        yield Path(path)
        if replaced:
            say(f"Replaced {path}, which was there already.")
        return
    with tempfile.TemporaryDirectory(prefix="iflow-gym-") as folder:
        target = Path(folder) / f"stdout{suffix}"
        yield target
        sys.stdout.buffer.write(target.read_bytes())
        sys.stdout.buffer.flush()


def check_seed(seed: int) -> None:
    """Raise UsageError for what is no seed."""
    if seed < 0:
        raise UsageError(f"Expected a seed >= 0 (--seed), got {seed}.")


def only_one_pipe(*paths: str) -> None:
    """Raise UsageError if more than one input is standard input."""
    if paths.count(PIPE) > 1:
        raise UsageError("Expected one of the inputs on standard input (-), got several.")


PICTURES = (".png", ".svg", ".pdf")


def check_picture(path: str) -> None:
    """Raise UsageError for what no picture can be written to."""
    if path != PIPE and Path(path).suffix.lower() not in PICTURES:
        raise UsageError(f"Expected a picture ending in {', '.join(PICTURES)}, got {path}.")
    check_output(path)


def save_picture(figure: Any, path: str) -> None:
    """Write a matplotlib figure; ``-`` is a PNG on standard output."""
    check_picture(path)
    suffix = ".png" if path == PIPE else Path(path).suffix.lower()
    with output_path(path, suffix) as target:
        partial = target.with_name(f"{target.stem}.{os.getpid()}.partial{suffix}")
        figure.savefig(partial, dpi=150)
        partial.replace(target)
