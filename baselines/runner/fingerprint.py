"""Fingerprints: hashes of what decides a score, and the names of the machine it was made on.

Code is hashed as it runs: comments, docstrings and layout do not count. (The metrics' own
`metrics_hash` counts them, because there the docstrings are the definitions.)
"""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from iflow_gym.metrics import Motion

ENVIRONMENTS = "iflow_gym.envs"
"""Package of the environments."""

CORE = (
    "iflow_gym.baselines.runner.scoring",
    "iflow_gym.datasets.drums",
    "iflow_gym.demonstrations",
    "iflow_gym.evaluate",
    "iflow_gym.evaluation",
    "iflow_gym.metrics",
    "iflow_gym.policy",
    "iflow_gym.primitive",
    "iflow_gym.system",
    ENVIRONMENTS,
)
"""Modules and packages that scores depend on, which are no part of a method's code."""

NOT_SCORED = (
    "iflow_gym",
    "iflow_gym.datasets",
    "iflow_gym.envs.drumming.crew",
    "iflow_gym.envs.drumming.rendering",
    "iflow_gym.envs.drumming.vector",
    "iflow_gym.envs.guide",
    "iflow_gym.envs.nearest",
    "iflow_gym.envs.rendering",
    "iflow_gym.plotting",
    "iflow_gym.registration",
    "iflow_gym.results",
)
"""Modules that no score depends on: the data have a hash of their own, rewards are not scored, and
the arms of a score are moved in one process."""

OTHER_MOTIONS: dict[Motion, tuple[str, ...]] = {
    "goal": ("iflow_gym.evaluation.cycles", "iflow_gym.evaluation.drumming"),
    "cycle": ("iflow_gym.evaluation.goals", "iflow_gym.evaluation.drumming"),
    "drumming": ("iflow_gym.evaluation.goals",),
}
"""Modules that score motions of another kind than this one."""

METRICS = "iflow_gym.metrics"
"""Package of the metrics, whose files `metrics_hash` hashes."""

CORE_LIBRARIES = ("gymnasium", "numpy", "scipy")
"""Distributions that every score depends on."""

MOTION_LIBRARIES: dict[Motion, tuple[str, ...]] = {
    "goal": (),
    "cycle": (),
    "drumming": ("mujoco", "gymnasium-robotics"),
}
"""Distributions that the scores of a kind of motion depend on beside them."""

LIBRARIES = (*CORE_LIBRARIES, "gymnasium-robotics", "mujoco", "scikit-learn", "torch")
"""Distributions whose versions every record names."""


class Code(NamedTuple):
    """What a method's code is."""

    sha256: str
    libraries: tuple[str, ...]
    """Distributions, outside the standard library, that the code imports."""


def method_code(module: str) -> Code:
    """Hash the source of a module and of all that it imports from its own top-level package.

    Imports are followed wherever they stand, within functions too, but not into the core, whose
    hash is `core_hash`.
    """
    top = module.partition(".")[0]

    def wanted(name: str) -> bool:
        return name.partition(".")[0] == top and not (_within(name, CORE) or name in NOT_SCORED)

    sources = dict(_closure([module], wanted))
    names = {n.partition(".")[0] for text in sources.values() for n in _imports(module, text)}
    outside = names - set(sys.stdlib_module_names) - {top, "iflow_gym"}
    providers = importlib.metadata.packages_distributions()
    libraries = {providers[name][0] for name in outside if name in providers}
    return Code(_sha256_of_sources(sources.items()), tuple(sorted(libraries)))


@functools.cache
def core_hash(entry_points: tuple[str, ...], motion: Motion) -> str:
    """Hash the source that the scores of an environment depend on, whatever the method.

    Parameters
    ----------
    entry_points
        Modules of the environment and of its batch, if scores depend on that. What they import
        counts, and what evaluates motions of this kind: an environment of another family, or
        metrics of another kind of motion, can be added without a record becoming stale.
    motion
        Whether its demonstrations end at a goal or repeat.
    """
    left_out = (*NOT_SCORED, *OTHER_MOTIONS[motion])
    roots = ("iflow_gym.baselines.runner.scoring", *(p for p in entry_points if p not in left_out))

    def wanted(name: str) -> bool:
        return _within(name, CORE) and name not in left_out and not _within(name, (METRICS,))

    return _sha256_of_sources(_closure(roots, wanted))


def sha256_of(value: Any) -> str:
    """Hash anything that JSON can hold."""
    text = json.dumps(value, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def versions(libraries: Iterable[str] = ()) -> dict[str, str]:
    """Return the versions of Python, of this package and of libraries that are installed."""
    from iflow_gym import __version__

    found = {"python": platform.python_version(), "iflow_gym": __version__}
    for name in {*LIBRARIES, *libraries}:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def hardware(threads: int) -> dict[str, str | int | None]:
    """Return what the machine is."""
    return {
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "threads": threads,
        "platform": platform.platform(),
    }


def _cpu() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass  # no Linux
    return platform.processor() or platform.machine()


def _closure(modules: Iterable[str], wanted: Callable[[str], bool]) -> Iterator[tuple[str, str]]:
    """Yield the names and sources of modules and of what they import that is wanted."""
    waiting = list(modules)
    seen = set(waiting)
    while waiting:
        name = waiting.pop()
        source = _source(name)
        if source is None:
            continue
        yield name, source
        new = {imported for imported in _imports(name, source) if wanted(imported)} - seen
        seen |= new
        waiting += sorted(new)


def _within(name: str, packages: Iterable[str]) -> bool:
    """Whether a name is one of these modules, or lies in one of these packages."""
    return any(name == package or name.startswith(package + ".") for package in packages)


def _imports(module: str, source: str) -> set[str]:
    """Return the names of modules that a source may import; some are of classes in modules."""
    spec = importlib.util.find_spec(module)
    package = (spec.parent if spec else None) or ""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                base = importlib.util.resolve_name("." * node.level + base, package)
            names |= {base} | {f"{base}.{alias.name}" for alias in node.names}
    return names


def _source(module: str) -> str | None:
    """Return a module's source; None for what is no module with one."""
    try:
        spec = importlib.util.find_spec(module)
    except ModuleNotFoundError:  # its parent is a module, not a package
        return None
    if spec is None or spec.origin is None or not spec.origin.endswith(".py"):
        return None
    return Path(spec.origin).read_text(encoding="utf-8")


def _sha256_of_sources(sources: Iterable[tuple[str, str]]) -> str:
    digest = hashlib.sha256()
    for name, source in sorted(sources):
        digest.update(f"{name}\0{_as_it_runs(source)}\0".encode())
    return digest.hexdigest()


def _as_it_runs(source: str) -> str:
    """Return a source without comments, docstrings and layout."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(getattr(node, "body", None), list):
            body: list[ast.stmt] = node.body  # type: ignore[attr-defined]
            kept = [statement for statement in body if not _is_text(statement)]
            node.body = kept or [ast.Pass()]  # type: ignore[attr-defined]
    return ast.unparse(tree)


def _is_text(statement: ast.stmt) -> bool:
    return (
        isinstance(statement, ast.Expr)
        and isinstance(statement.value, ast.Constant)
        and isinstance(statement.value.value, str)
    )
