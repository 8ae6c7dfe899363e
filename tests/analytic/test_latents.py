"""The linear latent in torch and NumPy against scipy, simulation and a Markov process's laws."""

import numpy as np
import pytest
import scipy.linalg
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from iflow_gym.baselines import ornstein_uhlenbeck
from iflow_gym.baselines.imitation_flow.fields.latents import LinearField
from iflow_gym.baselines.imitation_flow.latent import (
    LinearLatent,
    propagator,
    stationary_covariance,
    transition,
)
from iflow_gym.baselines.imitation_flow.sde import euler_maruyama

DIMENSIONS = pytest.mark.parametrize("n_dims", [2, 3, 6])


def random_latent(n_dims, n_models=3, seed=0, dtype=torch.float64, spread=1.0):
    latent = LinearLatent(n_models, n_dims, min_decay=0.05).to(dtype)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for p in latent.parameters():
            noise = torch.randn(p.shape, generator=generator, dtype=torch.float64)
            p += spread * noise.to(dtype)
    return latent


def states(*shape, seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64).to(dtype)


def spans(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return 0.01 + torch.rand(*shape, generator=generator, dtype=torch.float64)


def field_of(latent, model=0):
    return LinearField(**latent.arrays(model))


@DIMENSIONS
def test_propagation_is_the_matrix_exponential(n_dims):
    latent, z, times = random_latent(n_dims), states(3, n_dims, 5), spans(3, 5)
    times[:, 0] = 0.0
    reached = latent.propagate(z, times).detach().numpy()
    for m in range(3):
        drift = latent.arrays(m)["drift"]
        for i, t in enumerate(times[m].tolist()):
            expected = scipy.linalg.expm(drift * t) @ z[m, :, i].numpy()
            np.testing.assert_allclose(reached[m, :, i], expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("gap", [0.0, 1e-12, 1e-7, 1e-4, 0.0099, 0.0101, 0.3, 40.0])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_the_plane_has_no_seam_where_eigenvalues_meet(gap, sign):
    """A = -50 I + C with C^2 = sign gap^2 I: real, equal and complex eigenvalues, any horizon."""
    drift = np.array([[-50.0, gap], [sign * gap, -50.0]])
    times = np.array([1e-9, 1e-3, 0.1, 1.0, 30.0])
    expected = np.stack([scipy.linalg.expm(drift * t) for t in times])
    result = propagator(torch.as_tensor(drift)[None], torch.as_tensor(times)[None])[0]
    np.testing.assert_allclose(result.numpy(), expected, rtol=1e-10, atol=1e-13)
    path = LinearField(drift, np.eye(2)).path(np.eye(2), times)
    np.testing.assert_allclose(path, expected.transpose(2, 0, 1), rtol=1e-10, atol=1e-13)


def test_long_horizons_do_not_overflow_in_single_precision():
    drift = torch.tensor([[[-200.0, 150.0], [150.0, -200.0]]], requires_grad=True)
    result = propagator(drift, torch.tensor([[1.0, 10.0, 1000.0]]))
    result.sum().backward()
    assert torch.isfinite(result).all()
    assert torch.isfinite(drift.grad).all()


@given(st.integers(0, 10_000), st.sampled_from([2, 3, 6]), st.floats(0, 3), st.floats(0, 3))
@settings(max_examples=30, deadline=None)
def test_two_horizons_in_turn_are_their_sum(seed, n_dims, t, s):
    latent, z = random_latent(n_dims, 1, seed), states(1, n_dims, 4, seed=seed)

    def reach(z, t):
        return latent.propagate(z, torch.full((1, 4), t, dtype=torch.float64))

    torch.testing.assert_close(reach(reach(z, t), s), reach(z, t + s), rtol=1e-9, atol=1e-12)


@DIMENSIONS
def test_stationary_covariance_and_transition_against_scipy(n_dims):
    latent = random_latent(n_dims)
    times = torch.tensor([[1e-6, 1e-3, 0.1, 1.0, 20.0]] * 3, dtype=torch.float64)
    forward, covariance = transition(latent.drift(), latent.diffusion(), times)
    stationary = stationary_covariance(latent.drift(), latent.diffusion())
    for m in range(3):
        arrays = latent.arrays(m)
        expected = scipy.linalg.solve_continuous_lyapunov(arrays["drift"], -arrays["diffusion"])
        np.testing.assert_allclose(stationary[m].detach(), expected, rtol=1e-9, atol=1e-10)
        for k, t in enumerate(times[m].tolist()):
            f, q = ornstein_uhlenbeck.transition(arrays["drift"], arrays["diffusion"], t)
            np.testing.assert_allclose(forward[m, k].detach(), f, rtol=0, atol=1e-11)
            # The difference of stationary covariances carries their rounding, and the floor.
            np.testing.assert_allclose(
                covariance[m, k].detach(), q, rtol=1e-9, atol=1e-13 * np.abs(expected).max()
            )


@DIMENSIONS
def test_the_covariance_is_propagated_on_both_sides(n_dims):
    """F P F^T, not F P F as in the authors' code: that is neither symmetric nor a covariance."""
    latent = random_latent(n_dims)
    _, covariance = transition(
        latent.drift(), latent.diffusion(), torch.full((3, 1), 0.2, dtype=torch.float64)
    )
    torch.testing.assert_close(covariance, covariance.mT, rtol=0, atol=0)
    assert (torch.linalg.eigvalsh(covariance) > 0).all()


@DIMENSIONS
def test_discrete_stationary_covariance_has_the_inverse_that_the_paper_lost(n_dims):
    """Eq. (8) with the inverse, vec P = (I - F (x) F)^-1 vec Sigma, for an exact step: the same P.

    As printed, without the inverse, it is not.
    """
    arrays = random_latent(n_dims).arrays(0)
    f, sigma = ornstein_uhlenbeck.transition(arrays["drift"], arrays["diffusion"], 0.3)
    system = np.eye(n_dims**2) - np.kron(f, f)
    expected = scipy.linalg.solve_continuous_lyapunov(arrays["drift"], -arrays["diffusion"])
    solved = np.linalg.solve(system, sigma.ravel()).reshape(n_dims, n_dims)
    np.testing.assert_allclose(solved, expected, rtol=1e-9, atol=1e-10)
    printed = (sigma.ravel() @ system).reshape(n_dims, n_dims)
    assert np.abs(printed - expected).max() > 0.1 * np.abs(expected).max()


@DIMENSIONS
def test_densities_against_torch_and_the_numpy_twin(n_dims):
    latent, times = random_latent(n_dims), spans(3, 6)
    z0, z1 = states(3, n_dims, 6), states(3, n_dims, 6, seed=1)
    forward, covariance = transition(latent.drift(), latent.diffusion(), times)
    mean = torch.einsum("mnij,mjn->mni", forward, z0)
    normal = torch.distributions.MultivariateNormal
    expected = normal(mean, covariance).log_prob(z1.mT)
    log_prob = latent.transition_log_prob(z0, z1, times)
    torch.testing.assert_close(log_prob, expected, rtol=1e-9, atol=1e-9)
    stationary = latent.stationary_log_prob(z0)
    for m in range(3):
        field, (before, after) = field_of(latent, m), (z0[m].numpy().T, z1[m].numpy().T)
        reached = latent.propagate(z0, times)[m].detach().numpy().T
        np.testing.assert_allclose(field.propagate(before, times[m].numpy()), reached, atol=1e-10)
        np.testing.assert_allclose(
            field.stationary_log_prob(before), stationary[m].detach(), rtol=1e-10, atol=1e-10
        )
        twin = [field.log_prob(before[i], after[i], t) for i, t in enumerate(times[m].tolist())]
        np.testing.assert_allclose(twin, log_prob[m].detach(), rtol=1e-10, atol=1e-10)


@DIMENSIONS
def test_backward_density_is_the_papers_as_printed(n_dims):
    """N(F^-1 z', F^-1 Sigma F^-T). The horizons are short: its F^-1 is ill-conditioned."""
    latent, times = random_latent(n_dims), 0.02 * spans(3, 6)
    z0, z1 = states(3, n_dims, 6), states(3, n_dims, 6, seed=1)
    forward, covariance = transition(latent.drift(), latent.diffusion(), times)
    back = torch.linalg.inv(forward)
    printed = torch.distributions.MultivariateNormal(
        torch.einsum("mnij,mjn->mni", back, z1), back @ covariance @ back.mT
    )
    backward = latent.backward_log_prob(z0, z1, times)
    torch.testing.assert_close(backward, printed.log_prob(z0.mT), rtol=1e-7, atol=1e-7)


@DIMENSIONS
def test_shared_horizons_are_the_same_densities(n_dims):
    latent, times = random_latent(n_dims), spans(3, 4)
    z0, z1 = states(3, n_dims, 4, 5), states(3, n_dims, 4, 5, seed=1)
    apart = times[..., None].expand(3, 4, 5).flatten(1)
    for method in (latent.transition_log_prob, latent.backward_log_prob):
        flat = method(z0.flatten(2), z1.flatten(2), apart)
        torch.testing.assert_close(method(z0, z1, times).flatten(1), flat)
    reached = latent.propagate(z0, times).flatten(2)
    torch.testing.assert_close(reached, latent.propagate(z0.flatten(2), apart))


@DIMENSIONS
def test_backward_is_bayes_rule_under_a_flat_prior(n_dims):
    """log p(z0|z1) - log p(z1|z0) does not depend on the states: it is log |det F| = t tr A."""
    latent, times = random_latent(n_dims), spans(3, 1).expand(3, 6)
    z0, z1 = states(3, n_dims, 6), states(3, n_dims, 6, seed=1)
    forward, backward = (
        f(z0, z1, times) for f in (latent.transition_log_prob, latent.backward_log_prob)
    )
    trace = latent.drift().diagonal(dim1=1, dim2=2).sum(1)
    torch.testing.assert_close(backward - forward, trace[:, None] * times, atol=1e-9, rtol=1e-9)


def test_chapman_kolmogorov_by_quadrature():
    """The integral over the state in between of two densities is the density of the sum."""
    field = field_of(random_latent(2, seed=3, spread=0.5))
    axis = np.linspace(-3, 3, 241)
    middle = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    cell = (axis[1] - axis[0]) ** 2
    start, end = np.array([0.6, -0.4]), np.array([0.3, 0.1])
    first, second = field.log_prob(start, middle, 0.2), field.log_prob(middle, end, 0.3)
    assert np.exp(first).sum() * cell == pytest.approx(1.0, abs=1e-9)
    assert np.exp(field.stationary_log_prob(middle)).sum() * cell == pytest.approx(1.0, abs=1e-6)
    assert np.log(np.exp(first + second).sum() * cell) == pytest.approx(
        field.log_prob(start, end, 0.5), abs=1e-9
    )


@DIMENSIONS
@pytest.mark.parametrize("time", [1e-7, 1e-4, 1.0, 100.0])
def test_single_precision_over_short_and_long_horizons(n_dims, time):
    """Against float64: the residual's own rounding is 6e-8 / (K sqrt(t)) of a deviation."""
    single, double = random_latent(n_dims, dtype=torch.float32), random_latent(n_dims)
    double.load_state_dict(single.state_dict())
    times = torch.full((3, 8), time, dtype=torch.float64)
    z0 = states(3, n_dims, 8, dtype=torch.float32)
    noise = 0.3 * np.sqrt(min(time, 1.0)) * states(3, n_dims, 8, seed=1)
    z1 = (double.propagate(z0.double(), times) + noise).detach().float()
    z0.requires_grad_()
    value = single.transition_log_prob(z0, z1, times.float())
    assert value.dtype == torch.float32
    value.sum().backward()
    assert all(torch.isfinite(p.grad).all() for p in [z0, *single.parameters()])
    if time >= 1e-4:
        expected = double.transition_log_prob(z0.double(), z1.double(), times)
        torch.testing.assert_close(value.double(), expected, rtol=2e-2, atol=2e-2)


def test_transition_against_euler_maruyama():
    """40 000 draws: standard errors are 1/200 of a deviation, and the step's bias is below them."""
    field = LinearField(
        np.array([[-2.0, 1.5, 0.0], [-1.0, -3.0, 0.5], [0.3, 0.0, -1.5]]),
        np.array([[0.3, 0.1, 0.0], [0.1, 0.5, 0.0], [0.0, 0.0, 0.2]]),
    )
    z0 = np.tile([1.0, -0.5, 0.3], (40_000, 1))
    rng = np.random.default_rng(0)
    drawn = euler_maruyama(field.rate, field.diffusion, z0, 0.5, 200, rng)
    forward, covariance = ornstein_uhlenbeck.transition(field.drift, field.covariance_rate, 0.5)
    for cloud in (drawn, field.sample(z0, 0.5, rng)):
        np.testing.assert_allclose(cloud.mean(0), forward @ z0[0], atol=0.01)
        np.testing.assert_allclose(np.cov(cloud.T), covariance, atol=0.005)


@DIMENSIONS
def test_path_is_propagation_at_every_time(n_dims):
    field, z = field_of(random_latent(n_dims)), states(4, n_dims).numpy()
    for times in (np.linspace(0.1, 2.0, 20), np.array([0.0, 0.1, 0.5]), np.array([0.7])):
        path = field.path(z, times)
        for k, t in enumerate(times):
            np.testing.assert_allclose(path[:, k], field.propagate(z, np.full(4, t)), atol=1e-12)


@DIMENSIONS
def test_rate_and_lyapunov_rate_are_derivatives(n_dims):
    field, z, h = field_of(random_latent(n_dims)), states(5, n_dims).numpy(), 1e-6
    ahead, behind = (field.propagate(z, np.full(5, s * h)) for s in (1, -1))
    np.testing.assert_allclose(field.rate(z), (ahead - behind) / (2 * h), rtol=1e-6, atol=1e-6)
    slope = (field.lyapunov(ahead) - field.lyapunov(behind)) / (2 * h)
    np.testing.assert_allclose(field.lyapunov_rate(z), slope, rtol=1e-5, atol=1e-6)
    assert (field.lyapunov_rate(z) <= -2 * field.min_decay * field.lyapunov(z) + 1e-12).all()


@pytest.mark.parametrize(
    ("drift", "diffusion", "message"),
    [
        (np.eye(2), np.eye(2), "negative definite, got the eigenvalue 1"),
        (np.array([[-1.0, 9.0], [0.0, -1.0]]), np.eye(2), "negative definite, got"),
        (-np.eye(2), -np.eye(2), "a positive definite diffusion, got"),
        (-np.eye(2), np.array([[1.0, 0.5], [0.0, 1.0]]), "a symmetric diffusion, got"),
        (-np.eye(2), np.eye(3), r"diffusion of shape \(2, 2\), got \(3, 3\)"),
        (-np.ones((2, 3)), np.eye(2), r"drift of shape \(2, 2\), got \(2, 3\)"),
        (np.array([[-1.0, np.nan], [0.0, -1.0]]), np.eye(2), "finite floating numbers in drift"),
        (-np.eye(2).astype(complex), np.eye(2), "finite floating numbers in drift"),
    ],
)
def test_numbers_without_the_proof_are_refused(drift, diffusion, message):
    with pytest.raises(ValueError, match=f"expected .*{message}"):
        LinearField(drift, diffusion)
