"""ImitationFlow as a whole, on motions that end and on motions that repeat."""

import json

import numpy as np
import pytest
import safetensors.numpy

from iflow_gym.baselines.imitation_flow import ImitationFlow, ImitationFlowConfig
from iflow_gym.baselines.imitation_flow.fields.coupling import CouplingField
from iflow_gym.baselines.linear import StableLinear
from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.demonstrations import Demonstrations
from iflow_gym.metrics import box_diagonal, rmse, start_grid
from iflow_gym.model_files import ModelFileError, read_model_file


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
        many = np.tile(angle.goal, (200, 1))  # looked up
        np.testing.assert_allclose(fitted.step(many, 1.0), many, atol=1e-11)
        assert (fitted.lyapunov(many) < 1e-24).all()

    def test_lyapunov_function_decreases_and_its_rate_is_the_derivative(self, angle, fitted):
        x, h = 3 * states(angle, 200), 1e-5
        value, rate = fitted.lyapunov(x), fitted.lyapunov_rate(x)
        assert (rate < 0).all()
        slope = (fitted.lyapunov(fitted.step(x, h)) - value) / h
        np.testing.assert_allclose(rate, slope, rtol=1e-3)
        path = fitted.rollout(x, 50, 0.05)
        assert (np.diff(fitted.lyapunov(path), axis=1) < 0).all()

    def test_the_inverse_is_exact_on_the_enlarged_box(self, angle):
        system = ImitationFlow(n_steps=150).fit(angle, seed=0)
        low, high = angle.bounding_box
        grid = start_grid(low, high)
        error = np.abs(system._decode(system._encode(grid)[0]) - grid).max()
        assert error <= 1e-10 * box_diagonal(low, high)

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
            ("time", lambda a: -a, "a time > 0"),
            ("frame", lambda a: 0 * a, "an invertible frame"),
            ("frame", lambda a: a[:1], "frame and time of shapes"),
            ("rotation", lambda a: 1.2 * a, r"orthogonal rotations, got \|R\^T R - I\| = 0.6"),
            ("drift", lambda a: -a, "negative definite, got the eigenvalue"),
            ("drift", lambda a: a + np.diag([1e3], 1), "negative definite, got the eigenvalue"),
            ("drift", lambda a: a.astype(np.complex64), "real floating numbers in 'drift'"),
            ("diffusion", lambda a: -a, "a positive definite diffusion"),
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
            arrays.update({k: arrays[k][:0] for k in CouplingField.NAMES})

        def unbounded(header, arrays):
            header["config"]["log_scale_bound"] = np.inf

        for change, message in (
            (in_space, r"of shapes \[\(3,\).*got \[\(2,\)"),
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
            ({"objective": "best"}, "objective among 'reproduction', 'paper', got 'best'"),
            ({"n_layers": 0}, "n_layers >= 1, got 0"),
            ({"learning_rate": -1.0}, "learning_rate > 0, got -1.0"),
            ({"likelihood_fraction": 2.0}, "likelihood_fraction in"),
            ({"objective": "paper", "orbit_weight": 0.2}, "no orbit_weight with objective='paper'"),
        ],
    )
    def test_settings_are_checked(self, settings, message):
        with pytest.raises(ValueError, match=message):
            ImitationFlow(**settings)


def circle(n_rounds=3, radius=2.0, period=1.5, dt=0.01, clockwise=False, centre=(1.0, -2.0)):
    """Recordings of a circle, with a closed form for everything."""
    time = np.arange(round(n_rounds * period / dt)) * dt
    recordings = []
    for phase in (0.0, 1.0, 2.5):
        angle = phase + (-1 if clockwise else 1) * 2 * np.pi * time / period
        recordings.append(
            np.array(centre) + radius * np.column_stack([np.cos(angle), np.sin(angle)])
        )
    return Demonstrations.from_arrays(recordings, dt=dt, period=period, name="circle")


@pytest.fixture(scope="module")
def bean():
    """A closed curve that is no ellipse, traced with jitter, and the system that learned it."""
    rng = np.random.default_rng(0)
    recordings = []
    for _ in range(4):
        time = np.arange(600) * 0.01
        angle = 2 * np.pi * (rng.uniform() + time / 2.0)
        size = 1 + 0.01 * rng.standard_normal()
        radius = size * (1 + 0.35 * np.cos(2 * angle) + 0.2 * np.sin(angle))
        recordings.append(np.column_stack([3 * radius * np.cos(angle), radius * np.sin(angle)]))
    motion = Demonstrations.from_arrays(recordings, dt=0.01, period=2.0, name="bean")
    return motion, ImitationFlow(n_steps=500, n_layers=8).fit(motion, seed=0)


