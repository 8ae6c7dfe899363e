"""The plan of a run: which cells there are, which are up to date, and how they go into jobs."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import traceback
from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any, get_args

import gymnasium

from iflow_gym.baselines.registry import (
    METHODS,
    REFERENCES,
    UnknownNameError,
    load_method,
    load_reference,
    unknown,
)
from iflow_gym.baselines.runner.fingerprint import (
    CORE_LIBRARIES,
    MOTION_LIBRARIES,
    core_hash,
    method_code,
    sha256_of,
    versions,
)
from iflow_gym.baselines.runner.presets import Preset, PresetError, load_settings
from iflow_gym.baselines.runner.store import cannot_write, model_is_whole
from iflow_gym.datasets.lasa import MULTI_MODELS
from iflow_gym.demonstrations import Demonstrations
from iflow_gym.evaluate import motion_of
from iflow_gym.metrics import Motion, metrics_hash
from iflow_gym.registration import POINT_MASS_ID, matching_ids, registered_ids
from iflow_gym.results import Result, ResultFileError, read_result, result_path, short_name
from iflow_gym.system import Method

BATCH_SIZE = 15
"""Cells that are fitted together at most, for methods that can. Half of LASA's shapes: two workers
have the same to do, and what a failure in a batch costs stays bounded. Training rounds differently
in another company, which scores show, so that batches depend on the selected environments alone:
not on the number of workers, nor on what is up to date."""

TRIAL = "smoke"
"""The preset whose records are no scores to quote."""

MOST_NAMED = 6
"""Environments that a message names one by one."""


@dataclass(frozen=True)
class Entry:
    """A method or a reference with its settings, ready to be run."""

    name: str
    title: str
    target: str
    """``module:Class``."""
    reference: bool
    stochastic: bool
    """Whether the seed changes the fit."""
    batched: bool
    """Whether several cells are fitted together."""
    settings: dict[str, Any]
    config: dict[str, Any]
    """All settings, defaults included, as JSON holds them."""
    integrator: str | None
    uses_time: bool
    """Whether it follows a clock and has no field."""
    motions: tuple[Motion, ...]
    """What it learns: motions that end at a goal, or that repeat, too."""
    code: str
    """Hash of the code."""
    libraries: tuple[str, ...]
    """Distributions that the code imports."""
    versions: dict[str, str]
    """Of these and of what every record names."""


@dataclass(frozen=True)
class Cell:
    """One (method, environment, protocol, seed), with all that a worker needs to know."""

    entry: Entry
    environment: str
    protocol: str
    seed: int
    preset: str
    time_limit: float
    """Seconds."""
    batch: tuple[str, ...]
    """Paths of the cells that are fitted together with this one, itself among them."""
    key: str
    hashes: dict[str, str]

    @property
    def path(self) -> Path:
        """Where the record lies in the folder of results."""
        return result_path(self.entry.name, self.environment, self.protocol, self.seed)

    @property
    def label(self) -> str:
        """The cell in words."""
        where = short_name(self.environment)
        return f"{self.entry.name} on {where}, {self.protocol}, seed {self.seed}"


@dataclass(frozen=True)
class Job:
    """Cells that one worker does one after the other."""

    batch: tuple[Cell, ...]
    """What is fitted together: a whole batch, or one cell."""
    cells: tuple[Cell, ...]
    """Those of them that are scored and written."""

    def without(self, done: Collection[str]) -> Job:
        """Return what is left to do when cells of these paths are done."""
        return Job(self.batch, tuple(c for c in self.cells if str(c.path) not in done))

    def one_by_one(self) -> list[Job]:
        """Return a job for each cell, which is then fitted alone."""
        return [Job((cell,), (cell,)) for cell in self.cells]


def select_entries(patterns: Sequence[str], preset: str) -> list[Entry]:
    """Return methods and references by globs over their names, or by ``"module:Class"``."""
    names: dict[str, None] = {}
    for pattern in patterns or ("*",):
        if ":" in pattern:
            names[pattern] = None
            continue
        found = [n for n in (*METHODS, *REFERENCES) if fnmatchcase(n, pattern)]
        if not found:
            if Path(pattern).is_file() or Path(f"{pattern}.py").is_file():
                raise _no_class(pattern)
            error = unknown("method", pattern, (*METHODS, *REFERENCES))
            raise UnknownNameError(
                f"{error} A class of your own is named module:Class, such as my_module:MyMethod."
            )
        names |= dict.fromkeys(found)
    entries = [_reference(n) if n in REFERENCES else _method(n, preset) for n in names]
    taken = METHODS | REFERENCES
    for entry in entries:
        if (other := taken.setdefault(entry.name, entry.target)) != entry.target:
            raise UnknownNameError(
                f"Expected methods of different names, got {entry.name!r} from {entry.target} and "
                f"from {other}: give your class another `name`."
            )
    return entries


def _no_class(name: str) -> UnknownNameError:
    """Return the error for a file, or a class in a file, in place of ``module:Class``."""
    file, _, class_name = name.partition(":")
    path = Path(file if file.endswith(".py") else f"{file}.py")
    text = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else ""
    classes = [class_name] if class_name else re.findall(r"^class (\w+)\(", text, re.MULTILINE)
    means = " or ".join(f"{path.stem}:{c}" for c in classes) or f"{path.stem}:ITS_CLASS"
    folder = "" if path.parent == Path() else f", from its folder {path.parent} or with PYTHONPATH"
    return UnknownNameError(
        f"Expected a method's name or a class as module:Class, got {name!r}: {means}{folder}."
    )


def _load(name: str) -> type[Method]:
    """Return a method's class; what goes wrong as its module is imported is told by its line."""
    file = name.partition(":")[0]
    if file.endswith(".py") or "/" in file:
        raise _no_class(name)
    try:
        return load_method(name)
    except SyntaxError as error:
        raise UnknownNameError(
            f"Expected {name} to be importable, got a {type(error).__name__} in {error.filename}, "
            f"line {error.lineno}: {error.msg}."
        ) from error
    except UnknownNameError:
        raise
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        frame = next((f for f in reversed(frames) if f.name == "<module>"), frames[-1])
        raise UnknownNameError(
            f"Expected {name} to be importable, got {type(error).__name__} in {frame.filename}, "
            f"line {frame.lineno}: {error}"
        ) from error


