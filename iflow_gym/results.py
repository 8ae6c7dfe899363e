"""The Result record: what a run says of one cell, and all that the leaderboard reads.

A cell is (method, environment, protocol, seed); each has one JSON file in a folder of results,

    <folder>/<method>/<environment's short name>.<protocol>.seed<k>.json

with the fitted model beside it, under the same name with ``.safetensors`` for ``.json``. Keys are
sorted and arrays are short, so that the files can be kept under version control.

JSON has no numbers for nan and infinity. nan, which no metric means, becomes null, "not
applicable"; infinity is a score, that of a runaway, and becomes the string ``"inf"`` (``"-inf"``).
`read_result` turns the strings back into numbers in `Result.metrics`, `medians`,
`per_demonstration` and `fit`.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from iflow_gym.demonstrations import PROTOCOLS
from iflow_gym.metrics import Motion, metrics_of
from iflow_gym.system import Guarantee

SCHEMA_VERSION = 1
"""Version of the result files that `write_result` writes."""

Status = Literal["ok", "failed"]

MAY_BE_NEGATIVE = "nll_"
"""How the names of the metrics begin that can be negative: densities can exceed 1."""

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]*")


@dataclass(frozen=True)
class Result:
    """What is known of one cell: its scores or why it has none, and what they were made with."""

    method: str
    """Name of the method, the folder of its results."""
    title: str
    """The method's name as people write it."""
    environment: str
    """Id of the environment, such as ``"iflow/LASA-Angle-v0"``."""
    family: str
    """Family that the environment is aggregated in, such as ``"LASA-26"``."""
    protocol: str
    """``"reproduction"`` or ``"generalisation"``."""
    seed: int
    """Seed of the fit, and of the pushes and states that scores are taken at."""
    preset: str
    """Preset that the cell was run under."""
    status: Status
    """Whether there are scores."""
    key: str
    """sha256 over all that decides the scores; a run redoes the cells whose key has changed."""
    created: str
    """When, UTC, ISO 8601."""
    reason: str | None = None
    """Why there are no scores; None where there are."""
    reference: bool = False
    """Whether the row is a reference that does not compete."""
    uses_time: bool = False
    """Whether the method follows a clock: it has no field, and does not compete with those."""
    metrics: dict[str, float | None] = field(default_factory=dict)
    """Every metric of the environment's kind of motion (`iflow_gym.metrics.metrics_of`) by name,
    where one has a value for each scored demonstration their mean; None where it does not apply.
    Empty for a failed cell."""
    medians: dict[str, float | None] = field(default_factory=dict)
    """Median over the scored demonstrations, of the metrics that have a value for each."""
    per_demonstration: dict[str, list[float | None]] = field(default_factory=dict)
    """Value for each scored demonstration, in the order of the split."""
    likelihoods: dict[str, list[float]] = field(default_factory=dict)
    """Log densities, nats, under this cell's model of the scored demonstrations of each motion that
    it is to be told apart from, by environment id; empty where there are none."""
    returns: dict[str, float] = field(default_factory=dict)
    """Rewards a step of an episode from each recording's start, by the environment's own reward:
    `mean`, `least` and `greatest` over the recordings; of drumming also what
    `iflow_gym.envs.hit_reward` pays (`hits`), and of the strokes `stroke_force`, N, and
    `stroke_error`, s. Empty where none was asked for."""
    guarantee: Guarantee | None = None
    """What the method says of its stability; None for a failed cell and for a reference."""
    target: str | None = None
    """``"module:Class"`` that was run, by which its model can be loaded."""
    config: dict[str, Any] = field(default_factory=dict)
    """The method's settings."""
    integrator: str | None = None
    """How the method's own step integrates; None for what is no dynamical system."""
    dt: float | None = None
    """Mean of the demonstrations' sample times, at which the policy commanded, seconds."""
    fit: dict[str, float | None] = field(default_factory=dict)
    """How it was fitted: `batch_size` cells together, in `batch_wall_seconds` and
    `batch_cpu_seconds`, whose shares are the metrics `fit_seconds` and `fit_cpu_seconds`;
    `evaluate_seconds`, what scoring took."""
    hashes: dict[str, str] = field(default_factory=dict)
    """sha256 of `data`, `metrics`, `code` (the method's), `core` (the suite's) and `config`."""
    versions: dict[str, str] = field(default_factory=dict)
    """Of Python, of this package and of the libraries."""
    hardware: dict[str, str | int | None] = field(default_factory=dict)
    """`cpu`, `cores`, `threads` that the fit could use, `platform`."""
    model: str | None = None
    """Name of the file of the fitted model, beside the record."""
    schema_version: int = SCHEMA_VERSION
    """Version of this schema."""

    def __post_init__(self) -> None:
        if self.status not in get_args(Status):
            raise ValueError(f"Expected status 'ok' or 'failed', got {self.status!r}.")
        if (self.status == "failed") != bool(self.reason):
            raise ValueError(
                f"Expected a reason where a cell failed and only there, got {self.reason!r} with "
                f"status {self.status!r}."
            )
        self.path  # noqa: B018 (checks the names that the path is made of)

    @property
    def ok(self) -> bool:
        """Whether there are scores."""
        return self.status == "ok"

    @property
    def path(self) -> Path:
        """Where the record lies in a folder of results."""
        return result_path(self.method, self.environment, self.protocol, self.seed)


