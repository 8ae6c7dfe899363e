"""ImitationFlow against closed forms, autograd, scipy and zuko."""

import json

import numpy as np
import pytest
import safetensors.numpy
import scipy.linalg
import torch
import zuko
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.distributions import AffineTransform

from iflow_gym.baselines.imitation_flow import ImitationFlow, ImitationFlowConfig
from iflow_gym.baselines.imitation_flow import latent as latent_module
from iflow_gym.baselines.imitation_flow.field import NAMES, Flow, Latent
from iflow_gym.baselines.imitation_flow.flow import CouplingFlow
from iflow_gym.baselines.imitation_flow.latent import (
    LinearLatent,
    gaussian_log_prob,
    propagator,
    stationary_covariance,
    transition,
)
from iflow_gym.baselines.linear import StableLinear
from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.demonstrations import Demonstrations
from iflow_gym.metrics import box_diagonal, rmse, start_grid
from iflow_gym.system import ModelFileError, read_model_file


def random_flow(n_dims, n_models=1, seed=0, n_layers=4, dtype=torch.float64):
    generators = [torch.Generator().manual_seed(seed + i) for i in range(n_models)]
    flow = CouplingFlow(
        n_models, n_dims, n_layers, 8, log_scale_bound=0.3, sharpness=2.0, generators=generators
    ).to(dtype)
    with torch.no_grad():
        noise = torch.Generator().manual_seed(seed)
        flow.out_weight += 0.3 * torch.randn(flow.out_weight.shape, generator=noise, dtype=dtype)
        flow.out_bias += 0.3 * torch.randn(flow.out_bias.shape, generator=noise, dtype=dtype)
    return flow


def as_numpy(flow):
    with torch.no_grad():
        arrays = {
            "rotation": flow.orthogonal(),
            "hidden_weight": flow.hidden_weight,
            "hidden_bias": flow.hidden_bias,
            "out_weight": flow.out_weight,
            "out_bias": flow.out_bias,
        }
        return Flow({k: v[:, 0].numpy() for k, v in arrays.items()}, flow.log_scale_bound)


def random_latent(n_dims, n_models=3, seed=0):
    latent = LinearLatent(n_models, n_dims, min_decay=0.05).double()
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for p in latent.parameters():
            p += torch.randn(p.shape, generator=generator, dtype=p.dtype)
    return latent


