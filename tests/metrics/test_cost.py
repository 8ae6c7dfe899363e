"""Measurements of cost: what they count, without asserting how fast this machine is."""

import gc
import mmap
import time

import numpy as np
import pytest

from iflow_gym import metrics


def test_sleeping_takes_wall_time_and_hardly_any_cpu_time():
    with metrics.measure_cost() as cost:
        assert np.isnan(cost.wall_seconds)  # nothing is known yet
        time.sleep(0.05)
    assert cost.wall_seconds >= 0.05
    assert 0 <= cost.cpu_seconds < cost.wall_seconds


def test_peak_holds_what_the_block_allocated_and_let_go():
    with metrics.measure_cost() as before:
        pass
    # 100 MB, touched; of the system, since an allocator may have as much left from before.
    with metrics.measure_cost() as cost, mmap.mmap(-1, 100_000_000) as block:
        np.frombuffer(block, dtype=np.uint8).fill(1)
        time.sleep(0.2)  # ten looks of the sampler
    assert cost.peak_memory_mb >= before.peak_memory_mb + 90
    with metrics.measure_cost() as after:
        pass
    assert after.peak_memory_mb <= cost.peak_memory_mb - 90  # of the block, not of the process


def test_cost_is_known_after_an_exception():
    cost = metrics.FitCost()

    def fail():
        nonlocal cost
        with metrics.measure_cost() as cost:
            raise RuntimeError("diverged")

    with pytest.raises(RuntimeError, match="diverged"):
        fail()
    assert cost.wall_seconds > 0
    assert cost.peak_memory_mb > 1


def test_median_call_counts_microseconds_after_a_warm_up(monkeypatch):
    clock, calls = 0, []

    def function():
        nonlocal clock
        calls.append(gc.isenabled())
        # Two calls of warm-up at 9 ms, then 11 of 3 µs among interruptions of 5 ms.
        clock += 9_000_000 if len(calls) <= 2 else 3_000 if len(calls) % 2 else 5_000_000

    monkeypatch.setattr(time, "perf_counter_ns", lambda: clock)
    assert metrics.median_call_us(function, n_calls=21) == 3.0
    assert len(calls) == 23
    assert not any(calls)
    assert gc.isenabled()


def test_median_call_turns_the_collector_on_again_after_an_exception():
    with pytest.raises(ZeroDivisionError):
        metrics.median_call_us(lambda: 1 / 0)
    assert gc.isenabled()
    with pytest.raises(ValueError, match="n_calls of at least 1, got 0"):
        metrics.median_call_us(gc.isenabled, 0)