class ResultFileError(ValueError):
    """A file in a folder of results is not what it should be."""


def check_metrics(metrics: Mapping[str, float | None]) -> None:
    """Raise ValueError unless every metric of a kind of motion has a number it can have, or None.

    A negative value is one that only a log-likelihood can have; nan is no value.
    """
    missing = [
        {metric.name for metric in metrics_of(motion)} - set(metrics) for motion in get_args(Motion)
    ]
    if all(missing):
        raise ValueError(f"expected every metric, got none of {sorted(missing[0])}")
    for name, value in metrics.items():
        _check_value(name, value)


def _check_value(name: str, value: float | None) -> None:
    if value is not None and (
        math.isnan(value) or (value < 0 and not name.startswith(MAY_BE_NEGATIVE))
    ):
        raise ValueError(f"expected {name} to be at least 0, infinite or null, got {value}")


def short_name(environment: str) -> str:
    """Return an environment's id without its namespace: ``"LASA-Angle-v0"``."""
    return environment.rpartition("/")[2]


def result_path(method: str, environment: str, protocol: str, seed: int) -> Path:
    """Return where a cell's record lies, relative to the folder of results."""
    for label, name in (("method", method), ("environment", short_name(environment))):
        if not _NAME.fullmatch(name):
            raise ValueError(
                f"Expected the name of the {label} to be made of letters, digits, '.', '_', '+' "
                f"and '-', since it names a file, got {name!r}."
            )
    if protocol not in PROTOCOLS:
        raise ValueError(f"Expected a protocol of {PROTOCOLS}, got {protocol!r}.")
    return Path(method) / f"{short_name(environment)}.{protocol}.seed{int(seed)}.json"


def write_result(folder: str | os.PathLike[str], result: Result) -> Path:
    """Write a record into a folder of results, which is made where absent, and return its path.

    The file appears whole or not at all: a neighbour ending in ``.partial`` is written, brought to
    the disk and renamed.
    """
    target = Path(folder) / result.path
    target.parent.mkdir(parents=True, exist_ok=True)
    write_whole({target: result_text(result).encode()})
    return target


def result_text(result: Result) -> str:
    """Return the text of a record's file; raise what JSON raises for what it cannot hold."""
    values = _encoded(dataclasses.asdict(result))
    return json.dumps(values, sort_keys=True, indent=1, allow_nan=False) + "\n"


def write_whole(contents: Mapping[Path, bytes]) -> None:
    """Write files whose folders exist, all of them or, where one cannot be written, none.

    Neighbours ending in ``.partial`` are written, brought to the disk and renamed.
    """
    partials = {
        target: target.with_name(f"{target.name}.{os.getpid()}.partial") for target in contents
    }
    try:
        for target, content in contents.items():
            with partials[target].open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        for target, partial in partials.items():
            partial.replace(target)
    finally:
        for partial in partials.values():
            partial.unlink(missing_ok=True)


