"""The orbit field: its orbit on closed curves, its decay in closed form, its limits."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iflow_gym import Demonstrations
from iflow_gym.baselines.orbit_field import OrbitField
from iflow_gym.metrics import orbit_hausdorff, period

DT, PERIOD = 0.01, 2.0


def curve(u, d=2):
    """A closed curve that is not star-shaped about its centre, at phases u."""
    a = 2 * np.pi * np.asarray(u)
    columns = [np.cos(a) + 0.5 * np.cos(2 * a), np.sin(a) + 0.3 * np.sin(3 * a), 0.4 * np.cos(a)]
    return np.stack(columns[:d], axis=-1)


def warped(u):
    """Phases at an uneven tempo, of the same period."""
    return u + 0.08 * np.sin(2 * np.pi * u) / (2 * np.pi)


def recordings(d=2, n=3, rounds=4, noise=0.0):
    rng = np.random.default_rng(0)
    t = np.arange(round(rounds * PERIOD / DT)) * DT
    paths = [curve(warped(t / PERIOD + 0.3 * i), d) for i in range(n)]
    paths = [p + noise * rng.standard_normal(p.shape) for p in paths]
    return Demonstrations.from_arrays(paths, dt=DT, period=PERIOD)


@pytest.mark.parametrize("d", [2, 3])
def test_it_recovers_a_curve_and_its_tempo(d):
    system = OrbitField().fit(recordings(d), seed=0)
    dense = curve(np.linspace(0, 1, 4000), d)
    assert orbit_hausdorff(system._points, dense) < 0.01
    shown = recordings(d)
    error = system.velocity(shown.positions[1]) - shown.velocities[1]
    speed = np.linalg.norm(shown.velocities[1], axis=1)
    assert np.linalg.norm(error[5:-5], axis=1).max() < 0.12 * speed.max()
    path = system.rollout(curve(0.1, d), 800, DT)
    assert period(path, DT) == pytest.approx(PERIOD, rel=1e-3)


SYSTEM = OrbitField(decay=6.0).fit(recordings(), seed=0)


@given(
    st.tuples(*[st.floats(-5, 5)] * 2),
    st.floats(1e-4, 1.0),
)
@settings(max_examples=200, deadline=None)
def test_the_distance_falls_at_the_stated_rate_at_steps_of_any_length(x, dt):
    before = np.sqrt(SYSTEM.lyapunov(x))
    after = np.sqrt(SYSTEM.lyapunov(SYSTEM.step(x, dt)))
    assert after <= np.exp(-6.0 / PERIOD * dt) * before + 1e-9


def test_the_distance_is_to_the_nearest_point_of_all():
    rng = np.random.default_rng(1)
    x = rng.uniform(-3, 3, (2000, 2))
    dense = SYSTEM._curve(np.linspace(0, 1, 40_000))
    least = [np.linalg.norm(point - dense, axis=1).min() for point in x]
    np.testing.assert_allclose(np.sqrt(SYSTEM.lyapunov(x)), least, atol=1e-4)


def test_a_small_step_is_the_field():
    rng = np.random.default_rng(2)
    x = rng.uniform(-2, 2, (200, 2))
    step = 1e-7
    moved = (SYSTEM.step(x, step) - x) / step
    np.testing.assert_allclose(moved, SYSTEM.velocity(x), atol=1e-5)


def test_the_density_integrates_to_one_and_explains_the_recordings():
    system = OrbitField().fit(recordings(noise=1e-3), seed=0)
    x = recordings().positions[0][40]
    mean = system.step(x, DT)
    sigma = np.sqrt(np.linalg.eigvalsh(system.noise_ * DT).max())
    axis = np.linspace(-6, 6, 201) * sigma
    grid = mean + np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    density = np.exp(system.log_prob(np.tile(x, (len(grid), 1)), grid, DT))
    assert density.sum() * (axis[1] - axis[0]) ** 2 == pytest.approx(1.0, rel=1e-3)


def test_motions_that_end_are_refused():
    t = np.linspace(0, 1, 50)[:, None]
    line = Demonstrations.from_arrays([(1 - t) * [1.0, 2.0]], dt=0.02)
    with pytest.raises(ValueError, match="motions that repeat, got 'unnamed', which ends"):
        OrbitField().fit(line, seed=0)
