"""The loop of benchmarks/control_loop.py, on a clock that the test turns."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnxruntime")

PATH = Path(__file__).parents[1] / "benchmarks" / "control_loop.py"
_spec = importlib.util.spec_from_file_location("control_loop", PATH)
loop = importlib.util.module_from_spec(_spec)
sys.modules["control_loop"] = loop  # dataclasses look their module up
_spec.loader.exec_module(loop)

STARTS = np.array([[1.0, 0.0], [0.0, 1.0]])


class Clock:
    """Seconds that pass by 1 µs whenever they are asked for, and by what is slept or worked."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        self.now += 1e-6
        return self.now

    def pass_(self, seconds):
        self.now += seconds


def played(costs, oversleep=0.0, period=1e-3):
    clock, costs = Clock(), iter(costs)
    seen = []

    def step(x):
        seen.append(x)
        clock.pass_(next(costs))
        return 0.5 * x

    n = 40
    ticks = loop.run(step, STARTS, n, period, 2e-4, clock, lambda s: clock.pass_(s + oversleep))
    return ticks, seen


def test_a_loop_in_time_is_late_by_what_the_clock_cannot_tell():
    ticks, _ = played([1e-4] * 40)
    assert (ticks.late >= 0).all()
    assert ticks.late.max() <= 2e-6
    np.testing.assert_allclose(ticks.took, 1e-4, atol=2e-6)
    assert ticks.missed == 0.0


def test_one_slow_command_delays_the_next_tick_and_no_other():
    costs = [1e-4] * 40
    costs[10] = 1.5e-3
    ticks, _ = played(costs)
    np.testing.assert_allclose(ticks.late[11], 5e-4, atol=5e-6)
    np.testing.assert_allclose(np.delete(ticks.late, 11), 0.0, atol=2e-6)
    assert ticks.missed == pytest.approx(1 / 40)


def test_oversleeping_beyond_the_spin_is_jitter():
    ticks, _ = played([1e-4] * 40, oversleep=5e-4)
    np.testing.assert_allclose(ticks.late, 3e-4, atol=5e-6)
    assert ticks.summary()["jitter_p50_us"] == pytest.approx(300, abs=5)


def test_each_state_follows_from_the_last_one_and_starts_take_turns():
    _, seen = played([0.0] * 40)
    each = 40 // 8
    for k, x in enumerate(seen):
        start = STARTS[k // each % 2]
        np.testing.assert_allclose(x, start * 0.5 ** (k % each))


def test_the_ways_take_the_same_step():
    from iflow_gym import load_lasa
    from iflow_gym.baselines.imitation_flow import ImitationFlow

    motion = load_lasa("Angle")
    system = ImitationFlow(n_steps=2).fit(motion, seed=0)
    found = {name: step(motion.starts[0]) for name, step in loop.ways(system, 0.001).items()}
    for x in found.values():
        np.testing.assert_allclose(x, found["NumPy"], rtol=0, atol=1e-9)
        assert x.shape == (2,)
