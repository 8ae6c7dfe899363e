"""Model files of any method: what one is, and a load that trusts nothing in it.

`inspect_model` reads a file's header and no array; `load_model` finds the method by the name in the
header, loads it, and evaluates it. A file may come from anyone: it is refused before memory is
taken for it, names in it are looked up and never imported or opened, nothing in it is executed.
"""

from __future__ import annotations

import json
import math
import os
import stat
import struct
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from iflow_gym.demonstration_files import KEY as DEMONSTRATIONS
from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.model_files import SCHEMA_VERSION, ModelFileError
from iflow_gym.primitive import MovementPrimitive
from iflow_gym.system import DynamicalSystem, Method

MOST_BYTES = 2**26
"""Of a model file; the suite's own have a few kilobytes."""

MOST_HEADER_BYTES = 2**20
"""Of its header: parsed JSON takes up to a hundred times its length."""

MOST_ROWS: Mapping[str, int] = {"inducing": 4000}
"""Rows of arrays by name, where loading builds a matrix of rows x rows."""

ITEM_BYTES = {"F16": 2, "F32": 4, "F64": 8}
"""Of an array's numbers, by safetensors' names of their types."""

N_PROBES = 256
"""States in the demonstrations' box at which a loaded model is evaluated, beside the corners."""

N_CORNERS = 64
"""Most corners of the box that are probed: there are 2^d."""

PROBE_STEPS = 10
"""Steps of a movement primitive that is probed; it is told of a tenth of its duration each."""

FIT_KEY = "iflow_gym_fit"
"""Of the record of a fit, in a file's metadata."""

_WRONG = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    LookupError,
    MemoryError,
    RuntimeError,
    TypeError,
    ValueError,
)
"""What loading or evaluating a model may raise whose settings or numbers are absurd."""


@dataclass(frozen=True)
class ModelInfo:
    """What the header of a model file says."""

    path: Path
    method: str
    """The method's name, as the file has it: anyone's word."""
    config: dict[str, Any]
    """The method's settings by name."""
    n_dims: int
    """Dimension d of the state."""
    schema_version: int
    shapes: dict[str, tuple[int, ...]]
    """Of the arrays by name."""
    n_bytes: int
    """Length of the file."""
    fit: dict[str, Any] | None = None
    """What was said of its fit (`fit_records`), if anything: anyone's word, too."""

    @property
    def is_cycle(self) -> bool:
        """Whether the motion repeats: a period is stored beside the goal."""
        return "period" in self.shapes


def inspect_model(path: str | os.PathLike[str], *, most_bytes: int = MOST_BYTES) -> ModelInfo:
    """Return what the header of a model file says; no array is read.

    Parameters
    ----------
    path
        The file.
    most_bytes
        A longer file is refused.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ModelFileError
        If it is no model file of this package, is cut or longer than its header says, or was
        written by a later version.
    """
    path = Path(path)
    if not stat.S_ISREG((status := path.stat()).st_mode):
        raise ModelFileError(
            f"Expected {path} to be a model file, got a {_kind(status.st_mode)}: name the file."
        )
    with _refusals(path), path.open("rb") as file:
        return _inspected(path, file, status.st_size, most_bytes)


def load_model(
    path: str | os.PathLike[str],
    *,
    method: type[Any] | str | None = None,
    demonstrations: Demonstrations | None = None,
    most_bytes: int = MOST_BYTES,
) -> Any:
    """Load a fitted method from the file that its `save` wrote, and see that it works.

    Parameters
    ----------
    path
        The file.
    method
        The class to load it with, or its name: a registered one, or ``"module:Class"``, which is
        imported. By default the method of the registry that the file names; what the file names is
        never imported.
    demonstrations
        What it is to be used on: a model of other dimensions or of the other kind of motion is
        refused, and so is one that is not finite in their bounding box. Without them it is
        evaluated at its goal alone.
    most_bytes
        A longer file is refused.

    Returns
    -------
    DynamicalSystem or MovementPrimitive
        An instance of the method.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ModelFileError
        If it is anything but a whole model whose values are finite.
    UnknownNameError
        If the method is named and unknown.
    """
    from iflow_gym.baselines.registry import load_method

    if isinstance(method, str):
        method = load_method(method)
    info = inspect_model(path, most_bytes=most_bytes)
    with _refusals(info.path):
        cls = _registered(info.method) if method is None else method
        for name, most in MOST_ROWS.items():
            if (shape := info.shapes.get(name, ())) and shape[0] > most:
                raise ValueError(f"expected at most {most} rows of {name!r}, got {shape[0]}")
        try:
            model = cls.load(info.path)
        except ModelFileError:
            raise
        except MemoryError as error:
            raise ValueError(f"loading it takes more memory than there is ({error})") from error
        except _WRONG as error:
            raise ValueError(
                f"expected a whole {info.method!r} model, got {type(error).__name__}: {error}"
            ) from error
        if isinstance(model, Method):
            _check_use(model, demonstrations)
            _check_finite(model, demonstrations)
    return model


