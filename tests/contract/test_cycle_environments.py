"""Environments of motions that repeat: the reward, the measures, the batch, on circles."""

from __future__ import annotations

import itertools

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from iflow_gym.demonstrations import Demonstrations
from iflow_gym.envs.dynamics import ARRAYS
from iflow_gym.envs.guide import CycleGuide, guide_for
from iflow_gym.envs.point_mass import PointMassEnv
from iflow_gym.envs.point_mass_vector import PointMassVectorEnv
from iflow_gym.envs.task import Push

DT, PERIOD = 0.01, 2.0


def circles(n=3, d=2, rounds=4):
    """Circles of radius 1 in the plane of the first two coordinates, that begin anywhere."""
    t = np.arange(round(rounds * PERIOD / DT)) * DT
    paths = []
    for i in range(n):
        angle = 2 * np.pi * t / PERIOD + i
        paths.append(np.stack([np.cos(angle), np.sin(angle), *[0 * t] * (d - 2)], axis=1))
    return Demonstrations.from_arrays(paths, dt=DT, period=PERIOD, name="circle")


@pytest.mark.parametrize("mode", ["velocity", "force"])
def test_gymnasium_and_stable_baselines_accept_it(mode):
    sb3 = pytest.importorskip("stable_baselines3.common.env_checker")
    check_env(PointMassEnv(circles(), control_mode=mode), skip_render_check=True)
    sb3.check_env(PointMassEnv(circles(), control_mode=mode), skip_render_check=True)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("mode", ["velocity", "force"])
def test_the_batch_gives_the_same_numbers(d, mode):
    demos, push = circles(d=d), Push(fraction=0.05)
    ours = PointMassVectorEnv(demos, 4, control_mode=mode, perturbation=push)
    theirs = gymnasium.vector.SyncVectorEnv(
        [lambda: PointMassEnv(demos, control_mode=mode, perturbation=push)] * 4
    )
    rng = np.random.default_rng(0)
    np.testing.assert_array_equal(ours.reset(seed=3)[0], theirs.reset(seed=3)[0])
    for _ in range(60):
        actions = rng.uniform(-0.4, 0.4, (4, d))
        *found, info = ours.step(actions)
        *expected, expected_info = theirs.step(actions)
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_array_equal(a, b)
        assert set(info) == set(expected_info)
        for key in info:
            np.testing.assert_array_equal(info[key], expected_info[key], err_msg=key)


def test_the_demonstrated_tempo_pays_most_and_the_way_back_costs():
    env = PointMassEnv(circles())
    x, v = env.demonstrations.positions[0][70], env.demonstrations.velocities[0][70]
    rewards = {}
    for factor in (-1.0, 0.0, 0.5, 1.0, 2.0):
        env.reset(options={"start": x})
        rewards[factor] = env.step(env.velocity_to_action(factor * v))[1]
    assert rewards[0.0] == 0
    for factor, expected in ((-1.0, -1.0), (0.5, 0.5), (1.0, 1.0), (2.0, 0.5)):
        assert rewards[factor] == pytest.approx(expected, abs=0.03), factor


def test_a_replay_earns_about_one_a_step_and_never_stops_earning():
    env = PointMassEnv(circles())
    path = env.demonstrations.positions[1]
    env.reset(options={"demonstration": 1})
    rewards, phases = [], []
    for before, after in itertools.pairwise(path):
        _, reward, _, truncated, info = env.step(env.velocity_to_action((after - before) / DT))
        rewards.append(reward)
        phases.append(info["phase"])
        assert info["is_success"]
    assert truncated
    assert len(rewards) == len(path) - 1
    assert min(rewards) > 0.95
    turned = np.unwrap(np.array(phases), period=1.0)
    np.testing.assert_allclose(np.diff(turned).mean(), DT / PERIOD, rtol=0.02)


def test_off_the_orbit_the_way_to_it_pays():
    env = PointMassEnv(circles())
    for start, home in (([1.6, 0.0], [-1.0, 0.0]), ([0.4, 0.0], [1.0, 0.0])):
        _, info = env.reset(options={"start": start})
        assert info["distance_to_orbit"] == pytest.approx(0.6, abs=0.02)
        assert not info["is_success"]
        speed = env.demonstrations.peak_speed
        reward = env.step(env.velocity_to_action(speed * np.array(home)))[1]
        assert reward > 0.9


def test_rewards_are_bounded():
    rng = np.random.default_rng(0)
    guide = guide_for(circles())
    assert isinstance(guide, CycleGuide)
    x = rng.uniform(-3, 3, (2, 20_000))
    y = x + rng.normal(0, 1, x.shape) * rng.choice([0.0, 0.01, 1.0], 20_000)
    rewards = guide.reward(ARRAYS, list(x), list(y), np.full(20_000, DT), np.zeros(20_000))
    assert np.isfinite(rewards).all()
    assert np.abs(rewards).max() <= 1


def test_the_dataset_is_the_recordings():
    env = PointMassEnv(circles())
    data = env.get_dataset("generalisation", "score")
    shown = env.demonstrations.split("generalisation").score.positions
    np.testing.assert_allclose(
        data["observations"], np.concatenate([p[:-1] for p in shown]), atol=1e-12
    )
    assert data["rewards"].mean() > 0.97
    assert not data["terminals"].any()
    assert data["timeouts"].sum() == len(shown)


def test_frames_show_the_orbit():
    env = PointMassEnv(circles(), render_mode="rgb_array")
    env.reset(seed=0)
    assert env.render().shape == (600, 600, 3)
