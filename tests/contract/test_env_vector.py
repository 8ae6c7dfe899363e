"""The batched environment gives the same bits as its environments one by one."""

import gymnasium
import numpy as np
import pytest

import iflow_gym
from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.envs.point_mass import PointMassEnv
from iflow_gym.envs.point_mass_vector import PointMassVectorEnv
from iflow_gym.envs.task import Push

N = 5


def assert_same(ours, theirs):
    *arrays, info = ours
    *expected, expected_info = theirs
    for a, b in zip(arrays, expected, strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    assert set(info) == set(expected_info)
    for key, value in info.items():
        assert value.dtype == expected_info[key].dtype, key
        np.testing.assert_array_equal(value, expected_info[key], err_msg=key)


def pair(env_id="iflow/LASA-Angle-v0", **settings):
    return tuple(
        gymnasium.make_vec(env_id, num_envs=N, vectorization_mode=mode, **settings)
        for mode in ("vector_entry_point", "sync")
    )


@pytest.mark.parametrize("mode", ["velocity", "force"])
@pytest.mark.parametrize(
    "settings",
    [{"horizon": 25, "perturbation": Push(fraction=0.01)}, {"perturbation": Push(0.05, 0.1)}, {}],
    ids=["autoreset", "push", "plain"],
)
def test_same_numbers_as_one_by_one(mode, settings):
    ours, theirs = pair(control_mode=mode, **settings)
    rng = np.random.default_rng(0)
    assert_same(ours.reset(seed=11), theirs.reset(seed=11))
    for _ in range(90):
        actions = rng.uniform(-2, 2, (N, 2)) * rng.choice([0.01, 1.0])
        assert_same(ours.step(actions), theirs.step(actions))
    assert_same(ours.reset(), theirs.reset())
    assert_same(ours.reset(seed=[3, 1, 4, 1, 5]), theirs.reset(seed=[3, 1, 4, 1, 5]))
    assert ours.np_random_seed == theirs.np_random_seed


@pytest.mark.parametrize("n_dims", [1, 3])
def test_same_numbers_in_other_dimensions(n_dims):
    t = np.linspace(0, 1, 100)[:, None]
    paths = [s * (1 - t) * np.cos(3 * t + np.arange(n_dims)) for s in (1.0, 1.2)]
    demos = iflow_gym.Demonstrations.from_arrays(paths, dt=0.01)
    ours = PointMassVectorEnv(demos, N)
    theirs = gymnasium.vector.SyncVectorEnv([lambda: PointMassEnv(demos)] * N)
    assert_same(ours.reset(seed=0), theirs.reset(seed=0))
    rng = np.random.default_rng(0)
    for _ in range(120):
        actions = rng.uniform(-1, 1, (N, n_dims)) * 0.2
        assert_same(ours.step(actions), theirs.step(actions))


def test_float32_actions_give_the_same_numbers():
    ours, theirs = pair()
    assert_same(ours.reset(seed=0), theirs.reset(seed=0))
    ours.action_space.seed(0)
    for _ in range(10):
        actions = ours.action_space.sample()
        assert_same(ours.step(actions), theirs.step(actions))


def test_spaces_and_metadata():
    ours, theirs = pair(control_mode="force")
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.single_observation_space == theirs.single_observation_space
    assert ours.metadata["autoreset_mode"] == theirs.metadata["autoreset_mode"]
    assert isinstance(ours, PointMassVectorEnv)


def test_reset_options():
    env, theirs = pair()
    demos = load_lasa("Angle")
    indices = np.array([6, 0, 3, 3, 1])
    x, info = env.reset(options={"demonstration": indices})
    np.testing.assert_array_equal(x, demos.starts[indices])
    np.testing.assert_array_equal(info["dt"], np.array(demos.dt)[indices])
    np.testing.assert_array_equal(env.dt, info["dt"])
    starts = np.random.default_rng(0).normal(size=(N, 2))
    x, info = env.reset(options={"start": starts})
    np.testing.assert_array_equal(x, starts)
    np.testing.assert_array_equal(info["demonstration"], -1)
    one = {"demonstration": 2, "start": np.array([1.0, 2.0])}
    assert_same(env.reset(options=one), theirs.reset(options=one))


def test_reset_mask():
    ours, theirs = pair(horizon=10)
    for env in (ours, theirs):
        env.reset(seed=1)
    mask = np.array([True, False, False, True, False])
    actions = np.full((N, 2), 0.05)
    for _ in range(4):
        assert_same(ours.step(actions), theirs.step(actions))
    options = [{"reset_mask": mask, "demonstration": 1} for _ in range(2)]
    assert_same(ours.reset(seed=5, options=options[0]), theirs.reset(seed=5, options=options[1]))
    for _ in range(9):
        assert_same(ours.step(actions), theirs.step(actions))


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"demonstration": [0, 1]}, TypeError, "or 5 of them"),
        ({"demonstration": [0, 1, 2, 3, 7]}, ValueError, "from 0 to 6"),
        ({"start": np.zeros((2, 2))}, ValueError, r"shape \(2,\) or \(5, 2\), got \(2, 2\)"),
        ({"reset_mask": [True] * 5}, TypeError, "boolean array"),
        ({"reset_mask": np.zeros(5, dtype=bool)}, ValueError, "true at least once"),
        ({"nothing": 1}, ValueError, "Expected reset options among"),
    ],
)
def test_reset_option_errors(options, error, match):
    env, _ = pair()
    with pytest.raises(error, match=match):
        env.reset(options=options)


def test_other_errors():
    env, _ = pair()
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros((N, 2)))
    with pytest.raises(ValueError, match="one for each of 5 environments"):
        env.reset(seed=[1, 2])
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"shape \(5, 2\), got \(2, 5\)"):
        env.step(np.zeros((2, 5)))
    with pytest.raises(ValueError, match="finite action"):
        env.step(np.full((N, 2), np.nan))
    with pytest.raises(ValueError, match="num_envs >= 1"):
        PointMassVectorEnv(load_lasa("Angle"), 0)
    with pytest.raises(ValueError, match="vectorization_mode='sync'"):
        PointMassVectorEnv(load_lasa("Angle"), 2, render_mode="rgb_array")