class TestCycle:
    @pytest.mark.parametrize("clockwise", [False, True])
    def test_a_circle_is_learned_with_its_radius_centre_sense_and_period(self, clockwise):
        motion = circle(clockwise=clockwise)
        system = ImitationFlow(n_steps=250, n_layers=4).fit(motion, seed=0)
        start = np.array([[4.0, 1.0]])
        path = system.rollout(start, 1500, 0.01)[0, -450:] - [1.0, -2.0]
        radius = np.linalg.norm(path, axis=1)
        np.testing.assert_allclose(radius, 2.0, rtol=0.02)
        turned = np.unwrap(np.arctan2(path[:, 1], path[:, 0]))
        rate = (turned[-1] - turned[0]) / (449 * 0.01)
        assert rate == pytest.approx((-1 if clockwise else 1) * 2 * np.pi / 1.5, rel=0.01)

    def test_every_start_but_the_centre_ends_on_the_orbit(self, bean):
        motion, system = bean
        low, high = motion.bounding_box
        starts = start_grid(low, high)
        path = system.rollout(starts, 1600, 0.01)[:, -200:]
        samples = np.concatenate(motion.positions)
        steady = path[0]
        # Every start has the same orbit, which is the recordings'.
        for orbit in path[::16]:
            gaps = np.linalg.norm(orbit[:, None] - steady[None], axis=2).min(axis=1)
            assert gaps.max() < 0.02 * box_diagonal(low, high)
        gaps = np.linalg.norm(steady[:, None] - samples[None, ::5], axis=2)
        assert gaps.min(axis=1).mean() < 0.01 * box_diagonal(low, high)
        assert gaps.min(axis=0).max() < 0.05 * box_diagonal(low, high)

    def test_distance_to_the_cycle_decreases_everywhere(self, bean):
        motion, system = bean
        x = states(motion, 200)
        value, rate = system.lyapunov(x), system.lyapunov_rate(x)
        assert (rate <= 0).all()
        later = system.lyapunov(system.step(x, 1e-5))
        np.testing.assert_allclose((later - value) / 1e-5, rate, rtol=1e-2, atol=1e-4)
        assert "cycle" in system.guarantee.reason

    def test_a_step_is_the_flow_of_the_velocity(self, bean):
        motion, system = bean
        x = states(motion, 50)
        slope = (system.step(x, 1e-6) - x) / 1e-6
        np.testing.assert_allclose(system.velocity(x), slope, rtol=1e-3, atol=1e-3)
        twice = system.step(system.step(x, 0.3), 0.5)
        np.testing.assert_allclose(twice, system.step(x, 0.8), atol=1e-8)

    def test_a_file_keeps_the_cycle(self, bean, tmp_path):
        motion, system = bean
        again = ImitationFlow.load(system.save(tmp_path / "bean"))
        assert again.period_ == 2.0
        np.testing.assert_array_equal(again.velocity(motion.starts), system.velocity(motion.starts))
        rewrite(tmp_path / "bean", lambda header, arrays: arrays.pop("period"))
        with pytest.raises(ModelFileError, match="no whole 'imitation-flow' model"):
            ImitationFlow.load(tmp_path / "bean")

    def test_in_space_a_tilted_cycle_is_learned_in_its_plane(self):
        flat = circle(n_rounds=2, centre=(0.0, 0.0))
        tilt = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, -0.3]])
        motion = Demonstrations.from_arrays([p @ tilt for p in flat.positions], dt=0.01, period=1.5)
        system = ImitationFlow(n_steps=400, n_layers=4, sharpness=2.0).fit(motion, seed=0)
        x, y, z = system.rollout(np.array([[3.0, 1.0, -3.0]]), 1500, 0.01)[0, -150:].T
        np.testing.assert_allclose(np.hypot(x, y), 2.0, rtol=0.05)
        np.testing.assert_allclose(z, 0.5 * x - 0.3 * y, atol=0.06)

    def test_the_likelier_trajectory_is_the_one_that_was_learned(self, bean):
        motion, system = bean
        other = ImitationFlow(n_steps=250, n_layers=4).fit(circle(centre=(0.0, 0.0)), seed=0)
        own = motion.positions[0][:300]
        for stride in (1, 5):
            mine = system.trajectory_log_prob(own, 0.01, stride=stride, initial=True)
            theirs = other.trajectory_log_prob(own, 0.01, stride=stride, initial=True)
            assert mine > theirs
        total = sum(system.log_prob(own[:-1], own[1:], 0.01))
        assert system.trajectory_log_prob(own, 0.01) == pytest.approx(total)
        with pytest.raises(ValueError, match=r"a trajectory \(T, d\) of more than stride = 300"):
            system.trajectory_log_prob(own, 0.01, stride=300)

    def test_a_transition_has_a_density_in_the_recordings_own_units(self):
        """It integrates to one over their plane, and its mean is that of `sample` over as long."""
        motion = circle(radius=200.0, clockwise=True, centre=(50.0, -20.0))
        system = ImitationFlow(n_steps=60, n_layers=4).fit(motion, seed=0)
        start, time = motion.starts[0], 0.3
        drawn = system.sample(np.tile(start, (20_000, 1)), 1, time, rng=np.random.default_rng(0))
        drawn = drawn[:, 1]
        centre, half = drawn.mean(axis=0), 6 * drawn.std(axis=0)
        axis = (np.arange(400) + 0.5) / 200 - 1
        grid = centre + half * np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        density = np.exp(system.log_prob(np.tile(start, (len(grid), 1)), grid, time))
        weights = density * np.prod(half / 200)
        assert weights.sum() == pytest.approx(1.0, abs=2e-3)
        np.testing.assert_allclose(weights @ grid, centre, atol=0.03 * drawn.std())

    def test_the_centre_is_said_to_be_left_out(self, bean):
        assert "but the image of the cycle's centre" in bean[1].guarantee.reason

    def test_vanishing_noise_is_refused_with_a_reason(self, bean):
        with pytest.raises(ValueError, match="rounds cross each other"):
            ImitationFlow(noise="vanishing").fit(bean[0], seed=0)
