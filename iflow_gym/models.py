"""Any model file: which method it is of, the fitted method, and what it was fitted on.

`Method.load` reads the files of one method; here a file says by itself whose it is. Whoever fits
may put a record beside the parameters (`add_fit_record`): what the model was fitted on, which a
score has to know to be one of recordings that the model has not seen.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from iflow_gym.model_files import ModelFileError
from iflow_gym.system import DynamicalSystem, Method

MOST_BYTES = 2**30
"""Of a file that is read."""

MOST_HEADER_BYTES = 2**20
"""Of a file's header."""

MOST_NUMBER = 10**7
"""A whole number among a file's settings is at most this: they are sizes and counts, for which
memory is taken before the parameters are looked at."""

FIT_KEY = "iflow_gym_fit"
"""Of the record in a file's metadata."""


def load_model(path: str | os.PathLike[str], method: str | None = None) -> Method:
    """Read a model file of any method.

    Parameters
    ----------
    path : path
        Of a file that `Method.save` wrote.
    method : str, optional
        Name of a registered method or ``"module:Class"``; by default the registered one that the
        file names. A class from outside is imported, which runs its module, only where it is named
        here.

    Returns
    -------
    Method
        Fitted; its commands are finite where the motion ends, or at its centre.

    Raises
    ------
    ModelFileError
        If it is no model file, a damaged one, one of a later version or of another method.
    UnknownNameError
        If the method is unknown.
    OSError
        If the file cannot be read.
    """
    from iflow_gym.baselines.registry import METHODS, load_method

    header = model_header(path)
    said = header.get("method")
    if method is None:
        if not isinstance(said, str) or said not in METHODS:
            raise ModelFileError(
                f"Expected {path} to hold a model of {', '.join(sorted(METHODS))}, got "
                f"{said!r:.60}: of a class of your own say which it is, module:Class (--method)."
            )
        method = said
    cls = load_method(method)
    try:
        loaded = cls.load(path)
        _check_command(loaded)
    except ModelFileError:
        raise
    except (MemoryError, RecursionError) as error:
        raise ModelFileError(
            f"{path} is no model of iflow-gym: reading it takes more than there is of "
            f"{'memory' if isinstance(error, MemoryError) else 'nesting'}."
        ) from error
    except (ArithmeticError, AssertionError, AttributeError, IndexError, KeyError, TypeError) as e:
        raise ModelFileError(f"{path} is no whole {cls.name!r} model: {e!r}.") from e
    except (RuntimeError, ValueError) as error:
        raise ModelFileError(f"{path} is no whole {cls.name!r} model: {error}") from error
    return loaded


def model_header(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the header of a model file, with nothing else read.

    Raises
    ------
    ModelFileError
        If it is no model file, or a header that no method writes.
    OSError
        If it cannot be read.
    """
    metadata = _metadata(Path(path))
    if "iflow_gym" not in metadata:
        what = (
            "demonstrations" if "iflow_gym_demonstrations" in metadata else "a file of another kind"
        )
        raise ModelFileError(f"Expected {path} to be a model file of iflow-gym, got {what}.")
    header = _json(path, metadata["iflow_gym"])
    config = header.get("config")
    if isinstance(config, dict):
        for key, value in config.items():
            for number in value if isinstance(value, list) else [value]:
                if isinstance(number, int) and abs(number) > MOST_NUMBER:
                    raise ModelFileError(
                        f"Expected settings up to {MOST_NUMBER} in {path}, got {str(key)[:40]} = "
                        f"{number:.3g}: no method's model is this large."
                    )
    return header


def fit_record(path: str | os.PathLike[str]) -> dict[str, Any] | None:
    """Return what was put into a model file about its fit; None where there is nothing.

    Raises as `model_header` does.
    """
    metadata = _metadata(Path(path))
    return _json(path, metadata[FIT_KEY]) if FIT_KEY in metadata else None


def add_fit_record(path: str | os.PathLike[str], record: Mapping[str, Any]) -> None:
    """Put a record, of what JSON holds, into a model file; the file is replaced as a whole."""
    file = Path(path)
    content = file.read_bytes()
    length = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + length])
    header["__metadata__"][FIT_KEY] = json.dumps(dict(record), sort_keys=True)
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    partial = file.with_name(f"{file.name}.{os.getpid()}.partial")
    partial.write_bytes(len(text).to_bytes(8, "little") + text + content[8 + length :])
    partial.replace(file)


def _metadata(path: Path) -> dict[str, str]:
    """Return the texts in a safetensors file's header; the arrays are not read."""
    if not path.is_file():
        raise FileNotFoundError(f"Expected a model file at {path}, got none.")
    size = path.stat().st_size
    with path.open("rb") as stream:
        length = int.from_bytes(stream.read(8), "little")
        if size > MOST_BYTES or not 2 <= length <= min(size - 8, MOST_HEADER_BYTES):
            raise ModelFileError(
                f"Expected {path} to be a model file of iflow-gym, got something else: {size} "
                f"bytes, of which its first eight say that {length} are a header."
            )
        text = stream.read(length)
    header = _json(path, text)
    metadata = header.get("__metadata__")
    if not isinstance(metadata, dict) or not all(isinstance(v, str) for v in metadata.values()):
        raise ModelFileError(
            f"Expected {path} to be a model file of iflow-gym, got a file that says nothing of "
            "what it holds."
        )
    return metadata


def _json(path: str | os.PathLike[str], text: str | bytes) -> dict[str, Any]:
    try:
        value = json.loads(text)
    except (RecursionError, ValueError) as error:
        raise ModelFileError(
            f"Expected {path} to be a model file of iflow-gym, got a header that is no JSON: "
            f"{error}."
        ) from error
    if not isinstance(value, dict):
        raise ModelFileError(
            f"Expected {path} to be a model file of iflow-gym, got the header {value!r:.60}."
        )
    return value


def _check_command(method: Method) -> None:
    """Raise ModelFileError unless what the method does where it is at home is finite."""
    x = method.goal_[None]
    with np.errstate(all="ignore"):
        if isinstance(method, DynamicalSystem):
            command = method.velocity(x)
        else:
            command = method.rollout(x, 1, 0.01)  # type: ignore[attr-defined]
    if not np.isfinite(command).all():
        raise ModelFileError(
            f"Expected a model whose commands are finite, got {command.ravel()} at "
            f"{method.goal_}: its parameters are out of any range."
        )
