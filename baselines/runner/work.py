"""What happens in a worker process: cells are fitted, scored and written, one record at a time.

A journal, a file of JSON lines, tells the parent process how far the worker is, and survives it.
"""

from __future__ import annotations

import json
import math
import os
import signal
import threading
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium

from iflow_gym.baselines.registry import load_method, load_reference
from iflow_gym.baselines.runner.fingerprint import hardware
from iflow_gym.baselines.runner.plan import Cell, Job, demonstrations_of, family
from iflow_gym.evaluate import Evaluation, evaluate
from iflow_gym.metrics import METRICS, FitCost, measure_cost
from iflow_gym.results import Result, write_result
from iflow_gym.system import DynamicalSystem

THREADS = 1
"""Threads of a worker."""

REPEAT_SECONDS = 10.0
"""After its time limit a cell is interrupted again and again, lest it swallow the first time."""

TRACEBACK_FRAMES = 4
"""Last frames of a traceback that a record keeps."""


class TimeLimitExceededError(BaseException):
    """A cell took too long; no Exception, lest a method's own `except Exception` catches it."""


class Fit(NamedTuple):
    """A fitted system and what fitting its batch took."""

    system: DynamicalSystem
    cost: FitCost
    batch_size: int


class Journal:
    """Events of workers, appended to a file line by line."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def write(self, event: str, **values: Any) -> None:
        """Append an event; a line this short is written in one piece."""
        line = json.dumps({"event": event, "pid": os.getpid(), **values}) + "\n"
        with self.path.open("a", encoding="utf-8") as file:
            file.write(line)


def prepare_worker() -> None:
    """Leave Ctrl-C to the parent process and keep numerical libraries to one thread.

    The environment variables that say the same were set before the worker began; torch reads them.
    """
    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threadpool_limits(THREADS)


def run_job(number: int, job: Job, folder: Path, journal: Journal) -> None:
    """Do a job's cells: fit them, together where there are several, then score and write each."""
    journal.write("job", number=number)
    fits = _fit_together(job, journal) if len(job) > 1 else [None]
    for cell, fitted in zip(job, fits, strict=True):
        journal.write("begin", label=cell.label)
        began = time.perf_counter()
        result = _attempt(cell, fitted, folder)
        write_result(folder, result)
        journal.write(
            "done",
            label=cell.label,
            path=str(cell.path),
            reason=result.reason,
            seconds=time.perf_counter() - began,
        )


def _fit_together(job: Job, journal: Journal) -> Sequence[Fit | None]:
    """Fit a batch; if that fails, None for each: they are then fitted one by one."""
    first, limit = job[0], sum(cell.time_limit for cell in job)
    journal.write("batch", label=f"{first.entry.name}, {first.protocol}", cells=len(job))
    try:
        with _time_limit(limit):
            method = load_method(first.entry.target)(**first.entry.settings)
            fitted_on = [demonstrations_of(c.environment).split(c.protocol).fit for c in job]
            with measure_cost() as cost:
                systems = method.fit_many(fitted_on, seeds=[c.seed for c in job])
            return [Fit(system, cost, len(job)) for system in systems]
    except (Exception, SystemExit, TimeLimitExceededError) as error:
        journal.write(
            "note",
            text=f"{first.entry.name}: {len(job)} cells could not be fitted together "
            f"({_reason(error, limit).splitlines()[0]}); now one by one",
        )
        return [None] * len(job)


def _attempt(cell: Cell, fitted: Fit | None, folder: Path) -> Result:
    """Return a cell's record; whatever goes wrong in the method becomes a failed one."""
    model = folder / cell.path.with_suffix(".safetensors")
    try:
        with _time_limit(cell.time_limit):
            if cell.entry.reference:
                return _scored_reference(cell)
            return _scored(cell, fitted or _fit_alone(cell), model)
    except (Exception, SystemExit, TimeLimitExceededError) as error:
        model.unlink(missing_ok=True)  # of an earlier run, which the record no longer speaks of
        return failed_result(cell, _reason(error, cell.time_limit))


def _fit_alone(cell: Cell) -> Fit:
    method = load_method(cell.entry.target)(**cell.entry.settings)
    fitted_on = demonstrations_of(cell.environment).split(cell.protocol).fit
    with measure_cost() as cost:
        system = method.fit(fitted_on, seed=cell.seed)
    return Fit(system, cost, 1)


def _scored(cell: Cell, fitted: Fit, model: Path) -> Result:
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


def _scored_reference(cell: Cell) -> Result:
    reference = load_reference(cell.entry.name)()
    env = gymnasium.make(cell.environment)
    began = time.perf_counter()
    found = reference.evaluate(env, seed=cell.seed, protocol=cell.protocol)
    return _record(cell, found, costs={}, fit={"evaluate_seconds": time.perf_counter() - began})


def _record(cell: Cell, found: Evaluation, *, costs: dict[str, float], **known: Any) -> Result:
    metrics = found.metrics | costs
    return Result(
        **_common(cell),
        status="ok",
        metrics={m.name: metrics.get(m.name) for m in METRICS},
        medians=found.medians,
        per_demonstration=found.per_demonstration,
        dt=demonstrations_of(cell.environment).mean_dt,
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
        "config": entry.config,
        "integrator": entry.integrator,
        "hashes": cell.hashes,
        "versions": entry.versions,
        "hardware": hardware(THREADS),
    }


def _reason(error: BaseException, limit: float) -> str:
    """Say in a record what went wrong: the exception, and where it came from."""
    if isinstance(error, TimeLimitExceededError):
        return f"exceeded its time limit of {limit:g} s"
    message = f"{type(error).__name__}: {error}".rstrip(": ")
    frames = traceback.extract_tb(error.__traceback__)[-TRACEBACK_FRAMES:]
    where = [f"  {Path(f.filename).name}:{f.lineno} in {f.name}: {f.line}" for f in frames]
    return "\n".join([message, *where])


@contextmanager
def _time_limit(seconds: float) -> Iterator[None]:
    """Raise TimeLimitExceededError after some seconds, by an alarm signal.

    POSIX only: elsewhere, and outside the main thread, there is no limit. Python sees a signal
    between two of its instructions, so that one long call into C is interrupted when it returns.
    """
    main = threading.current_thread() is threading.main_thread()
    if not hasattr(signal, "SIGALRM") or not main or math.isinf(seconds):
        yield
        return

    def interrupt(*_: object) -> None:
        raise TimeLimitExceededError

    previous = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, seconds, REPEAT_SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, previous)
