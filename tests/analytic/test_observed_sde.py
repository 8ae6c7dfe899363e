"""Kinds of noise, the observed system and Lemma 1, against simulation and autograd."""

import math

import numpy as np
import pytest
import torch

from iflow_gym.baselines.imitation_flow.coupling import CouplingFlow
from iflow_gym.baselines.imitation_flow.fields.latents import CycleField, LinearField
from iflow_gym.baselines.imitation_flow.lemma import generators
from iflow_gym.baselines.imitation_flow.noise import (
    AdditiveNoise,
    VanishingCycleNoise,
    VanishingLinearNoise,
)
from iflow_gym.baselines.imitation_flow.observed import ObservedSDE
from iflow_gym.baselines.imitation_flow.sde import euler_maruyama, heun

DIMENSIONS = pytest.mark.parametrize("n_dims", [2, 3, 6])


class PlainFlow:
    """A `CouplingFlow` of one model in operations that autograd differentiates twice, (..., d)."""

    def __init__(self, n_dims, n_layers=4, seed=0, scale=0.2):
        generator = torch.Generator().manual_seed(seed)
        self.flow = CouplingFlow(
            n_dims, n_layers, 8, log_scale_bound=0.3, sharpness=1.0, generators=[generator]
        ).double()
        with torch.no_grad():
            weight = self.flow.out_weight
            weight += scale * torch.randn(weight.shape, generator=generator, dtype=weight.dtype)
        self.rotations = self.flow.orthogonal()[:, 0].detach()
        self.parameters = [
            tuple(p[layer, 0].detach() for p in (
                self.flow.hidden_weight, self.flow.hidden_bias[..., 0],
                self.flow.out_weight, self.flow.out_bias[..., 0],
            ))
            for layer in range(n_layers)
        ]  # fmt: skip
        self.n_kept, self.bound = n_dims // 2, self.flow.log_scale_bound

    def coefficients(self, layer, kept):
        hidden_weight, hidden_bias, out_weight, out_bias = self.parameters[layer]
        out = torch.tanh(kept @ hidden_weight.T + hidden_bias) @ out_weight.T + out_bias
        n_moved = out.shape[-1] // 2
        return self.bound * torch.tanh(out[..., :n_moved] / self.bound), out[..., n_moved:]

    def h(self, z):
        for layer, rotation in enumerate(self.rotations):
            z = z @ rotation.T
            kept, moved = z[..., : self.n_kept], z[..., self.n_kept :]
            log_scale, shift = self.coefficients(layer, kept)
            z = torch.cat([kept, moved * torch.exp(log_scale) + shift], dim=-1)
        return z

    def h_inverse(self, y):
        return self.h_inverse_and_log_det(y)[0]

    def h_inverse_and_log_det(self, y):
        total = 0.0
        for layer in reversed(range(len(self.rotations))):
            kept, moved = y[..., : self.n_kept], y[..., self.n_kept :]
            log_scale, shift = self.coefficients(layer, kept)
            y = torch.cat([kept, (moved - shift) * torch.exp(-log_scale)], dim=-1)
            y, total = y @ self.rotations[layer], total - log_scale.sum(-1)
        return y, total

    # The NumPy interface of a fitted flow.

    def forward(self, z):
        return self.h(torch.as_tensor(z)).numpy()

    def inverse(self, y):
        z, log_det = self.h_inverse_and_log_det(torch.as_tensor(y))
        return z.numpy(), log_det.numpy()

    def push_forward(self, z, dz):
        y, moved = torch.autograd.functional.jvp(self.h, torch.as_tensor(z), torch.as_tensor(dz))
        return y.numpy(), moved.numpy()


def linear(n_dims, seed=0):
    rng = np.random.default_rng(seed)
    lower, skew = np.tril(rng.normal(size=(2, n_dims, n_dims)))
    noise = 0.4 * np.tril(rng.normal(size=(n_dims, n_dims))) + 0.3 * np.eye(n_dims)
    drift = skew - skew.T - lower @ lower.T - np.eye(n_dims)
    return LinearField(drift, noise @ noise.T)


def cycle(n_dims, seed=0):
    rng = np.random.default_rng(seed)
    decay, noise = rng.uniform(1, 3, n_dims - 1), rng.uniform(0.1, 0.5, n_dims)
    return CycleField(decay, np.array([4.0]), np.array([0.8]), noise)


def squared_norm(z):
    return (z * z).sum()


def squared_distance(radius):
    def distance(z):
        return (torch.linalg.norm(z[:2]) - radius) ** 2 + (z[2:] ** 2).sum()

    return distance