# The header -------------------------------------------------------------------------------------


@contextmanager
def _refusals(path: Path) -> Iterator[None]:
    """Turn what is wrong with a file into a ModelFileError that names it."""
    try:
        yield
    except ModelFileError:
        raise
    except (ValueError, RecursionError) as error:
        raise ModelFileError(f"{path} is no model file to use: {error}.") from error


def _kind(mode: int) -> str:
    return "folder" if stat.S_ISDIR(mode) else "device or pipe"


def _inspected(path: Path, file: BinaryIO, n_bytes: int, most_bytes: int) -> ModelInfo:
    if n_bytes > most_bytes:
        raise ValueError(
            f"expected at most {most_bytes} bytes, got {n_bytes}: pass most_bytes= if you trust it"
        )
    start = file.read(8)
    length: int = struct.unpack("<Q", start)[0] if len(start) == 8 else n_bytes
    if length > n_bytes - 8:
        raise ValueError("expected a safetensors file, got another kind, or one that was cut short")
    if length > MOST_HEADER_BYTES:
        raise ValueError(f"expected a header of at most {MOST_HEADER_BYTES} bytes, got {length}")
    listed = _as_object(file.read(length), "its list of arrays")
    texts = listed.pop("__metadata__", {})
    text = texts.get("iflow_gym") if isinstance(texts, dict) else None
    if not isinstance(text, str):
        own = isinstance(texts, dict) and DEMONSTRATIONS in texts
        what = "demonstrations" if own else "a file of another program"
        raise ValueError(f"expected the header of a model of iflow-gym, got {what}")
    header = _as_object(text, "its header")
    _check_header(header)
    fit = texts.get(FIT_KEY)
    shapes = _shapes(listed, n_bytes - 8 - length)
    return ModelInfo(
        path,
        header["method"],
        header["config"],
        header["n_dims"],
        header["schema_version"],
        shapes,
        n_bytes,
        None if fit is None else _as_object(fit, "the record of its fit"),
    )


def _as_object(text: bytes | str, what: str) -> dict[str, Any]:
    try:
        value = json.loads(text)
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"expected {what} to be JSON, got {error}") from error
    if not isinstance(value, dict):
        raise ValueError(f"expected {what} to be a JSON object, got {type(value).__name__}")
    return value


def _check_header(header: Mapping[str, Any]) -> None:
    version = header.get("schema_version")
    if type(version) is not int or version < 1:
        raise ValueError(f"expected a schema version >= 1, got {_short(version)}")
    if version > SCHEMA_VERSION:
        raise ValueError(
            f"expected a schema version of at most {SCHEMA_VERSION}, got {_short(version)}: "
            "upgrade iflow-gym"
        )
    for key, kind in (("method", str), ("config", dict), ("n_dims", int)):
        if type(value := header.get(key)) is not kind:
            raise ValueError(f"expected {key} to be of type {kind.__name__}, got {_short(value)}")
    if header["n_dims"] < 1:
        raise ValueError(f"expected n_dims to be >= 1, got {_short(header['n_dims'])}")


