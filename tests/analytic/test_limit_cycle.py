"""The latent limit cycle in torch and NumPy against closed forms, simulation and quadrature."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from iflow_gym.baselines.imitation_flow.fields.latents import CycleField
from iflow_gym.baselines.imitation_flow.limit_cycle import LimitCycleLatent, wrapped_normal
from iflow_gym.baselines.imitation_flow.sde import euler_maruyama

DIMENSIONS = pytest.mark.parametrize("n_dims", [2, 3, 6])


def random_latent(n_dims, n_models=3, seed=0, dtype=torch.float64):
    latent = LimitCycleLatent(n_models, n_dims, min_decay=0.05).to(dtype)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for p in latent.parameters():
            p += 0.4 * torch.randn(p.shape, generator=generator, dtype=torch.float64).to(dtype)
    return latent


def states(*shape, seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64).to(dtype)


def spans(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return 0.01 + torch.rand(*shape, generator=generator, dtype=torch.float64)


def cycle(noise=(0.2, 0.3), decay=(2.0,), rate=5.0, radius=1.0):
    return CycleField(np.array(decay), np.array([rate]), np.array([radius]), np.array(noise))


def grid(half, n):
    """Return the centres of n x n cells with the origin at a corner, and a cell's area."""
    assert n % 2 == 0
    axis = (np.arange(n) + 0.5) / n * 2 * half - half
    points = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    return points, (2 * half / n) ** 2


class TestMean:
    @DIMENSIONS
    def test_propagation_is_the_polar_solution_and_the_numpy_twin(self, n_dims):
        latent, z, times = random_latent(n_dims), states(3, n_dims, 7), spans(3, 7)
        reached = latent.propagate(z, times).detach().numpy()
        for m in range(3):
            arrays, (before, t) = latent.arrays(m), (z[m].numpy().T, times[m].numpy())
            rho = np.hypot(before[:, 0], before[:, 1])
            phase = np.arctan2(before[:, 1], before[:, 0]) + arrays["rate"] * t
            kept, radius = np.exp(-arrays["decay"] * t[:, None]), arrays["radius"]
            rho = radius + kept[:, 0] * (rho - radius)
            plane = np.stack([rho * np.cos(phase), rho * np.sin(phase)], axis=1)
            expected = np.concatenate([plane, kept[:, 1:] * before[:, 2:]], axis=1)
            np.testing.assert_allclose(reached[m].T, expected, atol=1e-12)
            field = CycleField(**arrays)
            np.testing.assert_allclose(field.propagate(before, t), expected, atol=1e-12)
            path = field.path(before, t)
            np.testing.assert_allclose(path[np.arange(7), np.arange(7)], expected, atol=1e-12)

    @given(st.integers(0, 10_000), st.sampled_from([2, 3, 6]), st.floats(0, 3), st.floats(0, 3))
    @settings(max_examples=30, deadline=None)
    def test_two_horizons_in_turn_are_their_sum(self, seed, n_dims, t, s):
        latent, z = random_latent(n_dims, 1, seed), states(1, n_dims, 4, seed=seed)

        def reach(z, t):
            return latent.propagate(z, torch.full((1, 4), t, dtype=torch.float64))

        torch.testing.assert_close(reach(reach(z, t), s), reach(z, t + s), rtol=1e-9, atol=1e-10)

    @DIMENSIONS
    def test_rate_and_lyapunov_rate_are_derivatives(self, n_dims):
        field = CycleField(**random_latent(n_dims).arrays(0))
        z, h = states(20, n_dims).numpy(), 1e-6
        ahead = field.propagate(z, np.full(20, h))
        np.testing.assert_allclose(field.rate(z), (ahead - z) / h, rtol=1e-4, atol=1e-4)
        slope = (field.lyapunov(ahead) - field.lyapunov(z)) / h
        np.testing.assert_allclose(field.lyapunov_rate(z), slope, rtol=1e-3, atol=1e-4)
        assert (field.lyapunov_rate(z) <= -2 * field.min_decay * field.lyapunov(z)).all()

    def test_a_hopf_oscillator_is_this_cycle_inverted_at_a_circle(self):
        """r' = mu r - r^3, theta' = omega has w = r^-2 with w' = -2 mu (w - 1 / mu): linear.

        So (r, theta) -> (r^-2, theta), which turns the punctured plane inside out, carries the Hopf
        oscillator onto our cycle with a = 2 mu, rho* = 1 / mu, b = omega exactly. No map that
        keeps the inside inside does: our radius leaves 0 in finite time, a Hopf oscillator's never.
        """
        mu, omega = 1.7, 4.0
        field = cycle(decay=(2 * mu,), rate=omega, radius=1 / mu)
        rng = np.random.default_rng(0)
        r0, theta0, t = (
            rng.uniform(0.1, 3, 50),
            rng.uniform(-np.pi, np.pi, 50),
            rng.uniform(0, 2, 50),
        )
        grown = np.exp(2 * mu * t)
        r = np.sqrt(mu * grown * r0**2 / (mu + (grown - 1) * r0**2))  # the textbook's solution

        def carry(r, theta):
            return np.stack([np.cos(theta), np.sin(theta)], axis=1) / r[:, None] ** 2

        reached = field.propagate(carry(r0, theta0), t)
        np.testing.assert_allclose(reached, carry(r, theta0 + omega * t), rtol=1e-10, atol=1e-12)

    def test_period_and_orbit(self):
        field = cycle(decay=(2.0, 3.0), noise=(0.1, 0.1, 0.1), rate=-5.0, radius=1.5)
        far = field.propagate(np.array([[9.0, 1.0, 4.0], [1e-3, 0.0, -2.0]]), np.full(2, 20.0))
        np.testing.assert_allclose(np.hypot(far[:, 0], far[:, 1]), 1.5, atol=1e-12)
        again = field.propagate(far, np.full(2, 2 * np.pi / 5))
        np.testing.assert_allclose(again, far, atol=1e-12)
        quarter = field.propagate(np.array([[1.5, 0.0, 0.0]]), np.array([np.pi / 10]))
        np.testing.assert_allclose(quarter, [[0.0, -1.5, 0.0]], atol=1e-12)

    def test_the_origin_leaves_along_the_first_axis(self):
        latent, field = (
            LimitCycleLatent(1, 2, min_decay=0.05),
            cycle(rate=2 * math.pi, decay=(3.0,)),
        )
        z = torch.zeros(1, 2, 1, requires_grad=True)
        reached = latent.propagate(z, torch.full((1, 1), 0.25))
        twin = field.propagate(np.zeros((1, 2)), np.array([0.25]))
        np.testing.assert_allclose(reached[0, :, 0].detach(), twin[0], atol=1e-6)
        np.testing.assert_allclose(field.rate(np.zeros((1, 2))), [[3.0, 0.0]], atol=1e-12)
        times = torch.full((1, 1), 0.25)
        (reached.sum() + latent.transition_log_prob(z, z, times).sum()).backward()
        assert torch.isfinite(z.grad).all()


