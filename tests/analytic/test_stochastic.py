"""The stochastic system of a fitted ImitationFlow in the motion's own units."""

import numpy as np
import pytest

from iflow_gym.baselines.imitation_flow import ImitationFlow
from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.demonstrations import Demonstrations
from iflow_gym.metrics import start_grid

SMALL = {"n_steps": 150, "n_layers": 6, "sharpness": 2.0}


@pytest.fixture(scope="module")
def angle():
    return load_lasa("Angle")


@pytest.fixture(scope="module")
def additive(angle):
    return ImitationFlow(**SMALL).fit(angle, seed=0)


@pytest.fixture(scope="module")
def vanishing(angle):
    return ImitationFlow(noise="vanishing", **SMALL).fit(angle, seed=0)


@pytest.mark.parametrize("kind", ["additive", "vanishing"])
def test_drift_and_diffusion_are_those_of_the_samples(kind, request, angle):
    """Over 2 ms, in mm and s, from 40 000 draws: within 5 standard errors."""
    system = request.getfixturevalue(kind)
    random, x, dt = system.stochastic(), np.array([-30.0, 25.0]), 0.002
    n = 40_000
    draws = system.sample(np.tile(x, (n, 1)), 1, dt, rng=np.random.default_rng(0))[:, 1]
    moves = draws - x
    root = random.diffusion(x)
    covariance = root @ root.T * dt
    np.testing.assert_allclose(np.cov(moves.T), covariance, rtol=0.1, atol=0.02 * covariance.max())
    error = np.sqrt(np.diag(covariance) / n)
    assert (np.abs(moves.mean(axis=0) - random.drift(x) * dt) < 5 * error).all()


def test_the_density_of_a_cloud_is_that_of_its_samples(additive, angle):
    random, time = additive.stochastic(), 0.6
    draws = additive.sample(
        np.repeat(angle.starts, 800, axis=0), 1, time, rng=np.random.default_rng(1)
    )[:, 1]
    low, high = draws.min(axis=0) - 15, draws.max(axis=0) + 15
    axes = [np.linspace(a, b, 160) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    density = random.density(grid, angle.starts, time)
    assert density.shape == (160, 160)
    cell = np.prod([a[1] - a[0] for a in axes])
    assert density.sum() * cell == pytest.approx(1.0, abs=0.02)
    mean = (density[..., None] * grid).sum((0, 1)) * cell
    np.testing.assert_allclose(mean, draws.mean(axis=0), atol=0.5)


def test_what_each_noise_proves(additive, vanishing, angle):
    low, high = angle.bounding_box
    far = start_grid(low, high)
    near = angle.goal + 1e-3 * np.random.default_rng(0).normal(size=(50, 2))
    assert (additive.stochastic().generator(near) > 0).all()
    assert "bounded around the goal in distribution" in additive.guarantee.reason
    assert vanishing.stochastic().noise.margin > 0
    assert (vanishing.stochastic().generator(np.concatenate([near, far])) < 0).all()
    assert "asymptotically stable in probability" in vanishing.guarantee.reason


def test_trajectories_with_vanishing_noise_come_to_rest(additive, vanishing, angle):
    for system, at_rest in ((vanishing, True), (additive, False)):
        rng = np.random.default_rng(2)
        time = 8 * angle.durations.mean()
        end = system.sample(angle.starts, 40, time / 40, rng=rng)[:, -1]
        assert (np.linalg.norm(end, axis=1).max() < 0.5) == at_rest


def test_a_file_keeps_the_noise(vanishing, angle, tmp_path):
    again = ImitationFlow.load(vanishing.save(tmp_path / "model"))
    pair = angle.starts, vanishing.step(angle.starts, 0.1)
    np.testing.assert_array_equal(again.log_prob(*pair, 0.1), vanishing.log_prob(*pair, 0.1))


def test_what_does_not_apply_says_so(vanishing):
    with pytest.raises(ValueError, match="no stationary law"):
        vanishing.stationary_log_prob([0.0, 1.0])
    time = np.arange(100)[:, None] * 0.1
    circle = Demonstrations.from_arrays(
        [np.hstack([np.cos(time), np.sin(time)])], dt=0.1, period=2 * np.pi
    )
    with pytest.raises(ValueError, match="noise='additive' for"):
        ImitationFlow(noise="vanishing").fit(circle, seed=0)
    with pytest.raises(ValueError, match=r"states of shape \(..., 2\)"):
        vanishing.stochastic().drift([1.0, 2.0, 3.0])


def test_recordings_that_rest_at_the_goal_leave_the_noise_as_it_is(vanishing, angle):
    resting = Demonstrations.from_arrays(
        [np.concatenate([p, np.zeros((100, 2))]) for p in angle.positions],
        dt=angle.dt,
        goal=angle.goal,
    )
    system = ImitationFlow(noise="vanishing", **SMALL).fit(resting, seed=0)
    kappa, usual = (s.stochastic().noise.kappa for s in (system, vanishing))
    assert kappa == pytest.approx(usual, rel=0.5)
    pair = np.array([[0.0, 0.0], [-30.0, 20.0]]), np.array([[1.0, 0.0], [-29.0, 20.0]])
    away = system.log_prob(*pair, 0.1)
    assert away[0] < -1e6  # from the goal, which is not left
    assert np.isfinite(away[1])
