"""What a method costs: seconds to fit, memory, and microseconds a call.

These are measurements of a machine, not pure functions: they belong beside the name of the machine,
and are never asserted in a test. The number of parameters is the method's own to say.
"""

from __future__ import annotations

import gc
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import psutil

if sys.platform != "win32":
    import resource

BYTES_PER_MB = 1_000_000
MEMORY_SAMPLING_SECONDS = 0.02


@dataclass
class FitCost:
    """What a block of code took; nan until the block has ended."""

    wall_seconds: float = np.nan
    """Elapsed time, in s."""
    cpu_seconds: float = np.nan
    """User and system time of all threads of this process, in s; not that of child processes."""
    peak_memory_mb: float = np.nan
    """Peak resident memory of the whole process during the block, in MB (10^6 bytes)."""


@contextmanager
def measure_cost() -> Iterator[FitCost]:
    """Measure wall time, CPU time and peak memory of a block.

    The peak is absolute: it includes the interpreter, the libraries and the data that were resident
    when the block began, because what was there before decides what fits on a machine, and a rise
    depends on what ran earlier in the process. For numbers that compare, fit in a fresh process.

    It is the largest resident set seen by a thread that looks every 20 ms, and can miss a shorter
    spike. Where the block pushes the process to a new record, the operating system's own high-water
    mark (``ru_maxrss``) is used as well, which misses nothing; that mark never falls, so that it
    says nothing of a block that stays below an earlier peak.

    Yields
    ------
    FitCost
        Filled when the block ends, also by an exception.

    Examples
    --------
    >>> with measure_cost() as cost:
    ...     total = sum(range(1000))
    >>> cost.wall_seconds > 0
    True
    """
    cost = FitCost()
    record = _highest_resident_bytes()
    with _ResidentSampler() as sampler:
        wall, cpu = time.perf_counter(), time.process_time()
        try:
            yield cost
        finally:
            cost.wall_seconds = time.perf_counter() - wall
            cost.cpu_seconds = time.process_time() - cpu
            sampler.stop()
            new_record = _highest_resident_bytes()
            peak = max(sampler.peak, new_record if new_record > record else 0)
            cost.peak_memory_mb = peak / BYTES_PER_MB


def median_call_us(function: Callable[[], object], n_calls: int = 1000) -> float:
    """Median wall time of one call, in µs.

    A tenth as many calls, at least one, come first and are not counted: they fill caches and finish
    what is compiled or allocated on first use. The garbage collector is off meanwhile. The median
    is what a typical call takes; the calls that the system interrupts do not move it.

    Parameters
    ----------
    function
        Called without arguments; bind them with ``functools.partial`` or a lambda. The number of
        threads is the caller's to fix: the suite's `step_us` is for one thread and one state.
    n_calls
        Number of timed calls.

    Returns
    -------
    float
        In µs. It includes the call's own overhead, well below 0.1 µs.

    Raises
    ------
    ValueError
        If n_calls is below 1.
    """
    if n_calls < 1:
        raise ValueError(f"Expected n_calls of at least 1, got {n_calls}")
    durations = np.empty(n_calls, dtype=np.int64)
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        for _ in range(max(1, n_calls // 10)):
            function()
        for i in range(n_calls):
            start = time.perf_counter_ns()
            function()
            durations[i] = time.perf_counter_ns() - start
    finally:
        if was_enabled:
            gc.enable()
    return float(np.median(durations)) / 1000.0


class _ResidentSampler:
    """Thread that keeps the largest resident set it has seen, in bytes."""

    def __init__(self) -> None:
        self.peak = 0
        self._process = psutil.Process()
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="memory-sampler", daemon=True)

    def __enter__(self) -> _ResidentSampler:
        self._look()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        """Look a last time and end the thread; a second call does nothing."""
        if not self._stopped.is_set():
            self._stopped.set()
            self._thread.join()
            self._look()

    def _run(self) -> None:
        while not self._stopped.wait(MEMORY_SAMPLING_SECONDS):
            self._look()

    def _look(self) -> None:
        self.peak = max(self.peak, int(self._process.memory_info().rss))


def _highest_resident_bytes() -> int:
    """High-water mark of this process's resident set since it began; 0 where there is none."""
    if sys.platform == "win32":
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return int(peak) if sys.platform == "darwin" else int(peak) * 1024
