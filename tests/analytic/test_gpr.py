"""GPR against scikit-learn's exact posterior, and what it says where there are no data."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from iflow_gym.baselines.gpr import GPR, maximise_likelihood
from iflow_gym.baselines.subsets import evenly
from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.demonstrations import Demonstrations


def thinned(every=50, n=3):
    full = load_lasa("Sshape").subset(range(n))
    return Demonstrations.from_arrays(
        [p[::-1][::every][::-1] for p in full.positions],
        velocities=[v[::-1][::every][::-1] for v in full.velocities],
        dt=[h * every for h in full.dt],
        goal=full.goal,
    )


def exact(system, x, v):
    kernel = ConstantKernel(system.signal_variance_) * RBF(system.length_scales_) + WhiteKernel(
        system.noise_variance_
    )
    return GaussianProcessRegressor(kernel, optimizer=None).fit(x, v)


def test_with_every_sample_for_an_inducing_one_the_posterior_is_exact():
    shown = thinned()
    x, v = np.concatenate(shown.positions), np.concatenate(shown.velocities)
    system = GPR(n_inducing=len(x)).fit(shown, seed=0)
    asked = np.random.default_rng(0).uniform(-40, 40, size=(50, 2))
    expected = exact(system, x, v).predict(asked)
    np.testing.assert_allclose(
        system.velocity(asked), expected, rtol=0, atol=1e-4 * np.abs(expected).max()
    )


def test_few_inducing_positions_come_close_to_the_exact_posterior():
    shown = thinned(every=10)
    x, v = np.concatenate(shown.positions), np.concatenate(shown.velocities)
    system = GPR(n_inducing=100).fit(shown, seed=0)
    expected = exact(system, x, v).predict(x)
    error = np.sqrt(np.mean((system.velocity(x) - expected) ** 2))
    assert error < 0.02 * np.sqrt(np.mean(v**2))


def test_the_hyperparameters_have_the_greatest_marginal_likelihood():
    shown = thinned()
    x, v = np.concatenate(shown.positions) / 20, np.concatenate(shown.velocities) / 15
    signal, scales, noise = maximise_likelihood(x, v)

    def likelihood(factors):
        kernel = ConstantKernel(signal * factors[0]) * RBF(scales * factors[1]) + WhiteKernel(
            noise * factors[2]
        )
        process = GaussianProcessRegressor(kernel, optimizer=None).fit(x, v)
        return process.log_marginal_likelihood_value_

    best = likelihood([1, 1, 1])
    for k in range(3):
        for factor in (0.8, 1.25):
            assert likelihood([factor if i == k else 1 for i in range(3)]) < best


def test_the_density_is_the_gaussian_of_mean_and_variance():
    system = GPR().fit(load_lasa("Angle"), seed=0)
    x = load_lasa("Angle").positions[0][::100]
    x_next, dt = x + 0.1, 0.05
    expected = [
        multivariate_normal(a + dt * system.velocity(a), dt**2 * s * np.eye(2)).logpdf(b)
        for a, b, s in zip(x, x_next, system.variance(x), strict=True)
    ]
    np.testing.assert_allclose(system.log_prob(x, x_next, dt), expected)


def test_the_variance_is_the_noise_at_inducing_positions_and_the_priors_far_away():
    system = GPR(n_inducing=20).fit(load_lasa("Angle"), seed=0)
    at = system.variance(system.inducing_ + system.goal_)
    np.testing.assert_allclose(at, system.noise_variance_, rtol=1e-3)
    far = system.variance(np.array([[1e5, 0.0]]))
    np.testing.assert_allclose(far, system.noise_variance_ + system.signal_variance_)


def test_far_away_it_comes_to_rest():
    system = GPR().fit(load_lasa("Angle"), seed=0)
    np.testing.assert_allclose(system.velocity([1e4, 1e4]), 0.0, atol=1e-12)


def test_samples_are_taken_evenly_with_both_ends():
    samples = np.arange(10.0)[:, None]
    np.testing.assert_array_equal(evenly(samples, 4)[:, 0], [0, 3, 6, 9])
    np.testing.assert_array_equal(evenly(samples, 99), samples)


@pytest.mark.parametrize("field", ["n_inducing", "likelihood_samples"])
def test_settings_that_make_no_sense_are_refused(field):
    with pytest.raises(ValueError, match=f"Expected {field} >= 2, got 1"):
        GPR(**{field: 1})
