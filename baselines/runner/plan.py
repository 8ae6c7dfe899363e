"""The plan of a run: which cells there are, which are up to date, and how they go into jobs."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any

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
    core_hash,
    method_code,
    sha256_of,
    versions,
)
from iflow_gym.baselines.runner.presets import Preset, PresetError, load_settings
from iflow_gym.datasets.lasa import MULTI_MODELS
from iflow_gym.demonstrations import Demonstrations
from iflow_gym.metrics import metrics_hash
from iflow_gym.registration import POINT_MASS_ID
from iflow_gym.results import ResultFileError, read_result, result_path, short_name
from iflow_gym.system import DynamicalSystem

LEAST_BATCH = 4
"""Cells that are fitted together at least, where there are that many: fewer gain little."""

LARGEST_BATCH = 32
"""Cells that are fitted together at most: what a failure in a batch costs stays bounded."""


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


Job = tuple[Cell, ...]
"""Cells that one worker does one after the other; several are fitted together."""


def select_entries(patterns: Sequence[str], preset: str) -> list[Entry]:
    """Return methods and references by globs over their names, or by ``"module:Class"``."""
    names: dict[str, None] = {}
    for pattern in patterns or ("*",):
        if ":" in pattern:
            names[pattern] = None
            continue
        found = [n for n in (*METHODS, *REFERENCES) if fnmatchcase(n, pattern)]
        if not found:
            raise unknown("method", pattern, (*METHODS, *REFERENCES))
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
        code=code.sha256,
        libraries=code.libraries,
        versions=versions(code.libraries),
    )


def _method(name: str, preset: str) -> Entry:
    method = load_method(name)
    registered = name in METHODS
    if registered and method.name != name:
        raise UnknownNameError(
            f"Expected {METHODS[name]} to have the name {name!r} that it is registered under, got "
            f"{method.name!r}."
        )
    settings = load_settings(name, preset, registered=registered)
    try:
        config = method(**settings).config
    except (TypeError, ValueError) as error:
        raise PresetError(f"Settings of {name} in preset [{preset}]: {error}") from error
    code = method_code(METHODS.get(name, name).partition(":")[0])
    return Entry(
        name=method.name,
        title=method.title,
        target=METHODS.get(name, name),
        reference=False,
        stochastic=method.stochastic_fit,
        batched=method._fit_many is not DynamicalSystem._fit_many,
        settings=settings,
        config=json.loads(json.dumps(dataclasses.asdict(config), default=str)),
        integrator=method.integrator,
        code=code.sha256,
        libraries=code.libraries,
        versions=versions(code.libraries),
    )


def select_environments(patterns: Sequence[str]) -> list[str]:
    """Return ids of the suite's environments by globs over ids and short names."""
    known = [
        i for i in gymnasium.registry if i.startswith("iflow/") and i != POINT_MASS_ID
    ]  # that one takes the caller's own demonstrations
    chosen: dict[str, None] = {}
    for pattern in patterns:
        found = [i for i in known if fnmatchcase(i, pattern) or fnmatchcase(short_name(i), pattern)]
        if not found:
            raise unknown("environment", pattern, [short_name(i) for i in known])
        chosen |= dict.fromkeys(found)
    return list(chosen)


def family(environment: str) -> str:
    """Return the family that an environment is aggregated in."""
    name = short_name(environment)
    if not name.startswith("LASA-"):
        return name.rpartition("-v")[0]
    shape = name.removeprefix("LASA-").rpartition("-v")[0]
    return "LASA-Multi" if shape in MULTI_MODELS else "LASA-26"


@cache
def demonstrations_of(environment: str) -> Demonstrations:
    """Return an environment's demonstrations."""
    demonstrations: Demonstrations = gymnasium.make(environment).unwrapped.demonstrations  # type: ignore[attr-defined]
    return demonstrations


def make_cells(entries: Iterable[Entry], environments: Sequence[str], preset: Preset) -> list[Cell]:
    """Return all cells of a preset, each with its key.

    The key hashes what decides the scores: the method with its settings and code, the code of the
    core and of the metrics, the data, the protocol, the seed, and the versions of the libraries
    that the method or the core use. It does not hash the preset's name or its time limit.
    """
    core, measures = core_hash(), metrics_hash()
    cells = []
    for entry in entries:
        seeds = preset.seeds if entry.stochastic else preset.seeds[:1]
        used = {name: entry.versions.get(name) for name in (*CORE_LIBRARIES, *entry.libraries)}
        for protocol in preset.protocols:
            for seed in seeds:
                for environment in environments:
                    hashes = {
                        "data": demonstrations_of(environment).sha256,
                        "metrics": measures,
                        "code": entry.code,
                        "core": core,
                        "config": sha256_of(entry.config),
                    }
                    decisive = [entry.target, environment, protocol, seed, hashes, used]
                    cells.append(
                        Cell(
                            entry=entry,
                            environment=environment,
                            protocol=protocol,
                            seed=seed,
                            preset=preset.name,
                            time_limit=preset.time_limit,
                            key=sha256_of(decisive),
                            hashes=hashes,
                        )
                    )
    return cells


def is_up_to_date(cell: Cell, folder: Path) -> bool:
    """Whether a cell has scores under its key; a failed one is to be tried again."""
    try:
        found = read_result(folder / cell.path)
    except (FileNotFoundError, ResultFileError):
        return False  # what cannot be read is written anew
    return found.ok and found.key == cell.key


def make_jobs(cells: Sequence[Cell], n_workers: int) -> list[Job]:
    """Split cells into jobs, the large ones first.

    Cells of a method that fits several together are split by protocol into about `n_workers`
    groups of `LEAST_BATCH` to `LARGEST_BATCH`; others are jobs of their own.
    """

    def of_one_batch(cell: Cell) -> tuple[str, str, str]:
        return cell.entry.target, cell.protocol, cell.hashes["config"]

    together = sorted((c for c in cells if c.entry.batched), key=of_one_batch)
    jobs: list[Job] = []
    for _, group in groupby(together, key=of_one_batch):
        batch = list(group)
        size = min(max(math.ceil(len(batch) / n_workers), LEAST_BATCH), LARGEST_BATCH)
        n_jobs = math.ceil(len(batch) / size)
        # Dealt out like cards, so that groups differ by one cell at most.
        jobs += [tuple(batch[i::n_jobs]) for i in range(n_jobs)]
    return jobs + [(cell,) for cell in cells if not cell.entry.batched]
