"""The files of a submission: whether its records are whole, plausible and made by this suite."""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium

from iflow_gym.baselines.registry import METHODS, REFERENCES
from iflow_gym.baselines.runner.fingerprint import core_hash, sha256_of
from iflow_gym.baselines.runner.plan import demonstrations_of, entry_points, family, task_of
from iflow_gym.baselines.runner.store import model_is_whole
from iflow_gym.evaluate import motion_of
from iflow_gym.leaderboard.submission import SUBMISSION_FILE, Submission
from iflow_gym.metrics import metrics_hash, metrics_of
from iflow_gym.registration import POINT_MASS_ID
from iflow_gym.results import Result, ResultFileError, read_result, short_name
from iflow_gym.system import GUARANTEE_KINDS

MOST_BYTES = {".json": 4 * 1024**2, ".safetensors": 256 * 1024**2}
"""Largest files that are read."""

MOST_FILES = 20_000

MEAN_RTOL = 1e-9
"""How far a score may be from the mean of the values that it is the mean of."""


def read_records(folder: Path, refuse: Callable[[str], object]) -> list[Result]:
    """Return the records of a method's folder that can be read; `refuse` is told of the others.

    Nothing outside the folder is opened: links are refused, and the names of the files are those
    that the records' contents make. JSON must be strict, without NaN and without a key twice.
    """
    records: list[Result] = []
    models: set[str] = set()
    for count, path in enumerate(sorted(folder.iterdir())):
        if count == MOST_FILES:
            refuse(f"expected at most {MOST_FILES} files in {folder}")
            break
        suffix = path.suffix
        if path.is_symlink() or not path.is_file():
            refuse(f"{path.name}: expected a file, got a link or a folder")
        elif path.name in (SUBMISSION_FILE, "README.md"):
            continue
        elif suffix not in MOST_BYTES:
            refuse(f"{path.name}: expected records, models and {SUBMISSION_FILE} alone")
        elif (size := path.stat().st_size) > MOST_BYTES[suffix]:
            refuse(f"{path.name}: expected at most {MOST_BYTES[suffix]} bytes, got {size}")
        elif suffix == ".safetensors":
            models.add(path.name)
        else:
            try:
                _parse_strictly(path)
                result = read_result(path)
                if (expected := str(result.path)) != f"{folder.name}/{path.name}":
                    raise ResultFileError(f"it holds the record of {expected}")
            except (ValueError, RecursionError) as error:
                refuse(f"{path.name}: {error or type(error).__name__}")
            else:
                records.append(result)
    named = {result.model for result in records}
    for name in sorted(models - named):
        refuse(f"{name}: expected a record beside it that names it, got none")
    return records


def _parse_strictly(path: Path) -> None:
    def no_constant(text: str) -> None:
        raise ValueError(f"expected strict JSON, got {text}")

    def no_twice(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len({key for key, _ in pairs}) < len(pairs):
            raise ValueError("expected each key once, got one twice")
        return dict(pairs)

    json.loads(
        path.read_text(encoding="utf-8"), parse_constant=no_constant, object_pairs_hook=no_twice
    )


def wrong_with(result: Result, submission: Submission | None, folder: Path) -> Iterator[str]:
    """Yield what is wrong with a record, without running anything of its method."""
    known = gymnasium.registry.keys() - {POINT_MASS_ID}
    if result.environment not in known or not result.environment.startswith("iflow/"):
        yield f"expected an environment of the suite, got {result.environment!r}"
        return
    if (true := family(result.environment)) != result.family:
        yield f"expected the family {true!r}, got {result.family!r}"
    if result.reference != (result.method in REFERENCES):
        yield "expected a reference where the suite has one of this name, and only there"
    registered = METHODS.get(result.method) or REFERENCES.get(result.method)
    if registered is not None and result.target != registered:
        yield f"expected the suite's own {registered}, got {result.target!r}: take another name"
    if submission is not None and result.title != submission.title:
        yield f"expected the title of {SUBMISSION_FILE}, {submission.title!r}, got {result.title!r}"
    yield from _other_hashes(result)
    if not result.ok:
        return
    if result.hashes.get("config") != sha256_of(result.config):
        yield "expected the hash of its config, got another one"
    if submission is not None and result.guarantee is not None:
        kinds = GUARANTEE_KINDS
        if kinds.index(result.guarantee.kind) < kinds.index(submission.guarantee):
            yield (
                f"expected the claimed guarantee, {submission.guarantee!r}, got that the fitted "
                f"model itself says {result.guarantee.kind!r}"
            )
    if not result.reference:
        name = result.path.with_suffix(".safetensors").name
        if result.model != name:
            yield f"expected the model {name}, got {result.model!r}"
        elif not model_is_whole(folder / name):
            yield f"expected a whole model file {name}, got none"
    yield from _implausible(result)


def _other_hashes(result: Result) -> Iterator[str]:
    motion = motion_of(task_of(result.environment))
    expected = {
        "metrics": metrics_hash(motion),
        "data": demonstrations_of(result.environment).sha256,
        "core": core_hash(entry_points(result.environment), motion),
    }
    words = {
        "metrics": "other definitions of the metrics",
        "data": "other demonstrations",
        "core": "another version of what evaluates",
    }
    for name, value in expected.items():
        if (found := result.hashes.get(name)) != value:
            yield (
                f"made with {words[name]} (hash {str(found)[:12]}, here {value[:12]}): run its "
                "cell again with this version"
            )


def _implausible(result: Result) -> Iterator[str]:
    """Yield where the numbers of a record contradict each other."""
    names = {metric.name for metric in metrics_of(motion_of(task_of(result.environment)))}
    if names != set(result.metrics):
        yield f"expected the metrics {sorted(names)}, got {sorted(result.metrics)}"
    scored = len(demonstrations_of(result.environment).split(result.protocol).score)
    for name, values in result.per_demonstration.items():
        if len(values) != scored:
            yield f"expected {scored} values of {name}, got {len(values)}"
            continue
        present = [value for value in values if value is not None]
        for what, function, found in (
            ("mean", statistics.fmean, result.metrics.get(name)),
            ("median", statistics.median, result.medians.get(name)),
        ):
            expected = function(present) if present else None
            if not _near(expected, found):
                yield f"expected {name} to be the {what} of its values, {expected}, got {found}"
    for name in ("converged", "diverged", "attraction", "perturbation_recovery"):
        value = result.metrics.get(name)
        if value is not None and value > 1:
            yield f"expected {name} to be at most 1, got {value}"


def _near(left: float | None, right: float | None) -> bool:
    if left is None or right is None:
        return left is right
    return left == right or math.isclose(left, right, rel_tol=MEAN_RTOL, abs_tol=1e-12)


def label(result: Result) -> str:
    """Return a cell in words."""
    return f"{short_name(result.environment)}, {result.protocol}, seed {result.seed}"