def read_result(path: str | os.PathLike[str]) -> Result:
    """Read one record.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ResultFileError
        If the file is cut off, is no result record, lacks a metric or has a value for one that
        it cannot have, or is a newer version's.
    """
    file = Path(path)
    try:
        values = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:  # of JSON, of UTF-8, of what is nested too deep
        raise ResultFileError(
            f"{file} is no whole JSON file ({error}): delete it and run its cell again."
        ) from error
    if not isinstance(values, dict) or not isinstance(values.get("schema_version"), int):
        raise ResultFileError(
            f"{file} is no result record (no schema_version): move it out of the folder of results."
        )
    if (version := values["schema_version"]) > SCHEMA_VERSION:
        raise ResultFileError(
            f"{file} has schema version {version}, this package reads up to {SCHEMA_VERSION}: "
            "upgrade iflow-gym."
        )
    # Records from before there were such methods and motions lack these.
    values = {"uses_time": False, "likelihoods": {}, "returns": {}, **values}
    known = {f.name for f in dataclasses.fields(Result)}
    if known != set(values):
        raise ResultFileError(
            f"{file} is no whole result record (missing {sorted(known - set(values))}, unknown "
            f"{sorted(set(values) - known)}): delete it and run its cell again."
        )
    try:
        return _decoded(values)
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        raise ResultFileError(
            f"{file} is no valid result record ({error}): delete it and run its cell again."
        ) from error


def read_results(
    folder: str | os.PathLike[str],
    on_error: Callable[[Path, ResultFileError], object] | None = None,
) -> list[Result]:
    """Read every record of a folder of results, sorted by path.

    Parameters
    ----------
    folder
        As `write_result` filled it.
    on_error : function of a path and an error, optional
        Called for each file that cannot be used, in place of raising.

    Raises
    ------
    FileNotFoundError
        If there is no such folder.
    ResultFileError
        Without `on_error`, one for all files that are cut off, foreign, a newer version's, or not
        where their content belongs; it lists each with what to do.
    """
    root = Path(folder)
    if not root.is_dir():
        raise FileNotFoundError(
            f"Expected a folder of results at {root}, got none: run `python baselines/run_all.py`."
        )
    results: list[Result] = []
    errors: list[str] = []
    for path in sorted(root.glob("*/*.json")):
        try:
            result = read_result(path)
            if root / result.path != path:
                raise ResultFileError(
                    f"{path} holds the record of {result.path}: move it there, or delete it."
                )
        except ResultFileError as error:
            if on_error is None:
                errors.append(str(error))
            else:
                on_error(path, error)
        else:
            results.append(result)
    if errors:
        raise ResultFileError("\n".join(errors))
    return results


def _encoded(value: Any) -> Any:
    """Return a value with nan as None and infinities as strings."""
    if isinstance(value, Mapping):
        return {str(key): _encoded(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_encoded(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else ("inf" if value > 0 else "-inf")
    return value


def _number(value: Any) -> float | None:
    if value is None:
        return None
    if isinstance(value, int | float) and not isinstance(value, bool):
        float(value)  # raises for an integer of JSON that is too large for it
        return value
    if value in ("inf", "-inf"):
        return float(value)
    raise ValueError(f'expected a number, null, "inf" or "-inf", got {value!r}')


def _decoded(values: dict[str, Any]) -> Result:
    numbers = {
        name: {key: _number(value) for key, value in values[name].items()}
        for name in ("metrics", "medians", "fit")
    }
    lists = {
        key: [_number(value) for value in entries]
        for key, entries in values["per_demonstration"].items()
    }
    if values["status"] == "ok":
        check_metrics(numbers["metrics"])
    for name, value in numbers["medians"].items():
        _check_value(name, value)
    for name, entries in lists.items():
        for value in entries:
            _check_value(name, value)
    likelihoods = {}
    for name, entries in values["likelihoods"].items():
        likelihoods[name] = [_number(value) for value in entries]
        if any(value is None for value in likelihoods[name]):
            raise ValueError(f"expected log densities of {name}, got {entries}")
    returns = {key: _number(value) for key, value in values["returns"].items()}
    if any(value is None for value in returns.values()):
        raise ValueError(f"expected rewards as numbers, got {returns}")
    guarantee = values["guarantee"]
    return Result(
        **{
            **values,
            **numbers,
            "per_demonstration": lists,
            "likelihoods": likelihoods,
            "returns": returns,
            "guarantee": None if guarantee is None else Guarantee(**guarantee),
        }
    )
