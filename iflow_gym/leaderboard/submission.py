"""``method.toml``: what a submission says of its method, beside its records."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass, fields
from pathlib import Path, PurePosixPath
from typing import Any

from iflow_gym.system import GUARANTEE_KINDS, GuaranteeKind

SUBMISSION_FILE = "method.toml"

MOST_BYTES = 64 * 1024
"""A file that is larger is not read."""

LONGEST = {"name": 60, "title": 60}
LONGEST_TEXT = 1000
"""Most characters of a value, where `LONGEST` has no other number."""

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]*")
_ADDRESS = re.compile(r"https://[^\s<>\"'`|]+")


class SubmissionError(ValueError):
    """A ``method.toml`` is missing or is not what it should be."""


@dataclass(frozen=True)
class Submission:
    """What a submission says of its method."""

    name: str
    """The method's `name`: the folder of its records."""
    title: str
    """The method's name as people write it: its `title`."""
    paper: str
    """Authors, title, venue and year; ``"none"`` where there is none."""
    code: str
    """Where its code is: an https address, or a path in this repository."""
    guarantee: GuaranteeKind
    """What is claimed of its stability; `iflow_gym.system.Guarantee` says what the words mean."""
    hardware: str
    """What it was fitted on, in words."""
    link: str | None = None
    """An https address of the paper."""
    note: str | None = None
    """What else a reader should know."""


def read_submission(folder: Path) -> Submission:
    """Read the ``method.toml`` of a folder.

    Raises
    ------
    SubmissionError
        If there is none, or it is too large, no TOML, lacks a key, has one too many, or has a value
        that is not allowed; all that is wrong is in one message.
    """
    path = folder / SUBMISSION_FILE
    if not path.is_file() or path.is_symlink():
        raise SubmissionError(
            f"Expected a file {path}, got none: write one with "
            f"{', '.join(f.name for f in fields(Submission) if f.name not in ('link', 'note'))} "
            "(docs/submissions.md)."
        )
    if (size := path.stat().st_size) > MOST_BYTES:
        raise SubmissionError(f"Expected {path} to have at most {MOST_BYTES} bytes, got {size}.")
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:  # of TOML, of UTF-8
        raise SubmissionError(f"{path} is no valid TOML: {error}.") from error
    if wrong := _wrong(values):
        raise SubmissionError(f"{path}: {'; '.join(wrong)}.")
    return Submission(**values)


def _wrong(values: dict[str, Any]) -> list[str]:
    """Return what is wrong with the values of a file."""
    known = [f.name for f in fields(Submission)]
    wrong = [f"expected {name}, got none" for name in known[:6] if name not in values]
    wrong += [f"unknown {name!r}, known: {', '.join(known)}" for name in values.keys() - set(known)]
    for name in known:
        if name not in values:
            continue
        text, most = values[name], LONGEST.get(name, LONGEST_TEXT)
        if not isinstance(text, str) or not text.strip() or not text.isprintable():
            wrong.append(f"expected {name} to be a line of text, got {_shown(text)}")
        elif len(text) > most:
            wrong.append(f"expected {name} of at most {most} characters, got {len(text)}")
        elif (name == "name" and not _NAME.fullmatch(text)) or set(text) & set("<>|"):
            wrong.append(f"expected other characters in {name}, got {_shown(text)}")
        elif name == "guarantee" and text not in GUARANTEE_KINDS:
            wrong.append(f"expected guarantee to be of {GUARANTEE_KINDS}, got {_shown(text)}")
        elif name == "link" and not _ADDRESS.fullmatch(text):
            wrong.append(f"expected link to be an https address, got {_shown(text)}")
        elif name == "code" and not (_ADDRESS.fullmatch(text) or _inside(text)):
            wrong.append(
                f"expected code to be an https address or a path in the repository, got "
                f"{_shown(text)}"
            )
    return wrong


def _inside(text: str) -> bool:
    path = PurePosixPath(text)
    return not path.is_absolute() and ".." not in path.parts and ":" not in text


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."
