"""What decides a cell's scores: how it is fitted, evaluated, and made a record of.

This file is hashed into every cell's key (`fingerprint.CORE`); what watches over the fitting, and
what tells a person, is in `work`, a change of which redoes nothing.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import psutil

from iflow_gym.baselines.registry import load_method, load_reference
from iflow_gym.baselines.runner.fingerprint import hardware
from iflow_gym.baselines.runner.plan import Cell, demonstrations_of, family, task_of
from iflow_gym.evaluate import Evaluation, evaluate, motion_of
from iflow_gym.metrics import FitCost, measure_cost, metrics_of
from iflow_gym.results import Result, check_metrics
from iflow_gym.system import Method

THREADS = 1
"""Threads of a worker."""

BYTES_PER_MB = 1_000_000


class Fit(NamedTuple):
    """A fitted system and what fitting its batch took."""

    system: Method
    cost: FitCost
    """Its memory is the rise above what the worker held before, and the whole batch's."""
    batch_size: int


def fit_alone(cell: Cell) -> Fit:
    """Fit a cell."""
    method = load_method(cell.entry.target)(**cell.entry.settings)
    fitted_on = demonstrations_of(cell.environment).split(cell.protocol).fit
    with _measured() as cost:
        system = method.fit(fitted_on, seed=cell.seed)
    return Fit(system, cost, 1)


def fit_together(batch: Sequence[Cell]) -> list[Fit]:
    """Fit the cells of a batch."""
    entry = batch[0].entry
    method = load_method(entry.target)(**entry.settings)
    fitted_on = [demonstrations_of(c.environment).split(c.protocol).fit for c in batch]
    with _measured() as cost:
        systems = method.fit_many(fitted_on, seeds=[c.seed for c in batch])
    return [Fit(system, cost, len(batch)) for system in systems]


@contextmanager
def _measured() -> Iterator[FitCost]:
    """Measure the cost of a fit; its memory as the rise above the level at which it began.

    A worker has fitted other cells before, and holds libraries that they imported: its absolute
    peak would say what ran earlier. Memory that was freed and kept for reuse is no rise.
    """
    before = psutil.Process().memory_info().rss / BYTES_PER_MB
    with measure_cost() as cost:
        yield cost
    cost.peak_memory_mb = max(0.0, cost.peak_memory_mb - before)


def scored(cell: Cell, fitted: Fit, model: Path) -> Result:
    """Score a fitted system, save it, and return the record."""
    system, cost, size = fitted
    began = time.perf_counter()
    found = evaluate(
        system, gymnasium.make(cell.environment), seed=cell.seed, protocol=cell.protocol
    )
    seconds = time.perf_counter() - began
    model.parent.mkdir(parents=True, exist_ok=True)
    system.save(model)
    return _record(
        cell,
        found,
        costs={
            "fit_seconds": cost.wall_seconds / size,
            "fit_cpu_seconds": cost.cpu_seconds / size,
            "peak_memory_mb": cost.peak_memory_mb,
        },
        guarantee=system.guarantee,
        fit={
            "batch_size": size,
            "batch_wall_seconds": cost.wall_seconds,
            "batch_cpu_seconds": cost.cpu_seconds,
            "evaluate_seconds": seconds,
        },
        model=model.name,
    )


def scored_reference(cell: Cell) -> Result:
    """Score a reference and return the record."""
    reference = load_reference(cell.entry.name)()
    env = gymnasium.make(cell.environment)
    began = time.perf_counter()
    found = reference.evaluate(env, seed=cell.seed, protocol=cell.protocol)
    return _record(cell, found, costs={}, fit={"evaluate_seconds": time.perf_counter() - began})


def _record(cell: Cell, found: Evaluation, *, costs: dict[str, float], **known: Any) -> Result:
    values = found.metrics | costs
    demonstrations = demonstrations_of(cell.environment)
    metrics = {m.name: values.get(m.name) for m in metrics_of(motion_of(task_of(cell.environment)))}
    check_metrics(metrics)
    return Result(
        **_common(cell),
        status="ok",
        metrics=metrics,
        medians=found.medians,
        per_demonstration=found.per_demonstration,
        likelihoods=found.likelihoods,
        dt=demonstrations.mean_dt,
        **known,
    )


def failed_result(cell: Cell, reason: str) -> Result:
    """Return the record of a cell that has no scores."""
    return Result(**_common(cell), status="failed", reason=reason)


def _common(cell: Cell) -> dict[str, Any]:
    """Return what is known of a cell whatever becomes of it."""
    entry = cell.entry
    return {
        "method": entry.name,
        "title": entry.title,
        "environment": cell.environment,
        "family": family(cell.environment),
        "protocol": cell.protocol,
        "seed": cell.seed,
        "preset": cell.preset,
        "key": cell.key,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "reference": entry.reference,
        "target": entry.target,
        "config": entry.config,
        "integrator": entry.integrator,
        "uses_time": entry.uses_time,
        "hashes": cell.hashes,
        "versions": entry.versions,
        "hardware": hardware(THREADS),
    }