class TestDensity:
    @pytest.mark.parametrize("deviation", [0.01, 0.3, 1.0, 1.99, 2.01, 3.0, 10.0])
    def test_wrapped_normal_is_the_sum_over_windings(self, deviation):
        angle = torch.linspace(-math.pi, math.pi, 101, dtype=torch.float64)
        variance = torch.full_like(angle, deviation**2)
        shifts = 2 * math.pi * torch.arange(-60, 61, dtype=torch.float64)
        normal = torch.distributions.Normal(0.0, torch.tensor(deviation, dtype=torch.float64))
        expected = torch.logsumexp(normal.log_prob(angle[:, None] + shifts), dim=1)
        value = wrapped_normal(angle, variance)
        torch.testing.assert_close(value, expected, rtol=1e-12, atol=1e-12)
        total = torch.trapezoid(torch.exp(value), angle).item()
        assert deviation < 0.2 or total == pytest.approx(1.0, abs=2e-4)

    @DIMENSIONS
    def test_torch_is_the_numpy_twin(self, n_dims):
        latent, times = random_latent(n_dims), spans(3, 6)
        z0, z1 = states(3, n_dims, 6), states(3, n_dims, 6, seed=1)
        values, stationary = (
            latent.transition_log_prob(z0, z1, times),
            latent.stationary_log_prob(z1),
        )
        for m in range(3):
            field, (before, after) = (
                CycleField(**latent.arrays(m)),
                (z0[m].numpy().T, z1[m].numpy().T),
            )
            twin = [field.log_prob(before[i], after[i], t) for i, t in enumerate(times[m].tolist())]
            np.testing.assert_allclose(twin, values[m].detach(), rtol=1e-10, atol=1e-10)
            np.testing.assert_allclose(
                field.stationary_log_prob(after), stationary[m].detach(), rtol=1e-10, atol=1e-10
            )

    @DIMENSIONS
    def test_shared_horizons_are_the_same_densities(self, n_dims):
        latent, times = random_latent(n_dims), spans(3, 4)
        z0, z1 = states(3, n_dims, 4, 5), states(3, n_dims, 4, 5, seed=1)
        apart = times[..., None].expand(3, 4, 5).flatten(1)
        for method in (latent.transition_log_prob, latent.backward_log_prob):
            flat = method(z0.flatten(2), z1.flatten(2), apart)
            torch.testing.assert_close(method(z0, z1, times).flatten(1), flat)
        reached = latent.propagate(z0, times).flatten(2)
        torch.testing.assert_close(reached, latent.propagate(z0.flatten(2), apart))

    @pytest.mark.parametrize("noise", [(0.2, 0.3), (1.5, 2.0)])
    @pytest.mark.parametrize("time", [0.1, 2.0])
    def test_densities_integrate_to_one(self, noise, time):
        """The wide one has a quarter of its radii beyond the origin: both signs are counted.

        Near the origin it has a pole 1/rho, of which midpoints miss about a tenth of a cell's side.
        """
        field = cycle(noise=noise, radius=0.5, rate=3.0)
        points, cell = grid(4.0, 600)
        start = np.array([0.4, 0.3])
        total = np.exp(field.log_prob(start, points, time)).sum() * cell
        assert total == pytest.approx(1.0, abs=3e-3)
        total = np.exp(field.stationary_log_prob(points)).sum() * cell
        assert total == pytest.approx(1.0, abs=3e-3)

    def test_the_backward_density_integrates_to_one_over_the_start(self):
        latent = LimitCycleLatent(1, 2, min_decay=0.05).double()
        points, cell = grid(4.0, 600)
        z0 = torch.as_tensor(points.T)[None]
        z1 = torch.tensor([0.8, 0.5], dtype=torch.float64)[None, :, None].expand_as(z0)
        times = torch.full((1, len(points)), 0.3, dtype=torch.float64)
        total = torch.exp(latent.backward_log_prob(z0, z1, times)).sum().item() * cell
        assert total == pytest.approx(1.0, abs=3e-3)

    @DIMENSIONS
    def test_backward_is_forward_under_a_flat_polar_prior(self, n_dims):
        """p(z0|z1) rho_0 exp(sum a t) = p(z1|z0) rho_1 where no radius changes its sign."""
        latent = random_latent(n_dims)
        with torch.no_grad():
            latent.log_noise[:, 0] = math.log(0.02)
        times, z0 = 0.1 * spans(3, 6), states(3, n_dims, 6)
        z0[:, :2] /= torch.linalg.norm(z0[:, :2], dim=1, keepdim=True)
        z1 = latent.propagate(z0, times).detach() + 0.02 * states(3, n_dims, 6, seed=1)
        forward, backward = (
            f(z0, z1, times) for f in (latent.transition_log_prob, latent.backward_log_prob)
        )
        rho0, rho1 = (torch.linalg.norm(z[:, :2], dim=1) for z in (z0, z1))
        expected = forward + torch.log(rho1 / rho0) - latent.decay().sum(1, keepdim=True) * times
        torch.testing.assert_close(backward, expected)

    def test_polar_jacobian_is_one_over_the_radius_and_printed_transposed(self):
        def to_polar(v):
            return torch.stack([torch.linalg.norm(v), torch.atan2(v[1], v[0])])

        for point in states(5, 2):
            x, y = point.tolist()
            rho = math.hypot(x, y)
            jacobian = torch.autograd.functional.jacobian(to_polar, point)
            printed = torch.tensor(
                [[x / rho, -y / rho**2], [y / rho, x / rho**2]], dtype=torch.float64
            )
            torch.testing.assert_close(jacobian, printed.mT)
            assert torch.linalg.det(jacobian).item() == pytest.approx(1 / rho)

    def test_chapman_kolmogorov_away_from_the_origin(self):
        field = cycle()
        points, cell = grid(2.0, 400)
        start, end = np.array([0.9, 0.2]), np.array([-0.3, 0.9])
        total = np.exp(field.log_prob(start, points, 0.1) + field.log_prob(points, end, 0.25)).sum()
        assert np.log(total * cell) == pytest.approx(field.log_prob(start, end, 0.35), abs=1e-4)

    def test_a_long_horizon_is_the_stationary_density(self):
        field, points = cycle(), grid(2.0, 20)[0]
        value = field.log_prob(np.array([0.3, -2.0]), points, 400.0)
        np.testing.assert_allclose(value, field.stationary_log_prob(points), atol=1e-6)

    @pytest.mark.parametrize("time", [1e-7, 1e-4, 0.1, 1000.0])
    @DIMENSIONS
    def test_single_precision_is_finite_with_its_gradients(self, n_dims, time):
        latent = random_latent(n_dims, dtype=torch.float32)
        z0 = states(3, n_dims, 8, dtype=torch.float32).requires_grad_()
        times = torch.full((3, 8), time)
        z1 = latent.propagate(z0, times).detach()
        value = latent.transition_log_prob(z0, z1, times) + latent.stationary_log_prob(z0)
        value.sum().backward()
        assert torch.isfinite(value).all()
        assert all(torch.isfinite(p.grad).all() for p in [z0, *latent.parameters()])


