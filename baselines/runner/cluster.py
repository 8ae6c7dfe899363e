"""Runs jobs on the workers of a Dask cluster, as `pool` runs them on this machine.

Plain futures of `distributed` are used, not joblib's Dask backend: a job alone is given out again
when its worker dies, without the others; a queue brings each record the moment it is known; and
the plan of the run is sent once, as the result of a task that all jobs depend on. (Data that are
scattered are lost with the workers that hold them; a task's result is made again.)

A Dask worker runs tasks in threads, where no time limit can interrupt a fit. So a task begins a
process, `iflow_gym.baselines.runner.remote`, that runs a `Pool` of one worker: limits, memory,
and deaths are what they are at home. Machines share no file system: records and models travel back
as bytes, and only this process writes results. Demonstrations do not travel at all: each worker
has its own, and their hash is compared, like that of the code and the libraries' versions.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from iflow_gym.baselines.runner.cluster_errors import ClusterError
from iflow_gym.baselines.runner.plan import Cell, Job
from iflow_gym.baselines.runner.pool import THREAD_VARIABLES
from iflow_gym.baselines.runner.remote import Shipment, read_message
from iflow_gym.baselines.runner.scoring import THREADS, failed_result
from iflow_gym.baselines.runner.store import store
from iflow_gym.results import ResultFileError, read_result, write_whole

CONNECT_SECONDS = 10.0
"""How long the scheduler is waited for."""

BUNDLE = 6
"""Cells of jobs of one cell that a task does one after the other: beginning a task's processes
takes as long as scoring a cell."""

ATTEMPTS = 3
"""Times that a job is given out again after its worker died, beyond what Dask itself tries."""

POLL_SECONDS = 0.5

Event = dict[str, Any]


class Cluster:
    """Runs jobs on the workers of a Dask scheduler.

    Parameters
    ----------
    folder
        Of the results; only this process writes there.
    scheduler
        Address, such as ``"tcp://host:8786"``.
    on_event
        Called in this process with each event of the workers' journals; those of one worker come
        in their order.

    Raises
    ------
    ClusterError
        If Dask is not installed, or nothing answers at the address.
    """

    def __init__(self, folder: Path, scheduler: str, on_event: Callable[[Event], object]) -> None:
        self._folder = folder
        self._on_event = on_event
        self._done: set[str] = set()
        try:
            dask: Any = import_module("distributed")
        except ImportError as error:
            raise ClusterError(
                f"Expected Dask for --backend dask, got {error}: pip install 'iflow-gym[dask]'."
            ) from error
        try:
            self._client: Any = dask.Client(scheduler, timeout=CONNECT_SECONDS)
        except (OSError, ValueError) as error:
            raise ClusterError(
                f"Expected a Dask scheduler at {scheduler}, got none within {CONNECT_SECONDS:g} s "
                f"({type(error).__name__}: {error}): start one with `dask scheduler` and workers "
                f"with `dask worker {scheduler}`, or correct --scheduler."
            ) from error

    def run(self, jobs: Sequence[Job]) -> None:
        """Do all jobs; on return every cell has a record.

        A worker that is lost costs the time of its cells: Dask gives its jobs to others, and
        records that had arrived are kept. Jobs whose workers were lost again and again become
        failed cells.

        Raises
        ------
        ClusterError
            If a worker has other code, data or versions than this process, if one cannot begin its
            work, or if the scheduler is lost. What had arrived is kept.
        OSError
            If a record cannot be written.
        """
        try:
            if not self._client.scheduler_info()["workers"]:
                text = f"No workers yet at {self._client.scheduler.address}: waiting for them"
                self._note(text)
            name = f"iflow-gym-{uuid.uuid4().hex}"
            messages = import_module("distributed").Queue(name, client=self._client)
            try:
                self._follow(list(jobs), messages, name)
            finally:
                with contextlib.suppress(Exception):  # the scheduler may be gone
                    messages.close()
        finally:
            with contextlib.suppress(Exception):
                self._client.close(timeout=5)

    def _follow(self, jobs: list[Job], messages: Any, name: str) -> None:
        """Give all jobs out, write what comes back, and give out again what was lost."""
        killed = import_module("distributed").KilledWorker
        shipment = self._client.submit(
            Shipment, tuple(jobs), _code_of(jobs), key=f"{name}-plan", pure=False
        )
        waiting = [(bundle, 0) for bundle in _bundles(jobs)]
        running: dict[Any, tuple[list[int], int]] = {}
        while waiting or running:
            for numbers, attempt in waiting:
                key = f"{name}-{numbers[0]}-{attempt}"
                future = self._client.submit(run_bundle, shipment, numbers, name, key=key)
                running[future] = numbers, attempt
            waiting = []
            ended = [future for future in running if future.done()]  # before the queue is emptied
            for message in self._received(messages, wait=not ended):
                self._take(jobs, message)
            for future in ended:
                numbers, attempt = running.pop(future)
                if future.status == "finished":
                    continue
                error = future.exception() if future.status == "error" else None
                if future.status == "cancelled" or self._client.status != "running":
                    raise ClusterError(
                        "The Dask scheduler is lost. What is done is kept; the next run goes on "
                        "from there."
                    )
                if not isinstance(error, killed):
                    raise ClusterError(f"A Dask worker could not do its work: {error}")
                for number in numbers:
                    left = jobs[number].without(self._done)
                    if not left.cells:
                        continue
                    if attempt < ATTEMPTS:
                        waiting.append(([number], attempt + 1))
                    else:
                        for cell in left.cells:
                            self._fail(cell, f"its Dask workers died, {attempt + 1} times")

    def _received(self, messages: Any, *, wait: bool) -> Iterator[Event]:
        """Yield what has arrived; wait a little where asked to."""
        try:
            if wait and not messages.qsize():
                time.sleep(POLL_SECONDS)
            while messages.qsize():
                yield from map(read_message, messages.get(batch=True))
        except OSError as error:
            raise ClusterError(
                f"The Dask scheduler is lost ({type(error).__name__}: {error}). What is done is "
                "kept; the next run goes on from there."
            ) from error

    def _take(self, jobs: Sequence[Job], event: Event) -> None:
        """Write the record that an event brings, and pass the event on."""
        if event["event"] == "done":
            path = event["path"]
            if path in self._done:  # by a worker that was lost after it had sent this
                return
            record, model = event.pop("record"), event.pop("model")
            self._write(path, record, model)
            self._done.add(path)
        self._on_event(event)

    def _write(self, path: str, record: bytes, model: bytes | None) -> None:
        target = self._folder / path
        target.parent.mkdir(parents=True, exist_ok=True)
        beside = target.with_suffix(".safetensors")
        write_whole({beside: model, target: record} if model is not None else {target: record})
        if model is None:
            beside.unlink(missing_ok=True)
        try:
            read_result(target)
        except ResultFileError as error:
            raise ClusterError(f"A Dask worker sent a record that is none: {error}") from error

    def _fail(self, cell: Cell, reason: str) -> None:
        store(self._folder, failed_result(cell, reason), None)
        self._done.add(str(cell.path))
        event = {"event": "done", "pid": os.getpid(), "label": cell.label, "reason": reason}
        spent = {"method": cell.entry.name, "seconds": 0.0, "cpu_seconds": 0.0}
        self._on_event({**event, **spent, "path": str(cell.path)})

    def _note(self, text: str) -> None:
        self._on_event({"event": "note", "pid": os.getpid(), "text": text})


def run_bundle(shipment: Shipment, numbers: Sequence[int], queue: str) -> None:
    """Run jobs of a shipment in a process of their own; the task of a Dask worker.

    Each event of the journal is put into the queue, with the record and the model of a cell that
    is done. The process is killed when the task is no longer wanted: the run was interrupted.
    """
    dask: Any = import_module("distributed")
    messages = dask.Queue(queue, client=dask.get_client())
    worker = dask.get_worker()
    key = worker.get_current_task()
    with tempfile.TemporaryDirectory(prefix="iflow-gym-task-") as scratch:
        work = Path(scratch)
        (work / "jobs").write_bytes(pickle.dumps([shipment.jobs[n] for n in numbers]))
        for name, content in shipment.code.items():
            path = work / "code" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        paths = [str(work / "code"), os.environ.get("PYTHONPATH", "")]
        variables = dict.fromkeys(THREAD_VARIABLES, str(THREADS))
        env = os.environ | variables | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
        with (work / "errors").open("wb") as errors:
            process = subprocess.Popen(
                [sys.executable, "-m", "iflow_gym.baselines.runner.remote", scratch],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=errors,
                env=env,
            )
        try:
            sent = 0
            running = True
            while running:
                try:
                    process.wait(POLL_SECONDS)
                    running = False
                except subprocess.TimeoutExpired:
                    task = worker.state.tasks.get(key)
                    if task is None or task.state not in ("executing", "long-running"):
                        return
                while (message := work / "messages" / str(sent)).exists():
                    messages.put(message.read_bytes())
                    message.unlink()
                    sent += 1
            if process.returncode:
                text = (work / "errors").read_text(errors="replace").strip()
                raise RuntimeError(text[-2000:] or f"exit status {process.returncode}")
        finally:
            process.kill()
            process.wait()


def _bundles(jobs: Sequence[Job]) -> list[list[int]]:
    """Return numbers of jobs that go out together: large ones alone, small ones of one method."""
    bundles: list[list[int]] = []
    sizes: list[int] = []
    last = ""
    for number, job in enumerate(jobs):
        name, size = job.batch[0].entry.name, len(job.cells)
        if len(job.batch) == 1 and name == last and sizes[-1] + size <= BUNDLE:
            bundles[-1].append(number)
            sizes[-1] += size
        else:
            bundles.append([number])
            sizes.append(size)
        last = name if len(job.batch) == 1 else ""
    return bundles


def _code_of(jobs: Sequence[Job]) -> dict[str, bytes]:
    """Return the Python files of methods from outside this package, by where they are imported."""
    files: dict[str, bytes] = {}
    for top in {job.batch[0].entry.target.partition(":")[0].partition(".")[0] for job in jobs}:
        spec = find_spec(top)
        if top == "iflow_gym" or spec is None or spec.origin is None:
            continue
        origin = Path(spec.origin)
        if not spec.submodule_search_locations:
            files[origin.name] = origin.read_bytes()
            continue
        for path in sorted(origin.parent.rglob("*.py")):
            files[str(Path(top) / path.relative_to(origin.parent))] = path.read_bytes()
    return files