def _shapes(listed: Mapping[str, Any], n_bytes: int) -> dict[str, tuple[int, ...]]:
    """Return the arrays' shapes; their numbers have to fill what follows the header."""
    shapes, total = {}, 0
    for name, entry in listed.items():
        if not isinstance(entry, dict):
            raise ValueError(f"expected type, shape and place of {_short(name)}, got none")
        kind = entry.get("dtype")
        if not (isinstance(kind, str) and kind in ITEM_BYTES):
            raise ValueError(
                f"expected numbers of type {' or '.join(ITEM_BYTES)} in {_short(name)}, got "
                f"{_short(kind)}"
            )
        shape = entry.get("shape")
        if not isinstance(shape, list) or any(type(n) is not int or n < 0 for n in shape):
            raise ValueError(f"expected a shape of {_short(name)}, got {_short(shape)}")
        shapes[name] = tuple(shape)
        total += ITEM_BYTES[kind] * math.prod(shape)
    if total != n_bytes:
        raise ValueError(
            f"expected {_short(total)} bytes of arrays, as its header says, got {n_bytes}: it was "
            "cut or changed"
        )
    return shapes


def _short(value: Any) -> str:
    """Return how a value of a file looks, in a few characters: it may be of any length."""
    if isinstance(value, int) and abs(value) >= 10**20:
        return "a huge number"
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


# The model --------------------------------------------------------------------------------------


def _registered(name: str) -> type[Method]:
    from iflow_gym.baselines.registry import METHODS, load_method

    if name == "conditional-imitation-flow":
        raise ValueError(
            "expected one motion, got a model of several: write the one that you mean by "
            "ConditionalImitationFlow.load(path).at(context).save(other_path)"
        )
    if name not in METHODS:
        raise ValueError(
            f"expected a method of the registry ({', '.join(METHODS)}), got {_short(name)}: pass "
            "method= (--method), the class that wrote it"
        )
    return load_method(name)


def _check_use(model: Method, demonstrations: Demonstrations | None) -> None:
    if demonstrations is None:
        return
    if model.n_dims_ != demonstrations.n_dims:
        raise ValueError(
            f"expected a model of {demonstrations.n_dims} dimensions, as {demonstrations.name!r} "
            f"has, got one of {model.n_dims_}"
        )
    kinds = ["ends at a goal", "repeats"]
    came, expected = (kinds[p is not None] for p in (model.period_, demonstrations.period))
    if came != expected:
        raise ValueError(
            f"expected a model of a motion that {expected}, as {demonstrations.name!r} does, got "
            f"one of a motion that {came}"
        )


def _check_finite(model: Method, demonstrations: Demonstrations | None) -> None:
    """Raise ValueError unless what a model says at states of the box is finite."""
    if demonstrations is None:
        states, seconds, where = model.goal_[None], 1.0, "its goal"
    else:
        states = probes(demonstrations)
        seconds, where = float(demonstrations.durations.mean()), "the demonstrations' box"
    try:
        with np.errstate(all="ignore"):
            if isinstance(model, DynamicalSystem):
                values = model.velocity(states)
            elif isinstance(model, MovementPrimitive):
                values = model.rollout(states, PROBE_STEPS, seconds / PROBE_STEPS)
            else:
                return
    except _WRONG as error:
        raise ValueError(
            f"expected values in {where}, got {type(error).__name__}: {error}"
        ) from error
    if not np.isfinite(values).all():
        raise ValueError(
            f"expected finite values in {where}, got NaN or infinity: its numbers or settings are "
            "absurd"
        )


def probes(demonstrations: Demonstrations) -> FloatArray:
    """Return states, shape (n, d), in the demonstrations' bounding box, its corners and starts.

    The same ones at every call.
    """
    box, d = demonstrations.bounding_box, demonstrations.n_dims
    rng = np.random.default_rng(0)
    inside = rng.uniform(size=(N_PROBES, d))
    bits = np.arange(min(2**d, N_CORNERS))[:, None] >> np.arange(d) & 1
    shares = np.concatenate([inside, bits.astype(np.float64)])
    found: FloatArray = np.concatenate(
        [
            box.low + shares * (box.high - box.low),
            demonstrations.starts,
            demonstrations.centre[None],
        ]
    )
    return found
