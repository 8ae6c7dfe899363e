"""What happens in a worker process: cells are fitted, scored and written, one record at a time.

A journal, a file of JSON lines, tells the parent process how far the worker is, and survives it.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import threading
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from iflow_gym.baselines.runner.plan import Cell, Job
from iflow_gym.baselines.runner.scoring import (
    THREADS,
    Fit,
    _measured,
    failed_result,
    fit_alone,
    fit_together,
    scored,
    scored_reference,
)
from iflow_gym.baselines.runner.store import CannotWriteError, cannot_write, no_room, store
from iflow_gym.envs.guide import without_rewards
from iflow_gym.metrics import get_metric
from iflow_gym.partial_fits import PartialFitError
from iflow_gym.results import Result, read_result, write_result

REPEAT_SECONDS = 10.0
"""After its time limit a cell is interrupted again and again, lest it swallow the first time."""

CELLS_PER_LIMIT = 4
"""Cells that are fitted together in the time limit of one."""

TRACEBACK_FRAMES = 4
"""Last frames of a traceback that a record keeps."""


PARENT_SECONDS = 1.0
"""How often a worker looks whether its parent is still there."""


class TimeLimitExceededError(BaseException):
    """A cell took too long; no Exception, lest a method's own `except Exception` catches it."""


def out_of_time(limit: float, doing: str) -> str:
    """Say in a record that a cell took too long, at what, and what to do."""
    return (
        f"exceeded its time limit of {limit:g} s (of the clock, fit and scoring together) while "
        f"{doing}; --time-limit SECONDS sets another"
    )


class Journal:
    """Events of workers, appended to a file line by line."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def write(self, event: str, **values: Any) -> None:
        """Append an event; a line this short is written in one piece."""
        line = json.dumps({"event": event, "pid": os.getpid(), **values}) + "\n"
        with self.path.open("a", encoding="utf-8") as file:
            file.write(line)


def prepare_worker(scratch: Path) -> None:
    """Leave Ctrl-C to the parent process and keep numerical libraries to one thread.

    The scratch folder of the run is removed for a parent that can no longer do it.

    The environment variables that say the same were set before the worker began; torch reads them.
    """
    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent(scratch)
    threadpool_limits(THREADS)


def end_with_parent(scratch: Path | None = None) -> None:
    """End this process soon after the one that began it, however that ended.

    A parent that is killed (`kill -9`, or for want of memory) takes no leave of its workers, which
    would go on, or wait for ever. Nor does it remove its scratch folder: this process then does.
    """
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(PARENT_SECONDS)
        if scratch is not None:
            shutil.rmtree(scratch, ignore_errors=True)
        os._exit(1)

    threading.Thread(target=watch, name="parent-watch", daemon=True).start()


def run_job(number: int, job: Job, folder: Path, journal: Journal) -> None:
    """Do a job: fit its batch, together where there are several, then score and write its cells.

    The journal says what begins before it does, how long it may take, and what it took. Records and
    models are made in a scratch folder beside the journal, and stored together.

    Raises
    ------
    CannotWriteError
        If the disk is full or worse: no cell fails of that, since no method can help it.
    """
    journal.write("job", number=number)
    scratch = journal.path.parent / str(os.getpid())
    fits: dict[Path, Fit] = {}
    if len(job.batch) > 1:
        began = _clocks()
        fits = _fit_together(number, job, journal)
        journal.write("fitted", method=job.batch[0].entry.name, **_taken(began))
    for cell in job.cells:
        limit = cell.time_limit
        began = _clocks()
        path = str(cell.path)
        place = scratch
        journal.write("begin", label=cell.label, number=number, path=path, limit=limit)
        try:
            result = _attempt(cell, fits.get(cell.path), scratch)
            try:
                read_result(write_result(scratch, result))
            except (TypeError, ValueError, RecursionError) as error:
                # Something that the method says of itself is nothing that a record can hold.
                result = _failed(cell, error)
            model = None
            if result.model is not None:
                model = (scratch / cell.path).with_name(result.model).read_bytes()
            place = folder
            store(folder, result, model)
        except OSError as error:
            raise cannot_write(error, place) from error
        said = {
            "label": cell.label,
            "method": cell.entry.name,
            "reason": result.reason,
            "infinite": [
                name
                for name, value in result.metrics.items()
                if value == math.inf and get_metric(name).family == "accuracy"
            ],
        }
        journal.write("done", path=path, **said, **_taken(began))


def _clocks() -> tuple[float, float]:
    return time.perf_counter(), time.process_time()


def _taken(began: tuple[float, float]) -> dict[str, float]:
    """Return the seconds, and this process's CPU seconds, since `_clocks` was asked."""
    now = _clocks()
    return {"seconds": now[0] - began[0], "cpu_seconds": now[1] - began[1]}