def _check_guarantee(name: str, system: Method) -> None:
    """Refuse a guarantee that is none already before `fit`, as where its reason is empty.

    One that needs what `fit` learns is looked at with the scores.
    """
    try:
        _ = system.guarantee
    except ValueError as error:
        raise UnknownNameError(f"The guarantee of {name}: {error}") from error
    except Exception:
        return


def _reference(name: str) -> Entry:
    reference = load_reference(name)
    code = method_code(REFERENCES[name].partition(":")[0])
    return Entry(
        name=name,
        title=reference.title,
        target=REFERENCES[name],
        reference=True,
        stochastic=False,
        batched=False,
        settings={},
        config={},
        integrator=None,
        uses_time=reference.uses_time,
        motions=get_args(Motion),
        code=code.sha256,
        libraries=code.libraries,
        versions=versions(code.libraries),
    )


def _method(name: str, preset: str) -> Entry:
    method = _load(name)
    registered = name in METHODS
    if registered and method.name != name:
        raise UnknownNameError(
            f"Expected {METHODS[name]} to have the name {name!r} that it is registered under, got "
            f"{method.name!r}."
        )
    settings = load_settings(name, preset, registered=registered)
    try:
        system = method(**settings)
    except (TypeError, ValueError) as error:
        raise PresetError(f"Settings of {name} in preset [{preset}]: {error}") from error
    if not registered:
        _check_guarantee(name, system)
    code = method_code(METHODS.get(name, name).partition(":")[0])
    return Entry(
        name=method.name,
        title=method.title,
        target=METHODS.get(name, name),
        reference=False,
        stochastic=method.stochastic_fit,
        batched=method._fit_many is not Method._fit_many,
        settings=settings,
        config=json.loads(json.dumps(dataclasses.asdict(system.config), default=str)),
        integrator=method.integrator,
        uses_time=method.uses_time,
        motions=_motions(method),
        code=code.sha256,
        libraries=code.libraries,
        versions=versions(code.libraries),
    )


