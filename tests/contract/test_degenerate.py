"""Recordings at the edge of what a method is made for: it fits, or says why not; never NaN."""

import numpy as np
import pytest

from iflow_gym.baselines.registry import load_method
from iflow_gym.baselines.runner.presets import load_settings
from iflow_gym.demonstrations import Demonstrations
from iflow_gym.system import DynamicalSystem

NAMES = ("gpr", "lwr", "bc", "dmp", "promp", "kmp")


def bend(n_samples=200, offset=0.0):
    s = np.linspace(0, 1, n_samples)[:, None]
    return (1 - s) * np.hstack([np.cos(3 * s), 1 + offset + np.sin(3 * s)])


def sets():
    s = np.linspace(0, 1, 100)[:, None]
    wave = np.sin(6 * s)
    line = (1 - s) * np.array([[4.0, -2.0]])
    return {
        "one demonstration": ([bend()], 0.01),
        "two": ([bend(), bend(offset=0.1)], 0.01),
        "a straight line": ([line], 0.02),
        "straight lines along an axis": ([(1 - s) * [[4.0, 0.0]], (1 - s) * [[5.0, 0.0]]], 0.02),
        "30 samples": ([bend(30)], 0.1),
        "3 samples": ([bend(3)], 1.0),
        "10 000 samples": ([bend(10_000), bend(10_000, 0.1)], 1e-4),
        "different lengths and times": ([bend(50), bend(400, 0.1)], [0.03, 0.01]),
        "equal demonstrations": ([bend()] * 4, 0.01),
        "starts in one place": ([bend(), bend() * np.array([[1.0, 1.0]])], 0.01),
        "one dimension": ([1 - s, 1.2 * (1 - s)], 0.02),
        "four dimensions": ([np.hstack([line, wave * (1 - s), line[:, :1]])], 0.02),
        "a crossing": ([np.hstack([np.sin(6 * s), np.sin(12 * s)]) * (1 - s)], 0.02),
        "tiny lengths": ([1e-7 * bend(), 1e-7 * bend(offset=0.1)], 0.01),
        "huge lengths": ([1e7 * bend(), 1e7 * bend(offset=0.1)], 0.01),
        "far from the origin": ([1e4 + bend(), 1e4 + bend(offset=0.1)], 0.01),
        "a rest at the end": ([np.vstack([bend(), np.zeros((200, 2))])], 0.01),
        "ends that differ": ([bend(), bend() + np.array([[0.01, 0.0]])], 0.01),
    }


SETS = sets()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("label", SETS)
def test_it_fits_and_gives_numbers(name, label):
    paths, dt = SETS[label]
    shown = Demonstrations.from_arrays(paths, dt=dt)
    method = load_method(name)(**load_settings(name, "smoke", registered=True))
    method.fit(shown, seed=0)
    box = shown.bounding_box
    around = np.random.default_rng(0).uniform(
        2 * box.low - box.high, 2 * box.high - box.low, size=(5, shown.n_dims)
    )
    x = np.concatenate([shown.starts, around, shown.attractor[None]])
    path = method.rollout(x, 30, shown.durations.mean() / 20)
    assert np.isfinite(path).all()
    if isinstance(method, DynamicalSystem):
        assert np.isfinite(method.velocity(np.concatenate(shown.positions))).all()
        return
    size = max(box.diagonal, 1e-12)
    assert np.abs(path[:, -1] - shown.attractor).max() < 0.05 * size
    made = method.rollout(shown.starts[0], len(paths[0]) - 1, shown.dt[0])
    apart = np.linalg.norm(made - shown.positions[0], axis=1).max()
    assert apart < (1.0 if label == "3 samples" else 0.15) * size


@pytest.mark.parametrize("name", NAMES)
def test_lengths_and_times_have_no_unit(name):
    """In other units the same motion, to what single precision rounds."""
    if name == "bc":
        pytest.skip("single precision, whose rounding training magnifies")
    small = Demonstrations.from_arrays([bend(), bend(offset=0.1)], dt=0.01)
    large = Demonstrations.from_arrays([1000 * p for p in small.positions], dt=10.0)
    one, other = (load_method(name)().fit(d, seed=0) for d in (small, large))
    start = np.array([1.1, 1.0])
    np.testing.assert_allclose(
        1000 * one.rollout(start, 50, 0.01),
        other.rollout(1000 * start, 50, 10.0),
        rtol=0,
        atol=1000 * (0.02 if name == "gpr" else 1e-6),  # scikit-learn's optimiser stops early
    )
