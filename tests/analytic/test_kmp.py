"""KMP against Gaussian process regression, which its mean is, and its points to pass through."""

import numpy as np
import pytest
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF

from iflow_gym.baselines.kmp import (
    KMP,
    LEAST_VARIANCE,
    LENGTHS,
    STRENGTHS,
    VIA_VARIANCE,
    choose_kernel,
    kernel,
    reference,
    solved,
)
from iflow_gym.datasets.lasa import load_lasa


def test_with_isotropic_covariances_it_is_gaussian_process_regression():
    rng = np.random.default_rng(0)
    grid = np.linspace(0, 1, 30)
    means = np.column_stack([np.sin(5 * grid), np.cos(3 * grid)])
    variances = rng.uniform(0.01, 0.1, size=30)
    start, strength, length = np.array([0.4, 0.7]), 2.0, 0.15
    alpha, lead = solved(means, variances[:, None, None] * np.eye(2), length, strength)
    noise = strength * (variances + LEAST_VARIANCE)
    noise[[0, -1]] = VIA_VARIANCE
    targets = means.copy()
    targets[0], targets[-1] = start, 0.0
    process = GaussianProcessRegressor(RBF(length), alpha=noise, optimizer=None)
    expected = process.fit(grid[:, None], targets).predict(grid[:, None])
    made = kernel(grid, grid, length) @ (alpha + lead @ start)
    np.testing.assert_allclose(made, expected, atol=1e-6)


def test_it_is_the_formula_with_full_covariances():
    """The mean prediction of IJRR 2019, written out with block matrices."""
    rng = np.random.default_rng(0)
    means, roots = rng.normal(size=(6, 2)), rng.normal(size=(6, 2, 2))
    covariances = roots @ np.swapaxes(roots, 1, 2)
    alpha, lead = solved(means, covariances, 0.3, 0.7)
    grid, start = np.linspace(0, 1, 6), np.array([0.3, -0.2])
    blocks = np.zeros((12, 12))
    mu = means.copy()
    mu[0], mu[-1] = start, 0.0
    for n in range(6):
        sigma = covariances[n] + LEAST_VARIANCE * np.eye(2)
        if n in (0, 5):
            sigma = VIA_VARIANCE / 0.7 * np.eye(2)
        blocks[2 * n : 2 * n + 2, 2 * n : 2 * n + 2] = 0.7 * sigma
    full = np.kron(kernel(grid, grid, 0.3), np.eye(2)) + blocks
    expected = np.linalg.solve(full, mu.ravel()).reshape(6, 2)
    np.testing.assert_allclose(alpha + lead @ start, expected, rtol=1e-6, atol=1e-6)


def test_it_begins_where_it_is_and_ends_at_the_goal():
    primitive, shown = KMP().fit(load_lasa("Angle"), seed=0), load_lasa("Angle")
    size = shown.bounding_box.diagonal
    for start in (shown.starts[0], [20.0, -30.0]):
        state = primitive.begin(start)
        first = primitive._reference(state, np.zeros(1))[0] + shown.goal
        last = primitive._reference(state, np.array([1 - 1e-9]))[0] + shown.goal
        np.testing.assert_allclose(first, start, atol=3e-3 * size)
        np.testing.assert_allclose(last, shown.goal, atol=1e-3 * size)


def test_the_reference_is_mean_and_covariance_at_equal_phases():
    paths = np.random.default_rng(0).normal(size=(5, 8, 2))
    means, covariances = reference(paths)
    np.testing.assert_allclose(means[3], paths[:, 3].mean(axis=0))
    np.testing.assert_allclose(covariances[3], np.cov(paths[:, 3].T, bias=True))


def test_the_kernel_has_the_least_error_on_what_is_left_out():
    s = np.linspace(0, 1, 40)
    rng = np.random.default_rng(0)
    fast = np.stack([np.column_stack([np.sin(25 * s), np.cos(25 * s)])] * 3)
    fast = fast * (1 - s)[:, None] * (1 + 0.01 * rng.normal(size=(3, 1, 1)))
    assert choose_kernel(fast, None, None)[0] < LENGTHS[-1]
    assert choose_kernel(fast, 0.3, 2.0) == (0.3, 2.0)
    assert choose_kernel(fast, None, 2.0)[1] == 2.0
    length, strength = choose_kernel(fast[:1], None, None)
    assert length in LENGTHS
    assert strength in STRENGTHS


def test_settings_that_make_no_sense_are_refused():
    for settings, said in (
        ({"n_reference": 3}, "n_reference >= 4"),
        ({"length_scale": 0.0}, "a finite length_scale > 0"),
        ({"strength": -1.0}, "a finite strength > 0"),
        ({"feedback": np.inf}, "a finite feedback > 0"),
    ):
        with pytest.raises(ValueError, match=f"Expected {said}"):
            KMP(**settings)