def _motions(method: type[Method]) -> tuple[Motion, ...]:
    goal: tuple[Motion, ...] = ("goal",) if method.learns_goals else ()
    cycles: tuple[Motion, ...] = ("cycle", "drumming") if method.learns_cycles else ()
    return goal + cycles


def select_environments(patterns: Sequence[str]) -> list[str]:
    """Return ids of the suite's environments by globs over ids and short names."""
    # PointMass takes the caller's own demonstrations.
    return matching_ids(patterns, [i for i in registered_ids() if i != POINT_MASS_ID])


def family(environment: str) -> str:
    """Return the family that an environment is aggregated in."""
    name = short_name(environment)
    if not name.startswith("LASA-"):
        return name.partition("-")[0]
    shape = name.removeprefix("LASA-").rpartition("-v")[0]
    return "LASA-Multi" if shape in MULTI_MODELS else "LASA-26"


@cache
def task_of(environment: str) -> Any:
    """Return an environment, unwrapped."""
    return gymnasium.make(environment).unwrapped


def demonstrations_of(environment: str) -> Demonstrations:
    """Return an environment's demonstrations."""
    demonstrations: Demonstrations = task_of(environment).demonstrations
    return demonstrations


def make_batches(environments: Sequence[str], *, batched: bool) -> list[tuple[str, ...]]:
    """Deal environments out into batches of at most `BATCH_SIZE`, whatever their order was.

    Those of one suite, such as LASA, are together: another suite beside it changes no batch.
    """
    if not batched:
        return [(environment,) for environment in environments]
    suites: dict[str, list[str]] = defaultdict(list)
    for environment in sorted(environments):
        suites[short_name(environment).partition("-")[0]].append(environment)
    batches = []
    for members in suites.values():
        n_batches = math.ceil(len(members) / BATCH_SIZE)
        # Like cards, so that batches differ by one cell at most.
        batches += [tuple(members[i::n_batches]) for i in range(n_batches)]
    return batches


@cache
def entry_points(environment: str) -> tuple[str, ...]:
    """Return the modules of an environment and of its batch."""
    spec = gymnasium.spec(environment)
    points = [spec.entry_point, spec.vector_entry_point]
    return tuple(point.partition(":")[0] for point in points if isinstance(point, str))


def make_cells(entries: Iterable[Entry], environments: Sequence[str], preset: Preset) -> list[Cell]:
    """Return all cells of a preset, each with its key.

    The key hashes what decides the scores: the method with its settings and code, the code of the
    core and of the metrics, the data, the protocol, the seed, the batch that the cell is fitted
    in, and the versions of the libraries that the method or the core use. It does not hash the
    preset's name or its time limit.

    Methods that do not learn motions that repeat have no cells there, and sets of one recording
    have none under a protocol that holds some out. A seed that is named twice counts once.

    Raises
    ------
    PresetError
        If there is no seed or a negative one, or no time limit above 0.
    """
    if not preset.seeds or min(preset.seeds) < 0:
        raise PresetError(f"Expected seeds that are integers >= 0, got {list(preset.seeds)}.")
    if not preset.time_limit > 0:
        raise PresetError(f"Expected a time limit above 0 s, got {preset.time_limit}.")
    distinct = tuple(dict.fromkeys(preset.seeds))
    cells = []
    for entry in entries:
        seeds = distinct if entry.stochastic else distinct[:1]
        used = {name: entry.versions.get(name) for name in (*CORE_LIBRARIES, *entry.libraries)}
        learned = [e for e in environments if motion_of(task_of(e)) in entry.motions]
        for protocol, seed, batch in product(
            preset.protocols, seeds, make_batches(learned, batched=entry.batched)
        ):
            batch = tuple(e for e in batch if protocol in demonstrations_of(e).protocols)
            paths = tuple(str(result_path(entry.name, e, protocol, seed)) for e in batch)
            data = [demonstrations_of(environment).sha256 for environment in batch]
            for environment, sha256 in zip(batch, data, strict=True):
                motion = motion_of(task_of(environment))
                hashes = {
                    "data": sha256,
                    "metrics": metrics_hash(motion),
                    "code": entry.code,
                    "core": core_hash(entry_points(environment), motion),
                    "config": sha256_of(entry.config),
                }
                rivals = [demonstrations_of(e).sha256 for e in task_of(environment).rivals]
                company = [paths, data, rivals]
                needed = used | {x: entry.versions.get(x) for x in MOTION_LIBRARIES[motion]}
                decisive = [entry.target, environment, protocol, seed, hashes, needed, company]
                cells.append(
                    Cell(
                        entry=entry,
                        environment=environment,
                        protocol=protocol,
                        seed=seed,
                        preset=preset.name,
                        time_limit=preset.time_limit,
                        batch=paths,
                        key=sha256_of(decisive),
                        hashes=hashes,
                    )
                )
    return cells