def systems(n_dims):
    """Both latents with both noises, each with its U in torch."""
    a, c = linear(n_dims), cycle(n_dims)
    return [
        (AdditiveNoise(a), squared_norm),
        (VanishingLinearNoise(a, 0.4), squared_norm),
        (AdditiveNoise(c), squared_distance(c.radius)),
        (VanishingCycleNoise(c, 0.7), squared_distance(c.radius)),
    ]


SYSTEMS = pytest.mark.parametrize("which", range(4), ids=["linear", "quiet", "cycle", "calm-cycle"])


def states(n, n_dims, seed=0):
    return np.random.default_rng(seed).normal(size=(n, n_dims))


def four_routes(flow, sde, lyapunov, z):
    values = generators(
        flow.h, flow.h_inverse, lyapunov,
        *(torch.as_tensor(v.copy()) for v in (z, sde.drift(z), sde.diffusion(z))),
    )  # fmt: skip
    return [v.numpy() for v in values]


class TestLemma:
    @DIMENSIONS
    def test_the_plain_flow_is_the_librarys(self, n_dims):
        flow, z = PlainFlow(n_dims), torch.as_tensor(states(5, n_dims))
        y = flow.flow(z.T[None])
        torch.testing.assert_close(flow.h(z), y[0].T)
        back, log_det = flow.flow.inverse(y)
        mine, total = flow.h_inverse_and_log_det(y[0].T)
        torch.testing.assert_close(mine, back[0].T)
        torch.testing.assert_close(total, log_det[0])

    @DIMENSIONS
    @SYSTEMS
    def test_lv_is_lu(self, n_dims, which):
        """By Ito's drift and the full Hessian; and as the paper prints both, since it cancels."""
        sde, lyapunov = systems(n_dims)[which]
        z = states(40, n_dims)
        for seed in range(3):
            flow = PlainFlow(n_dims, seed=seed)
            latent, observed, printed, _ = four_routes(flow, sde, lyapunov, z)
            np.testing.assert_allclose(latent, sde.generator(z), rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(observed, latent, rtol=1e-8, atol=1e-8)
            np.testing.assert_allclose(printed, latent, rtol=1e-8, atol=1e-8)

    @DIMENSIONS
    @SYSTEMS
    def test_either_omission_alone_is_wrong_by_itos_term(self, n_dims, which):
        sde, lyapunov = systems(n_dims)[which]
        flow, z = PlainFlow(n_dims), states(40, n_dims)
        latent, _, _, mixed = four_routes(flow, sde, lyapunov, z)
        assert np.abs(mixed - latent).max() > 0.02 * np.abs(latent).max()
        observed = ObservedSDE(flow, sde)
        y = observed.decode(z)
        term = observed.drift(y) - observed.printed_drift(y)
        slope = torch.func.vmap(torch.func.grad(lambda v: lyapunov(flow.h_inverse(v))))
        missing = np.sum(slope(torch.as_tensor(y)).numpy() * term, axis=1)
        np.testing.assert_allclose(mixed + missing, latent, rtol=1e-6, atol=1e-6)

    @DIMENSIONS
    def test_either_omission_alone_can_hide_stability(self, n_dims):
        """Vanishing noise with LU < 0 everywhere, and the mixed LV > 0 at some states."""
        sde, lyapunov = systems(n_dims)[1]
        assert sde.margin > 0
        latent, observed, _, mixed = four_routes(
            PlainFlow(n_dims), sde, lyapunov, states(400, n_dims)
        )
        assert (latent < 0).all()
        assert (observed < 0).all()
        assert (mixed > 0).any()

    @DIMENSIONS
    def test_what_is_claimed_of_each_noise(self, n_dims):
        """Additive: LU > 0 close to the attractor. Vanishing: LU < 0 if and only if margin > 0."""
        z = states(2000, n_dims)
        additive = AdditiveNoise(linear(n_dims))
        assert (additive.generator(1e-3 * z) > 0).all()
        assert additive.margin == -math.inf
        field = linear(n_dims)
        worst = np.linalg.eigh(field.drift + field.drift.T)[1][:, -1:].T
        edge = math.sqrt(2 * field.min_decay / n_dims)
        calm, loud = (VanishingLinearNoise(field, k * edge) for k in (0.99, 1.01))
        assert calm.margin > 0 > loud.margin
        assert (calm.generator(z) <= -calm.margin * field.lyapunov(z) + 1e-12).all()
        assert calm.generator(worst) == pytest.approx(-calm.margin)
        assert loud.generator(worst) > 0
        cycled = cycle(n_dims)
        edge = math.sqrt(2 * cycled.min_decay)
        calm, loud = (VanishingCycleNoise(cycled, k * edge) for k in (0.99, 1.01))
        assert calm.margin > 0 > loud.margin
        assert (calm.generator(z) < 0).all()
        across = np.where(cycled.decay == cycled.min_decay, 0.1, 0.0)
        off = cycled.from_polar(across, np.array(0.3))[None]
        assert loud.generator(off) > 0
        assert (AdditiveNoise(cycled).generator(cycled.from_polar(0 * across, 0.3)[None]) > 0).all()

    def test_kappa_is_checked(self):
        with pytest.raises(ValueError, match="expected a finite kappa >= 0, got -1"):
            VanishingLinearNoise(linear(2), -1.0)
        with pytest.raises(ValueError, match="expected n_substeps >= 1, got 0"):
            VanishingLinearNoise(linear(2), 1.0, n_substeps=0).sample(
                states(1, 2), 1.0, np.random.default_rng(0)
            )


class TestVanishingNoise:
    """Clouds of 40 000 draws: standard errors are 1/200 of a deviation, 1/140 of a variance."""

    def test_linear_moments_against_simulation_and_the_approximation(self):
        sde = VanishingLinearNoise(linear(2), 0.5, n_substeps=200)
        z0, t = np.tile([1.0, -0.6], (40_000, 1)), 0.3
        drawn = sde.sample(z0, t, np.random.default_rng(0))
        mean, covariance = (v[0] for v in sde.moments(z0[:1], t))
        deviation = np.sqrt(np.diag(covariance))
        assert (np.abs(drawn.mean(0) - mean) < 0.025 * deviation).all()
        np.testing.assert_allclose(np.cov(drawn.T), covariance, rtol=0.06, atol=1e-3)
        # The approximation leaves out a share d kappa^2 t / 2 = 7.5 % of the covariance.
        approximate = sde.linearised_covariance(z0[:1], t)[0]
        share = 1 - np.trace(approximate) / np.trace(covariance)
        assert 0.03 < share < 0.08

    def test_the_approximation_is_the_limit_of_small_noise(self):
        sde = VanishingLinearNoise(linear(3), 0.01)
        _, covariance = sde.moments(z := states(4, 3), 0.5)
        np.testing.assert_allclose(
            sde.linearised_covariance(z, 0.5), covariance, rtol=1e-3, atol=1e-7
        )
        white = torch.distributions.MultivariateNormal(
            torch.as_tensor(sde.field.propagate(z, np.full(4, 0.5))), torch.as_tensor(covariance)
        )
        after = z * 0.5
        expected = white.log_prob(torch.as_tensor(after)).numpy()
        np.testing.assert_allclose(sde.log_prob(z, after, 0.5), expected, rtol=2e-3)

    def test_linear_paths_come_to_rest(self):
        """E|z|^2 <= |z_0|^2 exp(-margin t): with additive noise it stays above a constant."""
        field, z = linear(2), np.tile([1.0, 1.0], (2000, 1))
        sde = VanishingLinearNoise(field, 0.5 * math.sqrt(field.min_decay), n_substeps=400)
        drawn, t = sde.sample(z, 4.0, np.random.default_rng(0)), 4.0
        assert field.lyapunov(drawn).mean() < 2 * math.exp(-sde.margin * t)
        additive = AdditiveNoise(field)
        drawn = additive.sample(z, 40.0, np.random.default_rng(0))
        rested = field.lyapunov(drawn).mean()
        assert 1e-2 < rested <= 1.1 * additive.ultimate_bound

    def test_cycle_against_euler_maruyama_and_its_density(self):
        field = CycleField(np.array([2.0]), np.array([3.0]), np.array([1.0]), np.array([0.1, 0.3]))
        sde, t = VanishingCycleNoise(field, 0.8), 0.4
        z0, rng = np.tile([0.0, 1.6], (40_000, 1)), np.random.default_rng(0)
        exact = sde.sample(z0, t, rng)
        stepped = euler_maruyama(sde.drift, sde.diffusion, z0, t, 200, rng)
        mean = 0.6 * math.exp(-2.0 * t)
        deviation = mean * math.sqrt(math.expm1(0.8**2 * t))
        for cloud in (exact, stepped):
            across, angle = field.to_polar(cloud)
            assert across.mean() == pytest.approx(mean, abs=0.02 * deviation)
            assert across.std() == pytest.approx(deviation, rel=0.04)
            turned = np.angle(np.exp(1j * (angle - np.pi / 2 - 3.0 * t)))
            assert turned.std() == pytest.approx(0.3 * math.sqrt(t), rel=0.02)
        rho, phase = np.linspace(1.0001, 2.5, 1500), np.linspace(-np.pi, np.pi, 201)[:-1]
        points = np.stack(
            [rho[:, None] * np.cos(phase), rho[:, None] * np.sin(phase)], axis=-1
        ).reshape(-1, 2)
        start = np.broadcast_to(z0[0], points.shape)
        weight = np.repeat(rho, 200) * (rho[1] - rho[0]) * (2 * np.pi / 200)
        total = np.sum(np.exp(sde.log_prob(start, points, t)) * weight)
        assert total == pytest.approx(1.0, abs=1e-3)
        assert sde.log_prob(z0[:1], 0.5 * z0[:1], t) == -np.inf  # within the cycle, from outside


class TestObserved:
    @DIMENSIONS
    @SYSTEMS
    def test_ito_drift_and_diffusion_against_autograd(self, n_dims, which):
        sde, _ = systems(n_dims)[which]
        flow, z = PlainFlow(n_dims), states(6, n_dims)
        observed = ObservedSDE(flow, sde)
        y, f, g = observed.decode(z), sde.drift(z), sde.diffusion(z)
        points = torch.as_tensor(z)
        jacobian = torch.func.vmap(torch.func.jacrev(flow.h))(points).numpy()
        second = torch.func.vmap(torch.func.jacrev(torch.func.jacrev(flow.h)))(points).numpy()
        printed = np.einsum("nij,nj->ni", jacobian, f)
        term = 0.5 * np.einsum("nik,njk,nlij->nl", g, g, second)
        np.testing.assert_allclose(observed.printed_drift(y), printed, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(observed.drift(y), printed + term, rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(observed.diffusion(y), jacobian @ g, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(observed.generator(y), sde.generator(z), rtol=1e-7, atol=1e-7)

    def test_which_equation_is_the_law_of_h_of_z(self):
        """Against 10 000 draws of z carried through h: two such means are 0.014 deviations apart.

        Ito's drift by Euler-Maruyama and the printed one by Heun, as a Stratonovich equation, give
        the mean; the printed one as an Ito equation does not.
        """
        field = LinearField(np.array([[-1.0, 2.0], [-2.0, -1.0]]), 0.5 * np.eye(2))
        observed = ObservedSDE(PlainFlow(2, n_layers=2), AdditiveNoise(field))
        y0 = np.tile(observed.decode(np.array([[0.3, -0.2]])), (10_000, 1))
        rng, t = np.random.default_rng(0), 0.3
        exact = observed.sample(y0, np.array([t]), rng)[:, 0]
        deviation = exact.std(0)

        def bias(integrate, drift):
            drawn = integrate(drift, observed.diffusion, y0, t, 30, rng)
            return np.abs(drawn.mean(0) - exact.mean(0)).max() / deviation.max()

        assert bias(euler_maruyama, observed.drift) < 0.05
        assert bias(heun, observed.printed_drift) < 0.05
        assert bias(euler_maruyama, observed.printed_drift) > 0.15

    @pytest.mark.parametrize("field", [linear(2), cycle(2)], ids=["linear", "cycle"])
    def test_density_of_a_cloud_over_time(self, field):
        """It integrates to one, and has the mean and the quadrant's mass of a drawn cloud."""
        flow = PlainFlow(2)
        observed = ObservedSDE(flow, AdditiveNoise(field), np.array([0.2, -0.1]))
        starts = observed.decode(np.array([[0.9, 0.3], [0.7, 0.6], [-0.8, 0.4]]))
        times = np.array([0.2, 0.7])
        paths = observed.sample(np.repeat(starts, 5000, axis=0), times, np.random.default_rng(0))
        for k, t in enumerate(times):
            cloud = paths[:, k]
            low, high = cloud.min(0) - 1, cloud.max(0) + 1
            axes = [
                a + (np.arange(200) + 0.5) / 200 * (b - a) for a, b in zip(low, high, strict=True)
            ]
            points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
            mass = observed.density(points, starts, t) * np.prod((high - low) / 200)
            assert mass.sum() == pytest.approx(1.0, abs=5e-3)
            error = np.abs(mass @ points - cloud.mean(0))
            assert (error < 0.05 * cloud.std(0)).all()
            centre = np.median(cloud, axis=0)
            expected = (cloud < centre).all(axis=1).mean()
            assert mass[(points < centre).all(axis=1)].sum() == pytest.approx(expected, abs=0.03)

    def test_log_prob_is_the_densitys(self):
        observed = ObservedSDE(PlainFlow(3), AdditiveNoise(linear(3)), np.array([0.1, 0.0, -0.3]))
        y0, y1 = states(1, 3), states(5, 3, seed=1)
        log_prob = observed.log_prob(np.repeat(y0, 5, axis=0), y1, 0.4)
        np.testing.assert_allclose(np.exp(log_prob), observed.density(y1, y0[0], 0.4), rtol=1e-12)
