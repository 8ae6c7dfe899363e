"""Files of demonstrations: safetensors with a JSON header; nothing in them is executed.

The header says name, units, source and what was done to the recordings; the arrays are
``positions.i`` and ``velocities.i`` of recording i, ``dt``, and ``goal`` or ``period``, all
float64. A hash of the numbers goes with them, so that a damaged file is told from a whole one.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from iflow_gym.demonstrations import Demonstrations

SCHEMA_VERSION = 1
"""Version of the files that are written."""

KEY = "iflow_gym_demonstrations"
"""Of the JSON in a file's metadata."""

MOST_BYTES = 2**30
"""Of a file that is read."""


class DemonstrationFileError(ValueError):
    """A file of demonstrations is not what it should be."""


class _ModelInsteadError(Exception):
    """A file holds a model."""


@dataclass(frozen=True, eq=False)
class DemonstrationFile:
    """What a file holds."""

    demonstrations: Demonstrations
    history: tuple[str, ...]
    """What was done to the recordings before they were saved."""


def save_demonstrations(
    demonstrations: Demonstrations,
    path: str | os.PathLike[str],
    *,
    history: Sequence[str] = (),
) -> Path:
    """Write demonstrations to a file, which appears whole or not at all."""
    target = Path(path)
    partial = target.with_name(f"{target.name}.{os.getpid()}.partial")
    partial.write_bytes(demonstrations_as_bytes(demonstrations, history=history))
    partial.replace(target)
    return target


def demonstrations_as_bytes(
    demonstrations: Demonstrations, *, history: Sequence[str] = ()
) -> bytes:
    """Return the contents of a file of demonstrations."""
    import safetensors.numpy

    demos = demonstrations
    arrays: dict[str, np.ndarray[Any, Any]] = {"dt": np.array(demos.dt)}
    for kind in ("positions", "velocities"):
        arrays |= {f"{kind}.{i}": a for i, a in enumerate(getattr(demos, kind))}
    if demos.goal is None:
        assert demos.period is not None
        arrays["period"] = np.array([demos.period])
    else:
        arrays["goal"] = demos.goal
    header = {
        "schema_version": SCHEMA_VERSION,
        "name": demos.name,
        "length_unit": demos.length_unit,
        "source": demos.source,
        "held_out": demos.held_out,
        "recordings": len(demos),
        "sha256": demos.sha256,
        "history": list(history),
    }
    _checked(header, arrays)  # what is written can be read
    content: bytes = safetensors.numpy.save(
        {key: np.ascontiguousarray(array) for key, array in arrays.items()},
        metadata={KEY: json.dumps(header)},
    )
    return content


def load_demonstrations(path: str | os.PathLike[str]) -> Demonstrations:
    """Read demonstrations that `save_demonstrations` wrote.

    Raises
    ------
    DemonstrationFileError
        If the file is anything else, is damaged, or of a later version.
    OSError
        If it cannot be read.
    """
    return read_demonstration_file(path).demonstrations


def read_demonstration_file(path: str | os.PathLike[str]) -> DemonstrationFile:
    """Read a file of demonstrations with its history; raises as `load_demonstrations` does."""
    file = Path(path)
    if (size := file.stat().st_size) > MOST_BYTES:
        raise DemonstrationFileError(
            f"Expected {path} to be a file of demonstrations, got {size} bytes; the most is "
            f"{MOST_BYTES}."
        )
    return demonstrations_from_bytes(file.read_bytes(), str(path))


def demonstrations_from_bytes(content: bytes, name: str) -> DemonstrationFile:
    """Read what `demonstrations_as_bytes` returned; `name` is for messages."""
    import safetensors
    import safetensors.numpy

    try:
        header, arrays = _unpacked(content)
        return _checked(header, arrays)
    except _ModelInsteadError:
        raise DemonstrationFileError(
            f"Expected {name} to be a file of demonstrations, got one that holds a model: give the "
            "demonstrations, which `iflow-gym import` wrote."
        ) from None
    except (
        safetensors.SafetensorError,
        ArithmeticError,
        AttributeError,
        LookupError,
        MemoryError,
        RecursionError,
        TypeError,
        ValueError,
    ) as error:
        said = f"no {error}" if isinstance(error, KeyError) else str(error)
        raise DemonstrationFileError(
            f"Expected {name} to be a file of demonstrations of iflow-gym, got something else or a "
            f"damaged one: {said.rstrip('.')}. Make it anew with `iflow-gym import`."
        ) from error


