"""LWR against weighted least squares written out, and where its bandwidth comes from."""

import numpy as np
import pytest

from iflow_gym.baselines.lwr import BANDWIDTHS, LWR, LocalFits, choose_bandwidth
from iflow_gym.datasets.lasa import load_lasa


def direct(x, samples, values, ridge):
    """The fit at one position by an augmented least-squares problem, bandwidth 1."""
    weights = np.exp(-0.5 * ((samples - x) ** 2).sum(axis=1))
    design = np.hstack([np.ones((len(samples), 1)), samples - x])
    root = np.sqrt(weights)[:, None]
    penalty = np.sqrt(ridge * weights.sum()) * np.eye(3)[1:]
    matrix = np.vstack([root * design, penalty])
    right = np.vstack([root * values, np.zeros((2, values.shape[1]))])
    return np.linalg.lstsq(matrix, right, rcond=None)[0][0]


@pytest.mark.parametrize("ridge", [1e-3, 1.0])
def test_it_is_weighted_least_squares(ridge):
    rng = np.random.default_rng(0)
    samples, values = rng.normal(size=(40, 2)), rng.normal(size=(40, 2))
    asked = rng.uniform(-2, 2, size=(20, 2))
    expected = [direct(x, samples, values, ridge) for x in asked]
    np.testing.assert_allclose(LocalFits(samples, values, ridge)(asked), expected, atol=1e-9)


def test_an_affine_field_is_found_exactly_without_a_penalty():
    rng = np.random.default_rng(0)
    samples = rng.normal(size=(60, 2))
    slope, offset = np.array([[-1.0, 2.0], [0.5, -3.0]]), np.array([1.0, -2.0])
    asked = rng.uniform(-1, 1, size=(10, 2))
    found = LocalFits(samples, samples @ slope.T + offset, 1e-12)(asked)
    np.testing.assert_allclose(found, asked @ slope.T + offset, atol=1e-7)


def test_far_away_it_goes_on_as_the_nearest_sample_does():
    system = LWR().fit(load_lasa("Angle"), seed=0)
    far = system.positions_[0] + [-1e4, 3e3]
    nearest = np.linalg.norm(system.positions_ - far, axis=1).argmin()
    np.testing.assert_allclose(system.velocity(far), system.velocities_[nearest], rtol=0.05)


def test_weights_that_all_underflow_are_relative_to_the_nearest_samples():
    rng = np.random.default_rng(0)
    samples, values = rng.normal(size=(40, 2)), rng.normal(size=(40, 2))
    fits = LocalFits(samples, values, 1e-3)
    for distance in (30.0, 60.0, 1e3):  # weights of about 1e-196, 0 and 0
        asked = distance * np.array([[0.6, 0.8], [-0.8, 0.6]])
        squares = 0.5 * ((samples - asked[:, None]) ** 2).sum(axis=2)
        weights = np.exp(squares.min(axis=1, keepdims=True) - squares)
        weights /= weights.sum(axis=1, keepdims=True)
        for x, w, found in zip(asked, weights, fits(asked), strict=True):
            mean_x, mean_v = w @ samples, w @ values
            around = samples - mean_x
            covariance = (w * around.T) @ around + 1e-3 * np.eye(2)
            slopes = np.linalg.solve(covariance, (w * around.T) @ (values - mean_v))
            np.testing.assert_allclose(found, mean_v + (x - mean_x) @ slopes, rtol=1e-6)


def test_where_distances_have_no_digits_left_it_is_finite():
    rng = np.random.default_rng(0)
    samples, values = rng.normal(size=(40, 2)), rng.normal(size=(40, 2))
    fits = LocalFits(1e10 + samples, values, 1e-3)
    assert np.isfinite(fits(1e10 + rng.normal(size=(20, 2)))).all()


def test_the_bandwidth_has_the_least_error_on_what_is_left_out():
    """A wave that all demonstrations show asks for a small one, noise for a large one."""
    rng = np.random.default_rng(0)
    s = np.linspace(0, 1, 200)
    x = [np.column_stack([s, 0.02 * i + 0 * s]) for i in range(5)]
    wave = [np.column_stack([np.sin(40 * s), np.cos(40 * s)])] * 5
    noise = [np.ones((200, 2)) + rng.normal(size=(200, 2)) for _ in range(5)]
    assert choose_bandwidth(x, wave, 1.0, 1.0) < 0.03
    assert choose_bandwidth(x, noise, 1.0, 1.0) >= BANDWIDTHS[-3]


def test_the_bandwidth_is_in_diagonals_of_the_box():
    shown = load_lasa("Angle")
    system = LWR(bandwidth=0.1).fit(shown, seed=0)
    assert system.bandwidth_ == pytest.approx(0.1 * shown.bounding_box.diagonal)


def test_settings_that_make_no_sense_are_refused():
    for settings, said in (
        ({"bandwidth": 0.0}, "bandwidth > 0 or None"),
        ({"ridge": 0.0}, "ridge > 0"),
        ({"n_samples": 1}, "n_samples >= 2"),
    ):
        with pytest.raises(ValueError, match=f"Expected {said}"):
            LWR(**settings)