class TestFlow:
    @pytest.mark.parametrize("n_dims", [2, 3, 5])
    def test_inverse_undoes_forward_and_log_det_is_the_jacobians(self, n_dims):
        flow = random_flow(n_dims)
        z = torch.randn(
            1, 7, n_dims, dtype=torch.float64, generator=torch.Generator().manual_seed(1)
        )
        y = flow(z)
        back, log_det = flow.inverse(y)
        torch.testing.assert_close(back, z, rtol=0, atol=1e-12)
        for i in range(7):
            jacobian = torch.autograd.functional.jacobian(
                lambda v: flow.inverse(v[None, None])[0][0, 0], y[0, i].detach()
            )
            expected = torch.linalg.slogdet(jacobian).logabsdet
            torch.testing.assert_close(log_det[0, i], expected, rtol=0, atol=1e-10)

    def test_a_layer_is_zukos_affine_coupling_behind_a_rotation(self):
        flow = random_flow(4, n_layers=1)
        z = torch.randn(1, 5, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(2))

        def conditioner(kept):
            log_scale, shift = flow._coefficients(0, kept[None])
            return zuko.transforms.DependentTransform(
                AffineTransform(shift[0], torch.exp(log_scale[0])), 1
            )

        oracle = zuko.transforms.CouplingTransform(
            conditioner, torch.tensor([True, True, False, False])
        )
        rotated = (z @ flow.orthogonal()[0])[0]
        expected, log_det = oracle.call_and_ladj(rotated)
        y = flow(z)
        torch.testing.assert_close(y[0], expected)
        torch.testing.assert_close(flow.inverse(y)[1][0], -log_det)

    @pytest.mark.parametrize("n_dims", [2, 3, 6])
    def test_transforms_are_orthogonal(self, n_dims):
        rotations = random_flow(n_dims).orthogonal()
        eye = torch.eye(n_dims, dtype=torch.float64).expand_as(rotations)
        torch.testing.assert_close(rotations @ rotations.mT, eye, rtol=0, atol=1e-12)

    @pytest.mark.parametrize("n_dims", [2, 3])
    def test_numpy_path_is_the_torch_path(self, n_dims):
        flow = random_flow(n_dims)
        fast = as_numpy(flow)
        z = np.random.default_rng(0).normal(size=(9, n_dims))
        tangent = np.random.default_rng(1).normal(size=(9, n_dims))
        with torch.no_grad():
            y = flow(torch.as_tensor(z)[None])
            back, log_det = flow.inverse(y)
        np.testing.assert_allclose(fast.forward(z.copy()), y[0].numpy(), atol=1e-12)
        inverse, inverse_log_det = fast.inverse(y[0].numpy())
        np.testing.assert_allclose(inverse, back[0].numpy(), atol=1e-12)
        np.testing.assert_allclose(inverse_log_det, log_det[0].numpy(), atol=1e-12)
        _, expected = torch.autograd.functional.jvp(
            lambda v: flow(v[None])[0], torch.as_tensor(z), torch.as_tensor(tangent)
        )
        np.testing.assert_allclose(
            fast.push_forward(z.copy(), tangent.copy())[1], expected.detach().numpy(), atol=1e-12
        )

    def test_a_model_is_the_same_whatever_is_beside_it(self):
        generators = [torch.Generator().manual_seed(s) for s in (9, 5)]
        two = CouplingFlow(2, 2, 4, 8, log_scale_bound=0.3, sharpness=2.0, generators=generators)
        alone = CouplingFlow(
            1, 2, 4, 8, log_scale_bound=0.3, sharpness=2.0,
            generators=[torch.Generator().manual_seed(5)],
        )  # fmt: skip
        for a, b in zip(alone.parameters(), two.parameters(), strict=True):
            torch.testing.assert_close(a[:, 0], b[:, 1])

    def test_far_away_every_value_is_finite_and_the_inverse_holds(self):
        flow = as_numpy(random_flow(2, n_layers=24))
        y = 1e3 * np.random.default_rng(0).normal(size=(50, 2))
        z, log_det = flow.inverse(y)
        assert np.isfinite(z).all()
        assert np.isfinite(log_det).all()
        np.testing.assert_allclose(flow.forward(z), y, rtol=1e-9)


