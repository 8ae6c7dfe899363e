"""Keeps worker processes going until every cell has a record, whatever happens to them."""

from __future__ import annotations

import contextlib
import json
import os
import re
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, wait
from pathlib import Path
from typing import Any

from joblib.externals.loky.process_executor import BrokenProcessPool, ProcessPoolExecutor

from iflow_gym.baselines.runner.plan import Cell, Job
from iflow_gym.baselines.runner.work import (
    THREADS,
    Journal,
    failed_result,
    prepare_worker,
    run_job,
)
from iflow_gym.results import write_result

Event = dict[str, Any]

POLL_SECONDS = 0.2

THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMEXPR_NUM_THREADS",
)


class WorkersError(RuntimeError):
    """Worker processes die before they do anything."""


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
        self._pids: set[int] = set()

    def run(self, jobs: Sequence[Job]) -> None:
        """Do all jobs; on return every cell has a record.

        Where a worker dies, all others of its executor die with it. The jobs that had not begun go
        on together; those that had are then done again, each alone, without the cells that have
        their record. One that dies alone is split into its cells, and a single cell that dies
        alone becomes a failed one.

        Raises
        ------
        WorkersError
            If workers die before any of them begins a job.
        KeyboardInterrupt
            On Ctrl-C, after the workers were killed. Records are whole or absent.
        """
        together, alone = list(jobs), list[Job]()
        try:
            while together:
                began, waiting, reason = self._round(together, self._n_workers)
                if waiting and not began:
                    raise WorkersError(f"Expected workers to begin their jobs, but {reason}.")
                alone += began
                together = waiting
            while alone:
                job = alone.pop(0)
                began, waiting, reason = self._round([job], 1)
                left = [cell for unfinished in began + waiting for cell in unfinished]
                if len(job) > 1:
                    alone = [(cell,) for cell in left] + alone
                else:
                    for cell in left:
                        self._fail(cell, reason)
        finally:
            self._sweep()

    def _round(self, jobs: Sequence[Job], n_workers: int) -> tuple[list[Job], list[Job], str]:
        """Run jobs in a fresh executor.

        Returns the unfinished cells of jobs that had begun and of those that had not, both empty
        unless a worker died, and how it died.
        """
        self._started.clear()
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
        left = [tuple(c for c in job if str(c.path) not in self._done) for job in jobs]
        began = [job for i, job in enumerate(left) if job and i in self._started]
        waiting = [job for i, job in enumerate(left) if job and i not in self._started]
        return began, waiting, _how_it_died(errors[0])

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
                    self._pids.add(event["pid"])
                    if event["event"] == "job":
                        self._started.add(event["number"])
                    elif event["event"] == "done":
                        self._done.add(event["path"])
                    yield event

    def _fail(self, cell: Cell, reason: str) -> None:
        write_result(self._folder, failed_result(cell, reason))
        self._on_event(
            {
                "event": "done",
                "pid": os.getpid(),
                "label": cell.label,
                "path": str(cell.path),
                "reason": reason,
                "seconds": 0.0,
            }
        )

    def _sweep(self) -> None:
        """Remove what killed workers were writing."""
        for path in self._folder.glob("*/*.partial"):
            if path.name.split(".")[-2] in {str(pid) for pid in self._pids}:
                with contextlib.suppress(OSError):
                    path.unlink()


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
