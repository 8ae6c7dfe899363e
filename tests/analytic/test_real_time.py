"""One state at a time against the batch, and the latent system's floats against scipy."""

import copy
import dataclasses
import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import scipy.linalg
import torch
from imitation_flow_parts import (
    EMISSIONS,
    cycle_latent,
    dynamics,
    flow_arrays,
    linear_latent,
    random_flow,
    states,
    step,
    velocity,
)

from iflow_gym.baselines.imitation_flow.realtime import (
    BatchOfOne,
    RealTimeStepper,
    linear,
    point_flow,
)

TIMES = [1e-6, 0.01, 0.3, 5.0, 400.0]


class Wrapped:
    """A flow or a latent system of a kind that the stepper does not know."""

    def __init__(self, inner):
        self._inner = inner
        self.n_dims = inner.n_dims

    def forward(self, z):
        return self._inner.forward(z)

    def inverse(self, y):
        return self._inner.inverse(y)

    def push_forward(self, z, dz):
        return self._inner.push_forward(z, dz)

    def rate(self, z):
        return self._inner.rate(z)

    def propagate(self, z, times):
        return self._inner.propagate(z, times)


def assert_is_the_batch(parts, x):
    stepper = RealTimeStepper(parts)
    size = np.abs(parts.frame).max()
    for dt in TIMES:
        got = np.stack([stepper.step(state, dt) for state in x])
        expected = step(parts, x, np.full(len(x), dt))
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12 * size)
    got = np.stack([stepper.velocity(state) for state in x])
    expected = velocity(parts, x)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("emission", EMISSIONS)
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_measurement_that_is_no_number_leaves_nothing_behind(d, emission, bad):
    stepper = RealTimeStepper(dynamics(d, emission=emission))
    good, poor = states(stepper.dynamics, n=1)[0], np.full(d, bad)
    before = stepper.step(good, 0.1), stepper.velocity(good)
    with np.errstate(invalid="ignore"):
        assert not np.isfinite(stepper.step(poor, 0.1)).any()
        assert not np.isfinite(stepper.velocity(poor)).any()
    np.testing.assert_array_equal(stepper.step(good, 0.1), before[0])
    np.testing.assert_array_equal(stepper.velocity(good), before[1])


@pytest.mark.parametrize("d", [2, 3, 6])
@pytest.mark.parametrize("latent", [linear_latent, cycle_latent])
@pytest.mark.parametrize("emission", EMISSIONS)
def test_one_state_is_the_batch(d, latent, emission):
    parts = dynamics(d, latent(d), emission=emission)
    assert not isinstance(point_flow(parts.flow), BatchOfOne)
    assert_is_the_batch(parts, states(parts))


@pytest.mark.parametrize("d", [2, 3])
def test_other_flows_and_latent_systems_go_through_their_batch(d):
    parts = dynamics(d)
    other = dataclasses.replace(parts, flow=Wrapped(parts.flow), latent=Wrapped(parts.latent))
    assert_is_the_batch(other, states(parts, n=5))


@pytest.mark.parametrize("d", [2, 3, 6])
@pytest.mark.parametrize("emission", EMISSIONS)
def test_the_flow_is_torchs(d, emission):
    flow = random_flow(d, n_layers=24, emission=emission)
    parts = dynamics(d, n_layers=24, emission=emission)
    if emission == "coupling":
        for name, array in flow_arrays(flow).items():
            np.testing.assert_array_equal(parts.flow.arrays[name], array)
    point = point_flow(parts.flow)
    for z in np.random.default_rng(0).normal(size=(10, d)):
        with torch.no_grad():
            y = flow(torch.as_tensor(z)[None, :, None])
        np.testing.assert_allclose(point.forward(z.tolist()), y[0, :, 0], rtol=0, atol=1e-11)
        np.testing.assert_allclose(point.inverse(y[0, :, 0].tolist()), z, rtol=0, atol=1e-11)


