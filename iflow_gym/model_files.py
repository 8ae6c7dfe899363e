"""Model files: safetensors with a JSON header; nothing in them is executed."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

SCHEMA_VERSION = 1
"""Version of the model files that are written."""


class ModelFileError(ValueError):
    """A model file is not what it should be."""


_BAD_FILE = (
    safetensors.SafetensorError,
    ArithmeticError,
    AttributeError,
    LookupError,
    RuntimeError,
    TypeError,
    ValueError,  # np.linalg.LinAlgError too
)
"""What reading a file that `save` did not write may raise: its contents are anyone's."""


def write_model_file(
    path: str | os.PathLike[str],
    header: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray[Any, Any]],
) -> Path:
    """Write arrays of finite floating numbers, and a header with the schema version added.

    The file appears whole or not at all. Raises ValueError for other arrays.
    """
    for key, array in arrays.items():
        _check_numbers(key, array)
    target = Path(path)
    partial = target.with_name(f"{target.name}.{os.getpid()}.partial")
    content = safetensors.numpy.save(
        {key: np.ascontiguousarray(array) for key, array in arrays.items()},
        metadata={"iflow_gym": json.dumps({"schema_version": SCHEMA_VERSION, **header})},
    )
    partial.write_bytes(content)
    partial.replace(target)
    return target


@contextmanager
def model_file_errors(path: str | os.PathLike[str], method: str) -> Iterator[None]:
    """Turn whatever the contents of a file raise into a ModelFileError that names the file."""
    try:
        yield
    except KeyError as error:
        raise ModelFileError(
            f"{path} is no whole {method!r} model: expected {error} in it, got none."
        ) from error
    except _BAD_FILE as error:
        raise ModelFileError(f"{path} is no whole {method!r} model: {error}.") from error


def read_model_file(
    path: str | os.PathLike[str],
) -> tuple[dict[str, Any], dict[str, np.ndarray[Any, Any]]]:
    """Return the header and the arrays of a model file; nothing in it is executed."""
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            header = json.loads((file.metadata() or {})["iflow_gym"])
            arrays = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (no dict)
        if not isinstance(header, dict):
            raise ValueError(f"its header is {header!r}")
        if missing := {"schema_version", "method", "config", "n_dims"} - set(header):
            raise ValueError(f"its header is without {sorted(missing)}")
        version = header["schema_version"]
        if type(version) is not int or version < 1:
            raise ValueError(f"its schema version is {version!r}")
    except FileNotFoundError:
        raise
    except _BAD_FILE as error:
        raise ModelFileError(
            f"Expected {path} to be a model file of iflow-gym, got something else: {error}."
        ) from error
    if version > SCHEMA_VERSION:
        raise ModelFileError(
            f"{path} has schema version {version}, this package reads up to {SCHEMA_VERSION}: "
            "upgrade iflow-gym."
        )
    for key, array in arrays.items():
        try:
            _check_numbers(key, array)
        except ValueError as error:
            raise ModelFileError(f"{path} is no model of iflow-gym: {error}") from error
    return header, arrays


def _check_numbers(key: str, array: np.ndarray[Any, Any]) -> None:
    if array.dtype.kind != "f":
        raise ValueError(f"Expected real floating numbers in {key!r}, got {array.dtype}.")
    if not np.isfinite(array).all():
        raise ValueError(f"Expected finite numbers in {key!r}, got NaN or infinity.")