class TestLatent:
    @given(seed=st.integers(0, 10_000), n_dims=st.integers(2, 5))
    @settings(max_examples=30, deadline=None)
    def test_stable_for_every_parameter(self, seed, n_dims):
        drift = random_latent(n_dims, seed=seed).drift().detach().numpy()
        assert np.linalg.eigvalsh(drift + drift.transpose(0, 2, 1)).max() < 0
        assert np.linalg.eigvals(drift).real.max() < 0

    @pytest.mark.parametrize(
        "drift",
        [
            [[-3.0, 0.0], [0.0, -3.0]],  # equal eigenvalues
            [[-3.0, 1.0], [-1.0, -3.0]],  # complex
            [[-4.0, 0.5], [0.5, -0.5]],  # real
            [[-3.0, 1e-6], [-1e-6, -3.0]],  # nearly equal
        ],
    )
    def test_propagator_in_the_plane_is_the_matrix_exponential(self, drift):
        matrix = torch.tensor([drift], dtype=torch.float64)
        times = torch.tensor([[0.0, 1e-7, 1e-3, 0.1, 1.0, 5.0]], dtype=torch.float64)
        expected = np.stack([scipy.linalg.expm(np.array(drift) * t) for t in times[0].numpy()])
        np.testing.assert_allclose(propagator(matrix, times)[0].numpy(), expected, atol=1e-12)

    def test_propagator_has_finite_gradients_where_eigenvalues_meet(self):
        matrix = torch.tensor([[[-3.0, 0.0], [0.0, -3.0]]], dtype=torch.float64, requires_grad=True)
        propagator(matrix, torch.tensor([[0.0, 0.5]], dtype=torch.float64)).sum().backward()
        assert torch.isfinite(matrix.grad).all()

    @pytest.mark.parametrize("n_dims", [2, 3])
    def test_stationary_covariance_solves_the_lyapunov_equation(self, n_dims):
        latent = random_latent(n_dims)
        drift, diffusion = latent.drift().detach(), latent.diffusion().detach()
        solved = stationary_covariance(drift, diffusion).numpy()
        for a, q, p in zip(drift.numpy(), diffusion.numpy(), solved, strict=True):
            np.testing.assert_allclose(p, scipy.linalg.solve_continuous_lyapunov(a, -q), atol=1e-9)

    @pytest.mark.parametrize("n_dims", [2, 3])
    def test_transition_against_van_loan_and_against_the_semigroup(self, n_dims):
        latent = random_latent(n_dims)
        drift, diffusion = latent.drift().detach(), latent.diffusion().detach()
        times = torch.tensor([[0.1, 0.7, 0.8]] * 3, dtype=torch.float64)
        forward, covariance = transition(drift, diffusion, times)
        for m in range(3):
            fast = Latent(drift[m].numpy(), diffusion[m].numpy())
            for k, t in enumerate(times[m].tolist()):
                f, c = fast.transition(t)
                np.testing.assert_allclose(forward[m, k].numpy(), f, atol=1e-10)
                np.testing.assert_allclose(covariance[m, k].numpy(), c, atol=1e-10)
        # Chapman-Kolmogorov: 0.1 then 0.7 is 0.8.
        joined = forward[:, 1] @ covariance[:, 0] @ forward[:, 1].mT + covariance[:, 1]
        torch.testing.assert_close(joined, covariance[:, 2], rtol=1e-9, atol=1e-12)

    @pytest.mark.parametrize("n_dims", [2, 3])
    @pytest.mark.parametrize("time", [1e-4, 1e-2, 1.0, 10.0, 100.0])
    def test_transition_over_any_horizon(self, n_dims, time):
        """In durations: the block exponential alone is wrong by 1e10 at 10, and nan at 100."""
        latent = random_latent(n_dims)
        drift, diffusion = latent.drift()[0].detach().numpy(), latent.diffusion()[0]
        diffusion = diffusion.detach().numpy()
        stationary = scipy.linalg.solve_continuous_lyapunov(drift, -diffusion)
        expected_forward = scipy.linalg.expm(drift * time)
        expected = stationary - expected_forward @ stationary @ expected_forward.T
        forward, covariance = Latent(drift, diffusion).transition(time)
        np.testing.assert_allclose(forward, expected_forward, rtol=0, atol=1e-12)
        error = np.abs(covariance - expected).max()
        assert error <= 1e-9 * np.linalg.eigvalsh(expected).min()
        np.linalg.cholesky(covariance)

    def test_transition_against_simulation(self):
        drift = np.array([[-2.0, 1.0], [-1.0, -3.0]])
        root = np.diag([0.5, 1.0])
        rng = np.random.default_rng(0)
        z, dt = np.tile([1.0, -0.5], (40_000, 1)), 0.002
        for _ in range(250):  # Euler-Maruyama
            z = z + dt * z @ drift.T + np.sqrt(dt) * rng.standard_normal(z.shape) @ root.T
        forward, covariance = Latent(drift, root @ root.T).transition(0.5)
        np.testing.assert_allclose(z.mean(0), forward @ [1.0, -0.5], atol=0.01)
        np.testing.assert_allclose(np.cov(z.T), covariance, atol=0.01)

    @pytest.mark.parametrize("n_dims", [2, 3])
    def test_gaussian_density_against_torch(self, n_dims):
        _, covariance = transition(
            random_latent(n_dims).drift().detach(),
            random_latent(n_dims).diffusion().detach(),
            torch.full((3, 4), 0.3, dtype=torch.float64),
        )
        residual = torch.randn(3, 4, n_dims, dtype=torch.float64)
        expected = torch.distributions.MultivariateNormal(
            torch.zeros(n_dims, dtype=torch.float64), covariance
        ).log_prob(residual)
        torch.testing.assert_close(gaussian_log_prob(residual, covariance), expected)

    def test_noise_has_a_floor(self):
        latent = LinearLatent(1, 2, min_decay=0.05)
        with torch.no_grad():
            latent.log_noise.fill_(-1e4)
        least = latent.diffusion().diagonal(dim1=-2, dim2=-1).min().item()
        assert least == pytest.approx(latent_module.MIN_NOISE**2)