def not_learned(entries: Iterable[Entry], environments: Sequence[str]) -> dict[str, str]:
    """Return by method's name how many environments it has no cells on and which, where any.

    Their motions are of a kind that it does not learn. As ``"2 (Letter-A-v0, Letter-B-v0)"``.
    """
    found = {}
    for entry in entries:
        names = [short_name(e) for e in environments if motion_of(task_of(e)) not in entry.motions]
        if names:
            more = ["..."] if len(names) > MOST_NAMED else []
            found[entry.name] = f"{len(names)} ({', '.join(names[:MOST_NAMED] + more)})"
    return found


def is_up_to_date(cell: Cell, folder: Path) -> bool:
    """Whether a cell has scores under its key; a failed one is to be tried again.

    So is one of the smoke preset in a run of another. Settings that smoke leaves alone give it the
    same key and the same scores, but its record would go on to say that it is of a trial.

    Raises
    ------
    CannotWriteError
        If there is a record that may not be read, or a folder in its place.
    """
    try:
        found = _read(folder, cell)
    except (FileNotFoundError, ResultFileError):
        return False  # what cannot be read is written anew
    if found.preset == TRIAL != cell.preset:
        return False
    return found.ok and found.key == cell.key and what_is_broken(cell, folder) is None


def _read(folder: Path, cell: Cell) -> Result:
    try:
        return read_result(folder / cell.path)
    except FileNotFoundError:
        raise
    except OSError as error:  # what is in the way of reading it is in the way of writing it anew
        raise cannot_write(error, folder) from error


def what_is_broken(cell: Cell, folder: Path) -> str | None:
    """Say what is wrong with the files of a cell that has a record; None if nothing is.

    Raises
    ------
    CannotWriteError
        If there is a record that may not be read, or a folder in its place.
    """
    try:
        found = _read(folder, cell)
    except FileNotFoundError:
        return None
    except ResultFileError as error:
        return str(error).partition(": delete it")[0]
    if found.model is None:
        return None
    model = (folder / cell.path).with_suffix(".safetensors")
    if not model.is_file():
        return f"{model} is missing, the model of the record beside it"
    return None if model_is_whole(model) else f"{model} is no whole model file"


def make_jobs(cells: Iterable[Cell], to_do: Collection[Cell]) -> list[Job]:
    """Return a job for each batch of `cells` that has one of `to_do`, the large ones first.

    The batch is fitted whole, and those to do are scored.
    """
    batches: dict[tuple[str, ...], list[Cell]] = defaultdict(list)
    for cell in cells:
        batches[cell.batch].append(cell)
    wanted = {cell.path for cell in to_do}
    jobs = [
        Job(tuple(batch), tuple(cell for cell in batch if cell.path in wanted))
        for batch in batches.values()
    ]
    return sorted((job for job in jobs if job.cells), key=lambda job: -len(job.batch))
