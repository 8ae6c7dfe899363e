"""Keeps worker processes going until every cell has a record, whatever happens to them."""

from __future__ import annotations

import contextlib
import json
import os
import re
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, wait
from pathlib import Path
from typing import Any, NamedTuple

import psutil
from joblib.externals.loky.process_executor import BrokenProcessPool, ProcessPoolExecutor

from iflow_gym.baselines.runner.plan import Cell, Job
from iflow_gym.baselines.runner.scoring import THREADS, failed_result
from iflow_gym.baselines.runner.store import store, sweep
from iflow_gym.baselines.runner.work import Journal, out_of_time, prepare_worker, run_job

Event = dict[str, Any]

POLL_SECONDS = 0.2

GRACE_SECONDS = 15.0
"""What a worker may take over its limit, before it is killed: it interrupts itself at the limit,
and again after `work.REPEAT_SECONDS`, but cannot while a call into C does not return."""

THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMEXPR_NUM_THREADS",
)


class WorkersError(RuntimeError):
    """Worker processes die before they do anything."""


class Doing(NamedTuple):
    """What a worker does."""

    job: int
    path: str | None
    """Of the cell; None for a batch."""
    limit: float
    deadline: float
    """By `time.monotonic`."""


class Pool:
    """Runs jobs in processes of one thread each.

    Parameters
    ----------
    folder
        Of the results; workers write each record there the moment it is known.
    n_workers
        Processes at a time.
    on_event
        Called in this process with each event of the journal, in order.
    """

    def __init__(self, folder: Path, n_workers: int, on_event: Callable[[Event], object]) -> None:
        self._folder = folder
        self._n_workers = n_workers
        self._on_event = on_event
        self._started: set[int] = set()
        self._done: set[str] = set()
        self._doing: dict[int, Doing] = {}
        self._overdue: dict[int, Doing] = {}

    def run(self, jobs: Sequence[Job]) -> None:
        """Do all jobs; on return every cell has a record.

        A worker that is past a time limit and does not stop is killed: its cell fails, or its
        batch is done cell by cell. Where a worker dies of itself, nobody knows by which job,
        because all others of its executor die with it: the jobs that had begun are done again,
        each alone, without the cells that have their record. One that dies alone is split into
        its cells, and a single cell that dies alone becomes a failed one. All other jobs go on
        together.

        Raises
        ------
        WorkersError
            If workers die before any of them begins a job.
        CannotWriteError
            If the disk is full or worse. What was written before is whole.
        KeyboardInterrupt
            On Ctrl-C, after the workers were killed. Records are whole or absent.
        """
        together, alone = list(jobs), list[Job]()
        try:
            while together:
                suspects, together, reason = self._round(together, self._n_workers)
                if together and not self._started:
                    raise WorkersError(f"Expected workers to begin their jobs, but {reason}.")
                alone += suspects
            while alone:
                suspects, left, reason = self._round([alone.pop(0)], 1)
                if not self._started:
                    suspects, left = left, []
                for job in suspects:
                    if len(job.batch) > 1:
                        left += job.one_by_one()
                    else:
                        self._fail(job.cells[0], reason)
                alone = left + alone
        finally:
            sweep(self._folder)

    def _round(self, jobs: Sequence[Job], n_workers: int) -> tuple[list[Job], list[Job], str]:
        """Run jobs in a fresh executor.

        Returns the jobs that a worker may have died of, what else is left to do, both empty
        unless a worker died, and how it died.
        """
        for record in (self._started, self._doing, self._overdue):
            record.clear()
        with (
            tempfile.TemporaryDirectory(prefix="iflow-gym-run-") as scratch,
            warnings.catch_warnings(),
        ):
            # Loky replaces workers that have grown by some 100 MB, and warns that it does.
            warnings.filterwarnings("ignore", message="A worker stopped while some jobs")
            journal = Journal(Path(scratch) / "journal")
            journal.path.touch()
            executor = ProcessPoolExecutor(
                max_workers=min(n_workers, len(jobs)),
                initializer=prepare_worker,
                initargs=(Path(scratch),),
                env=dict.fromkeys(THREAD_VARIABLES, str(THREADS)),
            )
            try:
                futures: dict[Future[None], Job] = {
                    executor.submit(run_job, i, job, self._folder, journal): job
                    for i, job in enumerate(jobs)
                }
                for event in self._follow(journal, futures):
                    self._on_event(event)
            finally:
                with _quiet_manager():
                    executor.shutdown(wait=True, kill_workers=True)
        errors = [error for future in futures if (error := future.exception()) is not None]
        if not errors:
            return [], [], ""
        suspects, waiting = list[Job](), list[Job]()
        for number, job in enumerate(jobs):
            rest = job.without(self._done)
            if (killed := self._overdue.get(number)) is not None:
                waiting += self._after_kill(rest, killed)
            elif rest.cells:
                innocent = self._overdue or number not in self._started
                (waiting if innocent else suspects).append(rest)
        return suspects, waiting, _how_it_died(errors[0])

    def _after_kill(self, job: Job, killed: Doing) -> list[Job]:
        """Fail the cell that a worker was killed for; return what is left of its job."""
        if killed.path is None:
            text = (
                f"{job.batch[0].entry.name}: {len(job.batch)} cells could not be fitted together "
                f"in {killed.limit:g} s (and their worker was killed); now one by one"
            )
            self._on_event({"event": "note", "pid": os.getpid(), "text": text})
            return job.one_by_one()
        for cell in job.cells:
            if str(cell.path) == killed.path:
                doing = "it was fitted or scored (and was killed)"
                self._fail(cell, out_of_time(killed.limit, doing))
        rest = job.without(self._done)
        return [rest] if rest.cells else []

    def _follow(self, journal: Journal, futures: dict[Future[None], Job]) -> Iterator[Event]:
        """Yield the journal's events until every future is done; raise what a job itself raised."""
        with journal.path.open(encoding="utf-8") as file:
            rest = ""
            running = True
            while running:
                waited = wait(futures, timeout=POLL_SECONDS, return_when=FIRST_EXCEPTION)
                running = bool(waited.not_done)
                for future in waited.done:
                    error = future.exception()
                    if error is not None and not isinstance(error, BrokenProcessPool):
                        raise error
                rest += file.read()
                *lines, rest = rest.split("\n")
                for line in lines:
                    event = json.loads(line)
                    if event["event"] == "job":
                        self._started.add(event["number"])
                    elif event["event"] in ("batch", "begin"):
                        deadline = time.monotonic() + event["limit"] + GRACE_SECONDS
                        self._doing[event["pid"]] = Doing(
                            event["number"], event.get("path"), event["limit"], deadline
                        )
                    elif event["event"] in ("note", "done"):
                        self._doing.pop(event["pid"], None)
                        if event["event"] == "done":
                            self._done.add(event["path"])
                    yield event
                self._kill_overdue()

    def _kill_overdue(self) -> None:
        """Kill workers that are past what they may take."""
        for pid, doing in list(self._doing.items()):
            if time.monotonic() > doing.deadline:
                del self._doing[pid]
                self._overdue[doing.job] = doing
                with contextlib.suppress(psutil.NoSuchProcess):
                    psutil.Process(pid).kill()

    def _fail(self, cell: Cell, reason: str) -> None:
        store(self._folder, failed_result(cell, reason), None)
        self._done.add(str(cell.path))
        self._on_event(
            {
                "event": "done",
                "pid": os.getpid(),
                "label": cell.label,
                "method": cell.entry.name,
                "path": str(cell.path),
                "reason": reason,
                "seconds": 0.0,
                "cpu_seconds": 0.0,
            }
        )


@contextlib.contextmanager
def _quiet_manager() -> Iterator[None]:
    """Hide the KeyError of loky's manager thread when its work items go while it hands them out."""
    reported = threading.excepthook

    def hook(args: threading.ExceptHookArgs) -> None:
        if not issubclass(args.exc_type, KeyError):
            reported(args)

    threading.excepthook = hook
    try:
        yield
    finally:
        threading.excepthook = reported


def _how_it_died(error: BaseException) -> str:
    """Return the reason of a cell whose worker died."""
    codes = re.search(r"exit codes? of the workers? (?:is|are) \{(.*?)\}", str(error))
    return "its worker process died" + (f" ({codes.group(1)})" if codes else "")