@pytest.fixture(scope="module")
def angle():
    return load_lasa("Angle")


@pytest.fixture(scope="module")
def fitted(angle):
    return ImitationFlow(n_steps=150, n_layers=8).fit(angle, seed=0)


def states(demonstrations, n, seed=0):
    low, high = demonstrations.bounding_box
    return np.random.default_rng(seed).uniform(low, high, size=(n, demonstrations.n_dims))


def rewrite(path, change):
    """Change a model file's header and arrays in place."""
    header, arrays = read_model_file(path)
    change(header, arrays)
    metadata = {"iflow_gym": json.dumps(header)}
    safetensors.numpy.save_file(
        {k: np.ascontiguousarray(a) for k, a in arrays.items()}, path, metadata=metadata
    )


class TestModel:
    def test_learns_more_than_a_line(self, angle, fitted):
        def error(system):
            recordings = zip(angle.positions, angle.dt, strict=True)
            return np.mean([rmse(p, system.rollout(p[0], len(p) - 1, h)) for p, h in recordings])

        # 150 steps of 8 small layers leave about half; a line has 9.05 mm.
        assert error(fitted) < 0.6 * error(StableLinear().fit(angle, seed=0))

    def test_steps_compose_and_rollout_repeats_them(self, angle, fitted):
        x = states(angle, 6)
        twice = fitted.step(fitted.step(x, 0.3), 0.5)
        np.testing.assert_allclose(twice, fitted.step(x, 0.8), atol=1e-8)
        path = fitted.rollout(x, 3, 0.1)
        assert path.shape == (6, 4, 2)
        np.testing.assert_allclose(path[:, 3], fitted.step(x, 0.3), atol=1e-8)
        each = np.array([0.1, 0.2, 0.1, 0.3, 0.1, 0.2])
        np.testing.assert_allclose(fitted.step(x, each)[3], fitted.step(x[3], 0.3), atol=1e-9)

    def test_velocity_is_the_derivative_of_the_flow(self, angle, fitted):
        x, h = states(angle, 20), 1e-6
        slope = (fitted.step(x, h) - x) / h
        np.testing.assert_allclose(fitted.velocity(x), slope, rtol=1e-3, atol=1e-3)

    def test_the_goal_is_the_attractor_exactly(self, angle, fitted):
        np.testing.assert_allclose(fitted.velocity(angle.goal), 0, atol=1e-10)
        np.testing.assert_allclose(fitted.step(angle.goal, 1.0), angle.goal, atol=1e-10)
        far = fitted.rollout(states(angle, 5), 1, 100.0)[:, -1]
        np.testing.assert_allclose(far, np.zeros((5, 2)), atol=1e-6)

    def test_lyapunov_function_decreases_and_its_rate_is_the_derivative(self, angle, fitted):
        x, h = 3 * states(angle, 200), 1e-5
        value, rate = fitted.lyapunov(x), fitted.lyapunov_rate(x)
        assert (rate < 0).all()
        slope = (fitted.lyapunov(fitted.step(x, h)) - value) / h
        np.testing.assert_allclose(rate, slope, rtol=1e-3)
        path = fitted.rollout(x, 50, 0.05)
        assert (np.diff(fitted.lyapunov(path), axis=1) < 0).all()

    def test_inverse_error_in_single_precision_on_the_enlarged_box(self, angle):
        system = ImitationFlow(n_steps=150).fit(angle, seed=0)
        low, high = angle.bounding_box
        grid = (start_grid(low, high) - angle.goal) / system._length
        exact = np.abs(system._flow.forward(system._flow.inverse(grid)[0]) - grid).max()
        assert exact * system._length <= 1e-10 * box_diagonal(low, high)
        for layer in system._flow.layers:
            assert all(a.dtype == np.float64 for a in layer)
        system._flow.layers = [
            type(layer)(*(a.astype(np.float32) for a in layer)) for layer in system._flow.layers
        ]
        single = grid.astype(np.float32)
        z = system._flow.inverse(single)[0].astype(np.float32)
        error = np.abs(system._flow.forward(z) - single).max() * system._length
        assert error <= 1e-4 * box_diagonal(low, high)

    def test_transition_density_integrates_to_one(self, angle, fitted):
        x, dt = np.array([-30.0, 20.0]), 0.4
        mean = fitted.step(x, dt)
        draws = fitted.sample(np.tile(x, (500, 1)), 1, dt, rng=np.random.default_rng(0))[:, 1]
        spread = 8 * draws.std(axis=0)
        axes = [np.linspace(m - s, m + s, 400) for m, s in zip(mean, spread, strict=True)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        density = np.exp(fitted.log_prob(np.broadcast_to(x, points.shape), points, dt))
        cell = np.prod([a[1] - a[0] for a in axes])
        assert density.sum() * cell == pytest.approx(1.0, abs=0.01)
        expected = (density[..., None] * points).sum((0, 1)) * cell
        standard_error = draws.std(axis=0) / np.sqrt(len(draws))
        assert (np.abs(expected - draws.mean(axis=0)) < 5 * standard_error).all()

    def test_a_density_of_a_long_horizon_forgets_the_start(self, angle, fitted):
        far = 100 * angle.durations.mean()
        x, x_next = angle.starts[:3], np.tile([-1.0, 2.0], (3, 1))
        value = fitted.log_prob(x, x_next, far)
        np.testing.assert_allclose(value, value[0], rtol=1e-9)
        np.testing.assert_allclose(value, fitted.log_prob(x, x_next, 2 * far), rtol=1e-9)
        draws = fitted.sample(angle.starts, 3, far, rng=np.random.default_rng(0))
        assert np.isfinite(draws).all()

    def test_sample_checks_its_arguments(self, angle, fitted):
        rng = np.random.default_rng(0)
        assert fitted.sample(angle.starts, np.int64(0), 0.1, rng=rng).shape == (7, 1, 2)
        with pytest.raises(ValueError, match="n_steps >= 0, got -2"):
            fitted.sample(angle.starts, -2, 0.1, rng=rng)
        with pytest.raises(TypeError, match=r"a whole number, got 1\.0"):
            fitted.sample(angle.starts, 1.0, 0.1, rng=rng)
        with pytest.raises(ValueError, match="a finite dt > 0 in seconds, got 0"):
            fitted.sample(angle.starts, 1, 0, rng=rng)

    @pytest.mark.parametrize(
        ("name", "change", "message"),
        [
            ("scales", lambda a: a * [1, -1], "scales of length and time > 0"),
            ("scales", lambda a: a * [0, 1], "scales of length and time > 0"),
            ("scales", lambda a: a[:1], "scales of shapes"),
            ("rotation", lambda a: 1.2 * a, r"orthogonal rotations, got \|R\^T R - I\| = 0.6"),
            ("drift", lambda a: -a, "negative definite, got the eigenvalue"),
            ("drift", lambda a: a + np.diag([1e3], 1), "negative definite, got the eigenvalue"),
            ("drift", lambda a: a.astype(np.complex64), "real floating numbers in 'drift'"),
            ("diffusion", lambda a: -a, "diffusion > 0 on the diagonal"),
            ("diffusion", lambda a: a + np.diag([a[0, 0]], 1), "a symmetric diffusion"),
            ("out_bias", lambda a: a + 1e200, "a flow that inverts at the goal"),
        ],
    )
    def test_a_file_whose_proof_fails_is_refused(self, fitted, tmp_path, name, change, message):
        path = fitted.save(tmp_path / "model")
        rewrite(path, lambda header, arrays: arrays.update({name: change(arrays[name])}))
        with pytest.raises(ModelFileError, match=message):
            ImitationFlow.load(path)

    def test_a_file_of_another_dimension_or_without_layers_is_refused(self, fitted, tmp_path):
        def in_space(header, arrays):
            header["n_dims"] = 3
            arrays["goal"] = np.zeros(3)

        def without_layers(header, arrays):
            arrays.update({k: arrays[k][:0] for k in NAMES})

        def unbounded(header, arrays):
            header["config"]["log_scale_bound"] = np.inf

        for change, message in (
            (in_space, r"of shapes \[\(3, 3\).*got \[\(2, 2\)"),
            (without_layers, "at least one layer"),
            (unbounded, "log_scale_bound > 0, got inf"),
        ):
            path = fitted.save(tmp_path / "model")
            rewrite(path, change)
            with pytest.raises(ModelFileError, match=message):
                ImitationFlow.load(path)

    def test_samples_follow_the_seed_and_the_noise_is_seen(self, angle, fitted):
        first = fitted.sample(angle.starts, 20, 0.05, rng=np.random.default_rng(1))
        again = fitted.sample(angle.starts, 20, 0.05, rng=np.random.default_rng(1))
        np.testing.assert_array_equal(first, again)
        assert first.shape == (7, 21, 2)
        np.testing.assert_array_equal(first[:, 0], angle.starts)
        assert np.abs(first - fitted.rollout(angle.starts, 20, 0.05)).max() > 1e-3

    def test_training_together_is_training_alone(self, angle):
        """After 5 steps, before training has amplified single precision's rounding (1e-7)."""
        other = load_lasa("Sshape")
        method = ImitationFlow(n_steps=5, n_layers=4)
        together = method.fit_many([angle, other], seeds=[3, 4])
        alone = ImitationFlow(n_steps=5, n_layers=4).fit(other, seed=4)
        x = states(other, 10)
        np.testing.assert_allclose(
            together[1].velocity(x), alone.velocity(x), rtol=0, atol=1e-5 * other.peak_speed
        )

    def test_motions_of_different_sizes_train_in_one_call(self):
        t = np.linspace(0, 1, 60)[:, None]
        curve = (1 - t) ** 2 * np.array([[1.0, 2.0, -1.0]]) + 0.1 * np.sin(3 * t) * (1 - t)
        one = Demonstrations.from_arrays([curve], dt=0.01)
        two = Demonstrations.from_arrays([curve[::2], 1.1 * curve], dt=[0.02, 0.01])
        systems = ImitationFlow(n_steps=5, n_layers=3).fit_many([one, two, one], seeds=[0, 1, 2])
        assert [s.n_dims_ for s in systems] == [3, 3, 3]
        assert np.isfinite(systems[1].velocity(curve)).all()
        assert not np.array_equal(systems[0].velocity(curve), systems[2].velocity(curve))

    def test_the_papers_objective_raises_the_likelihood(self, angle):
        def likelihood(system):
            pairs = zip(angle.positions, angle.dt, strict=True)
            return np.mean([system.log_prob(p[:-50], p[50:], 50 * h).mean() for p, h in pairs])

        config = ImitationFlowConfig(objective="paper", n_layers=6)
        before = ImitationFlow(config, n_steps=1).fit(angle, seed=0)
        after = ImitationFlow(config, n_steps=300).fit(angle, seed=0)
        assert likelihood(after) > likelihood(before) + 1
        assert after.guarantee.kind == "proved"

    def test_one_dimension_is_refused_with_the_way_out(self):
        line = Demonstrations.from_arrays([np.linspace(1, 0, 20)[:, None]], dt=0.1)
        with pytest.raises(ValueError, match=r"at least 2 dimensions.*'linear' or 'gmr'"):
            ImitationFlow().fit(line, seed=0)

    @pytest.mark.parametrize(
        ("settings", "message"),
        [
            ({"objective": "best"}, "objective 'reproduction' or 'paper', got 'best'"),
            ({"n_layers": 0}, "n_layers >= 1, got 0"),
            ({"learning_rate": -1.0}, "learning_rate > 0, got -1.0"),
            ({"likelihood_fraction": 2.0}, "likelihood_fraction in"),
        ],
    )
    def test_settings_are_checked(self, settings, message):
        with pytest.raises(ValueError, match=message):
            ImitationFlow(**settings)