def time_limit_of_batch(batch: Sequence[Cell]) -> float:
    """Return the seconds that a batch may take: as cells of which four cost as much as one."""
    return batch[0].time_limit * max(1.0, len(batch) / CELLS_PER_LIMIT)


def _fit_together(number: int, job: Job, journal: Journal) -> dict[Path, Fit]:
    """Fit a batch; cells that it has no fits of are then fitted one by one."""
    name, n, limit = job.batch[0].entry.name, len(job.batch), time_limit_of_batch(job.batch)
    label = f"{name}, {job.batch[0].protocol}"
    journal.write("batch", label=label, cells=n, number=number, limit=limit)
    try:
        with _time_limit(limit):
            fits, why = _fits_of(job.batch)
        found = {c.path: fit for c, fit in zip(job.batch, fits, strict=True) if fit is not None}
    except BaseException as error:
        if no_room(error):
            raise CannotWriteError(f"{type(error).__name__}: {error}") from error
        found, why = {}, _reason(error, limit, "they were fitted").splitlines()[0]
    if why:
        left = n - len(found)
        cells = "1 cell" if left == 1 else f"{left} cells"
        text = f"{name}: {cells} could not be fitted together ({why}); now one by one"
        journal.write("note", text=text)
    return found


def _fits_of(batch: Sequence[Cell]) -> tuple[Sequence[Fit | None], str]:
    """Fit a batch; return None where a motion alone could not be learned, and why."""
    with _measured() as cost:
        try:
            return fit_together(batch), ""
        except PartialFitError as error:
            systems = error.systems
            why = "no fit of " + ", ".join(error.names[i] for i in sorted(error.failures))
    return [None if s is None else Fit(s, cost, len(batch)) for s in systems], why


def _attempt(cell: Cell, fitted: Fit | None, scratch: Path) -> Result:
    """Return a cell's record; whatever goes wrong in the method becomes a failed one.

    Whatever: Ctrl-C is the parent's, so that a KeyboardInterrupt here is the method's own.
    """
    model = scratch / cell.path.with_suffix(".safetensors")
    doing = "it was scored"
    try:
        with _time_limit(cell.time_limit):
            if cell.entry.reference:
                with without_rewards():
                    return scored_reference(cell)
            if fitted is None:
                doing = "it was fitted"
                fitted = fit_alone(cell)
                doing = "it was scored"
            with without_rewards():
                return scored(cell, fitted, model)
    except BaseException as error:
        if no_room(error):
            raise CannotWriteError(f"{type(error).__name__}: {error}") from error
        return _failed(cell, error, doing)


def _failed(cell: Cell, error: BaseException, doing: str = "it was scored") -> Result:
    """Return the record of a cell that failed."""
    return failed_result(cell, _reason(error, cell.time_limit, doing))


def _reason(error: BaseException, limit: float, doing: str) -> str:
    """Say in a record what went wrong: the exception, and where it came from."""
    if isinstance(error, TimeLimitExceededError):
        return out_of_time(limit, doing)
    try:
        text = str(error)
    except BaseException as second:
        text = f"(its message cannot be shown: {type(second).__name__})"
    message = f"{type(error).__name__}: {text}".rstrip(": ")
    frames = traceback.extract_tb(error.__traceback__)[-TRACEBACK_FRAMES:]
    where = [f"  {Path(f.filename).name}:{f.lineno} in {f.name}: {f.line}" for f in frames]
    return "\n".join([message, *where])


@contextmanager
def _time_limit(seconds: float) -> Iterator[None]:
    """Raise TimeLimitExceededError after some seconds, by an alarm signal.

    POSIX only: elsewhere, and outside the main thread, there is no limit. Python sees a signal
    between two of its instructions, so that one long call into C is interrupted when it returns; if
    it never does, the parent process kills the worker.
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