class TestNoise:
    def test_transition_against_euler_maruyama_in_polar_and_in_the_plane(self):
        """40 000 draws, 200 steps: standard errors are 1/200 of a deviation."""
        field = cycle(decay=(2.0, 3.0), noise=(0.1, 0.3, 0.2), rate=2.0)
        z0, rng, t = np.tile([0.6, 0.2, 0.4], (40_000, 1)), np.random.default_rng(0), 0.4
        across, angle = field.to_polar(z0[:1])
        spread = field.normal_noise**2 * (1 - np.exp(-2 * field.decay * t)) / (2 * field.decay)
        for cloud in (
            field.sample(z0, t, rng),
            euler_maruyama(field.ito_drift, field.diffusion, z0, t, 200, rng),
        ):
            drawn, phase = field.to_polar(cloud)
            np.testing.assert_allclose(
                drawn.mean(0), across[0] * np.exp(-field.decay * t), atol=4e-3
            )
            np.testing.assert_allclose(drawn.var(0), spread, rtol=0.03)
            assert phase.mean() == pytest.approx(angle[0] + 2.0 * t, abs=4e-3)
            assert phase.var() == pytest.approx(0.3**2 * t, rel=0.03)

    def test_the_mean_in_the_plane_is_shorter_than_the_mean_path(self):
        """E[x + i y] = E[rho] exp(i E[psi]) exp(-s2^2 t / 2)."""
        field = cycle(noise=(0.1, 1.0))
        z0, t = np.tile([1.0, 0.0], (40_000, 1)), 0.5
        drawn = field.sample(z0, t, np.random.default_rng(1)).mean(0)
        mean = field.propagate(z0[:1], np.array([t]))[0] * np.exp(-0.5 * t)
        np.testing.assert_allclose(drawn, mean, atol=0.015)