def _unpacked(content: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray[Any, Any]]]:
    """Return the header and the arrays; sizes are checked against the content's length."""
    import safetensors.numpy

    arrays = safetensors.numpy.load(content)
    length = int.from_bytes(content[:8], "little")
    metadata = json.loads(content[8 : 8 + length]).get("__metadata__") or {}
    if KEY not in metadata:
        if "iflow_gym" in metadata:
            raise _ModelInsteadError
        raise ValueError("it holds other arrays")
    header = json.loads(metadata[KEY])
    if not isinstance(header, dict):
        raise ValueError(f"its header is {header!r:.60}")
    version = header["schema_version"]
    if type(version) is not int or version < 1:
        raise ValueError(f"its schema version is {version!r:.60}")
    if version > SCHEMA_VERSION:
        raise ValueError(
            f"its schema version is {version}, this package reads up to {SCHEMA_VERSION}: upgrade "
            "iflow-gym"
        )
    return header, arrays


def _checked(
    header: Mapping[str, Any], arrays: Mapping[str, np.ndarray[Any, Any]]
) -> DemonstrationFile:
    """Return the demonstrations; raise ValueError for what is none."""
    n = header["recordings"]
    if type(n) is not int or not 1 <= n <= len(arrays):
        raise ValueError(f"it says that it has {n!r:.60} recordings")
    for key in ("name", "length_unit", "source", "sha256"):
        if not isinstance(header[key], str):
            raise ValueError(f"its {key} is {header[key]!r:.60}")
    history = header["history"]
    if not isinstance(history, list) or not all(isinstance(line, str) for line in history):
        raise ValueError(f"its history is {history!r:.60}")
    ends = "goal" if "goal" in arrays else "period"
    expected = {"dt", ends} | {f"{k}.{i}" for k in ("positions", "velocities") for i in range(n)}
    if set(arrays) != expected:
        missing, more = sorted(expected - set(arrays)), sorted(set(arrays) - expected)
        raise ValueError(f"it lacks the arrays {missing} and has {more} too many")
    for key, array in arrays.items():
        if array.dtype != np.float64 or not np.isfinite(array).all():
            raise ValueError(f"{key} is not finite float64 but {array.dtype}")
    if arrays["dt"].shape != (n,):
        raise ValueError(f"dt is of shape {arrays['dt'].shape}, not {(n,)}")
    goal = arrays.get("goal")
    points = [arrays[f"positions.{i}"] for i in range(n)]
    tolerance = None
    if goal is not None:  # how far ends lie apart was judged when the set was made
        tolerance = float(np.finfo(np.float64).max)
    elif arrays["period"].shape != (1,):
        raise ValueError(f"period is of shape {arrays['period'].shape}, not (1,)")
    with np.errstate(all="ignore"):  # absurd numbers are told by the checks
        demos = Demonstrations.from_arrays(
            points,
            dt=arrays["dt"].tolist(),
            velocities=[arrays[f"velocities.{i}"] for i in range(n)],
            goal=goal,
            goal_tolerance=tolerance,
            period=None if goal is not None else float(arrays["period"][0]),
            name=header["name"],
            length_unit=header["length_unit"],
            source=header["source"],
            held_out=header["held_out"],
        )
        sizes = [demos.bounding_box.diagonal, demos.peak_speed]
    if not np.isfinite(sizes).all():
        raise ValueError("its numbers are so large that their distances are infinite")
    if demos.sha256 != header["sha256"]:
        raise ValueError("its numbers are not those that were saved: their hash differs")
    return DemonstrationFile(demos, tuple(history))