@pytest.mark.parametrize("emission", EMISSIONS)
@pytest.mark.parametrize("d", [2, 3])
def test_far_away(d, emission):
    parts = dynamics(d, n_layers=24, emission=emission)
    x = states(parts, n=10, spread=3e4)
    stepper = RealTimeStepper(parts)
    got = np.stack([stepper.step(state, 0.1) for state in x])
    np.testing.assert_allclose(got, step(parts, x, np.full(10, 0.1)), rtol=1e-10)
    assert np.isfinite([stepper.velocity(state) for state in x]).all()


@pytest.mark.parametrize("d", [2, 3])
def test_where_splines_end(d):
    """At +-B and beside it, where a spline becomes the identity, and with one bin for all."""
    parts = dynamics(d, emission="spline", n_layers=1)
    point, bound = point_flow(parts.flow), parts.flow.bound
    rotation = parts.flow.arrays["rotation"][0]
    for value in (-bound, -np.nextafter(bound, 0), np.nextafter(bound, 0), bound, 1.5 * bound):
        u = np.full(d, 0.3)
        u[-1] = value
        z = (rotation.T @ u).tolist()
        y, dy = point.push_forward(z, [1.0] * d)
        expected = parts.flow.push_forward(np.array([z]), np.ones((1, d)))
        np.testing.assert_allclose([y, dy], np.concatenate(expected), rtol=0, atol=1e-12)
        np.testing.assert_allclose(point.forward(z), y, rtol=0, atol=1e-14)
        np.testing.assert_allclose(point.inverse(y), z, rtol=0, atol=1e-13)


def test_the_goal_stays():
    parts = dynamics(2)
    stepper = RealTimeStepper(parts)
    np.testing.assert_allclose(stepper.step(parts.origin, 1.0), parts.origin, rtol=0, atol=1e-11)
    np.testing.assert_allclose(stepper.velocity(parts.origin), 0, atol=1e-11)


def test_the_centre_of_a_cycle_leaves_along_the_first_axis():
    parts = dynamics(3, cycle_latent(3))
    centre = (parts.flow.forward(np.zeros((1, 3))) @ parts.frame.T + parts.origin)[0]
    z = [0.0, 0.0, 0.0]
    stepper = RealTimeStepper(parts)
    np.testing.assert_allclose(stepper._rate(z), parts.latent.rate(np.zeros((1, 3)))[0])
    np.testing.assert_allclose(
        stepper._propagate(z, 0.3), parts.latent.propagate(np.zeros((1, 3)), np.array([0.3]))[0]
    )
    assert np.isfinite(stepper.step(centre, 0.1)).all()


@pytest.mark.parametrize(
    "drift",
    [
        [[-3.0, 0.0], [0.0, -3.0]],  # equal eigenvalues
        [[-3.0, 1.0], [0.0, -3.0]],  # defective
        [[-3.0, 1.0], [-1.0, -3.0]],  # complex
        [[-4.0, 0.5], [0.5, -0.5]],  # real
        [[-3.0, 1e-6], [-1e-6, -3.0]],  # nearly equal
        [[-1.0, 0.5, 0.0], [0.0, -1.0, 0.5], [0.0, 0.0, -1.0]],  # defective, in space
    ],
)
def test_propagator(drift):
    propagate, rate = linear(np.array(drift))
    z = [1.0, -2.0, 0.5][: len(drift)]
    for t in (0.0, 1e-9, 1e-3, 2e-3, 0.1, 1.0, 5.0, 300.0):
        expected = scipy.linalg.expm(np.array(drift) * t) @ z
        np.testing.assert_allclose(propagate(z, t), expected, rtol=0, atol=1e-13)
    np.testing.assert_allclose(rate(z), np.array(drift) @ z, rtol=0, atol=1e-14)


def test_threads_wait_and_copies_have_their_own():
    parts = dynamics(2)
    stepper = RealTimeStepper(parts)
    x = states(parts, n=200)
    alone = [stepper.step(state, 0.1) for state in x]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda state: stepper.step(state, 0.1), x))
    np.testing.assert_array_equal(together, alone)
    for other in (copy.deepcopy(stepper), pickle.loads(pickle.dumps(stepper))):
        np.testing.assert_array_equal(other.step(x[0], 0.1), alone[0])
        assert other._lock is not stepper._lock