class TestParameters:
    def test_initial_values(self):
        latent = LimitCycleLatent(2, 3, min_decay=0.05)
        latent.initialise(torch.tensor([-4.0, 6.0]), 2.0, torch.tensor([0.5, 1.5]))
        arrays = latent.arrays(0)
        np.testing.assert_allclose(arrays["rate"], [-4.0], rtol=1e-6)
        np.testing.assert_allclose(arrays["decay"], [2.0, 2.0], rtol=1e-6)
        np.testing.assert_allclose(arrays["radius"], [0.5], rtol=1e-6)
        with pytest.raises(
            ValueError, match=r"expected a finite rate, decay > 0.05 and radius > 0"
        ):
            latent.initialise(1.0, 0.01, 1.0)
        with pytest.raises(ValueError, match="expected n_dims >= 2"):
            LimitCycleLatent(1, 1, min_decay=0.05)

    @given(st.integers(0, 10_000))
    @settings(max_examples=20, deadline=None)
    def test_every_parameter_is_an_attracting_cycle(self, seed):
        latent = LimitCycleLatent(2, 4, min_decay=0.05)
        generator = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            for p in latent.parameters():
                p += 3 * torch.randn(p.shape, generator=generator)
        for m in range(2):
            assert CycleField(**latent.arrays(m)).min_decay >= 0.05 * (1 - 1e-6)

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"decay": np.array([-1.0])}, "decay > 0"),
            ({"radius": np.array([0.0])}, "radius > 0"),
            ({"noise": np.array([1.0, 0.0])}, "noise > 0"),
            ({"noise": np.ones(3)}, r"noise of shape \(2,\), got \(3,\)"),
            ({"decay": np.ones((1, 1))}, r"decay of shape \(d - 1,\)"),
            ({"rate": np.ones(2)}, "one rate and one radius"),
            ({"rate": np.array([np.inf])}, "finite floating numbers in rate"),
        ],
    )
    def test_numbers_without_the_proof_are_refused(self, change, message):
        good = {
            "decay": np.ones(1), "rate": np.ones(1), "radius": np.ones(1), "noise": np.ones(2),
        }  # fmt: skip
        with pytest.raises(ValueError, match=f"expected {message}"):
            CycleField(**(good | change))
