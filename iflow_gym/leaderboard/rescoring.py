"""Cells scored again from their submitted models, and how near the scores have to be."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import gymnasium

from iflow_gym.baselines.registry import load_method, load_reference
from iflow_gym.baselines.runner.fingerprint import hardware, versions
from iflow_gym.evaluate import FIT_COSTS, Evaluation, evaluate
from iflow_gym.results import Result
from iflow_gym.saved_models import inspect_model
from iflow_gym.saved_models import load_model as load_saved_model
from iflow_gym.system import Method

NOT_COMPARED = frozenset({*FIT_COSTS, "step_us"})
"""Costs: what a machine took, which no other one takes again."""

FRACTIONS = frozenset(
    {"converged", "diverged", "attraction", "perturbation_recovery", "lyapunov_violation"}
)


@dataclass(frozen=True)
class Tolerance:
    """How far a score may be from the one that a record has."""

    relative: float
    fraction: float
    """Absolute, of what is a fraction of starts, pushes or states."""
    absolute: float = 1e-9
    """Of everything: a score of 0 is made of rounding."""
    medians: bool = True
    """Whether medians, and the values of each demonstration, are compared."""
    counts: float = 0.0
    """Absolute, of the number of spurious attractors."""


SAME = Tolerance(relative=1e-6, fraction=1e-9)
"""On the same processor with the same versions of Python and of all libraries that are recorded."""

ACROSS = Tolerance(relative=1e-2, fraction=0.02, medians=False, counts=1.0)
"""Elsewhere: numerical libraries round in other ways, and rollouts of an unstable system carry that
far. One start of 256 may fall to the other side of a bound, and five may be counted otherwise."""


def tolerance_for(result: Result) -> tuple[Tolerance, str]:
    """Return how near a cell's scores have to be here, and why, in words."""
    here = versions(result.versions.keys() - {"python", "iflow_gym"})
    other = [
        f"{name} {value} (here {here.get(name)})"
        for name, value in sorted(result.versions.items())
        if name != "iflow_gym" and here.get(name) != value
    ]
    if (cpu := hardware(1)["cpu"]) != result.hardware.get("cpu"):
        other.append(f"processor {result.hardware.get('cpu')} (here {cpu})")
    return (ACROSS, "made with " + ", ".join(other)) if other else (SAME, "same versions")


def load_model(result: Result, folder: Path) -> Method:
    """Return the fitted method of a record; its class is imported, which runs its module.

    Raises
    ------
    ValueError
        If the file is no model of the class, or of other settings than the record says.
    """
    assert result.target is not None
    assert result.model is not None
    path = folder / result.model
    method: Method = load_saved_model(path, method=load_method(result.target))
    if inspect_model(path).config != result.config:
        raise ValueError("expected the model to have the settings of the record, got other ones")
    return method


def evaluate_again(result: Result, system: Method | None) -> Evaluation:
    """Score a cell anew; without a system, a reference."""
    env = gymnasium.make(result.environment)
    if system is None:
        return load_reference(result.method)().evaluate(
            env, seed=result.seed, protocol=result.protocol
        )
    return evaluate(system, env, seed=result.seed, protocol=result.protocol)


def differences(result: Result, found: Evaluation, tolerance: Tolerance) -> Iterator[str]:
    """Yield where a record says something else than what was found."""
    yield from differences_of_scores(result.metrics, found.metrics, tolerance)
    if tolerance.medians:
        yield from _differ("median of ", result.medians, found.medians, tolerance)
        yield from _each_differ(result.per_demonstration, found.per_demonstration, tolerance)
        yield from _each_differ(result.likelihoods, found.likelihoods, tolerance)


def differences_of_scores(
    said: Mapping[str, float | None], found: Mapping[str, float | None], tolerance: Tolerance
) -> Iterator[str]:
    """Yield where metrics differ; costs are not compared."""
    yield from _differ("", said, found, tolerance)


def _each_differ(
    said: Mapping[str, Sequence[float | None]],
    found: Mapping[str, Sequence[float | None]],
    tolerance: Tolerance,
) -> Iterator[str]:
    for name in sorted(said.keys() | found.keys()):
        left, right = said.get(name, ()), found.get(name, ())
        if len(left) != len(right):
            yield f"{name}: {len(left)} values recorded, {len(right)} found"
            continue
        rows = [{f"{name}[{i}]": v for i, v in enumerate(values)} for values in (left, right)]
        yield from _differ("", rows[0], rows[1], tolerance)


def _differ(
    what: str,
    said: Mapping[str, float | None],
    found: Mapping[str, float | None],
    tolerance: Tolerance,
) -> Iterator[str]:
    for name in sorted(said):
        plain = name.partition("[")[0]
        if plain in NOT_COMPARED:
            continue
        left, right = said[name], found.get(name)
        if left is None or right is None:
            same = left is right
        else:
            absolute = tolerance.absolute
            if plain in FRACTIONS:
                absolute = max(absolute, tolerance.fraction)
            if plain == "spurious_attractors":
                absolute = max(absolute, tolerance.counts)
            close = math.isclose(left, right, rel_tol=tolerance.relative, abs_tol=absolute)
            same = left == right or close
        if not same:
            yield f"{what}{name}: recorded {left}, found {right}"
