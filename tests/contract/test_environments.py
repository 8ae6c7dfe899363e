"""Every environment keeps the contract of docs and DESIGN: one set of tests, every id."""

import copy
import functools
import importlib.util
import json
import pickle
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.utils.passive_env_checker import env_render_passive_checker
from scipy.integrate import solve_ivp

import iflow_gym
from iflow_gym.datasets.lasa import SHAPES, load_lasa
from iflow_gym.envs.dynamics import ARRAYS
from iflow_gym.envs.guide import guide_for
from iflow_gym.envs.point_mass import PointMassEnv
from iflow_gym.envs.task import ARENA, SPEED_MARGIN, Push
from iflow_gym.registration import POINT_MASS_ID, lasa_id

GOLDEN = Path(__file__).parents[1] / "golden" / "environments.py"
_spec = importlib.util.spec_from_file_location("golden_environments", GOLDEN)
golden = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(golden)

FEW = [POINT_MASS_ID, lasa_id("Angle"), lasa_id("Multi_Models_2")]
MODES = ["velocity", "force"]

every_id = pytest.mark.parametrize("env_id", golden.IDS)
few_ids = pytest.mark.parametrize("env_id", FEW)
both_modes = pytest.mark.parametrize("mode", MODES)


def make(env_id, **settings):
    return gymnasium.make(env_id, **golden.arguments(env_id), **settings)


def own(n_dims=2, **settings):
    env = PointMassEnv(golden.own_demonstrations(n_dims), **settings)
    env.reset(seed=0)
    return env


# The interface ------------------------------------------------------------------------------


def test_ids_are_all_registered():
    registered = {i for i in gymnasium.registry if i.startswith("iflow/")}
    assert set(golden.IDS) <= registered
    assert len(golden.IDS) == 35


def test_import_is_light():
    """Environments are used where torch is not; importing the package pulls in nothing heavy."""
    heavy = ("torch", "sklearn", "matplotlib", "scipy.io", "stable_baselines3")
    code = (
        "import sys, gymnasium, iflow_gym\n"
        "gymnasium.make('iflow/LASA-Angle-v0').reset()\n"
        f"print([m for m in {heavy[:3]!r} if m in sys.modules])\n"
    )
    light = f"import sys, iflow_gym\nprint([m for m in {heavy!r} if m in sys.modules])\n"
    for text in (code, light):
        out = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True)
        assert out.stdout.strip() == "[]", out.stderr


@every_id
def test_gymnasium_check_env(env_id):
    check_env(make(env_id).unwrapped, skip_render_check=True)


@few_ids
@both_modes
@pytest.mark.filterwarnings("ignore:.*needs a display:UserWarning")
def test_gymnasium_check_env_with_rendering(env_id, mode):
    check_env(make(env_id, control_mode=mode, render_mode="rgb_array").unwrapped)


@every_id
def test_stable_baselines_check_env(env_id):
    sb3 = pytest.importorskip("stable_baselines3.common.env_checker")
    sb3.check_env(make(env_id), warn=True, skip_render_check=True)


@every_id
def test_spaces(env_id):
    env = make(env_id).unwrapped
    d = env.n_dims
    assert env.action_space == gymnasium.spaces.Box(-1, 1, (d,), np.float32)
    space = env.observation_space
    assert space.shape == (d,)
    assert space.dtype == np.float64
    box = env.demonstrations.bounding_box
    sides = (space.high - space.low) / (box.high - box.low)
    assert (sides >= ARENA * (1 - 1e-12)).all()  # twice the metrics' "diverged" box, or more
    assert np.isfinite(space.low).all()
    force = make(env_id, control_mode="force").unwrapped.observation_space
    assert force.shape == (2 * d,)
    assert np.isfinite(force.low).all()


def info_keys(env):
    measured = env.unwrapped.task.guide.measured
    return ("is_success", *measured, "time", "dt", "demonstration", "pushed")


@few_ids
@both_modes
def test_info_has_the_same_keys_and_types_everywhere(env_id, mode):
    env = make(env_id, control_mode=mode, perturbation=Push())
    _, first = env.reset(seed=0)
    infos = [env.step(env.action_space.sample())[-1] for _ in range(100)]
    assert tuple(first) == info_keys(env)
    for info in infos:
        assert {k: type(v) for k, v in info.items()} == {k: type(v) for k, v in first.items()}


@pytest.mark.parametrize("wrapper", [copy.deepcopy, lambda e: pickle.loads(pickle.dumps(e))])
def test_environments_copy_and_pickle(wrapper):
    env = make(POINT_MASS_ID, perturbation=Push())
    env.reset(seed=3)
    twin = wrapper(env)
    action = np.array([0.3, -0.2])
    for _ in range(5):
        np.testing.assert_array_equal(env.step(action)[0], twin.step(action)[0])


def test_spec_makes_the_same_environment():
    env = make(lasa_id("Sine"), perturbation=Push(size=0.1), control_mode="force")
    twin = gymnasium.make(env.spec)
    np.testing.assert_array_equal(env.reset(seed=1)[0], twin.reset(seed=1)[0])


def test_spawned_subprocesses_make_environments():
    vec_env = pytest.importorskip("stable_baselines3.common.vec_env")
    function = functools.partial(gymnasium.make, "iflow_gym:iflow/LASA-Angle-v0")
    envs = vec_env.SubprocVecEnv([function, function], start_method="spawn")
    try:
        envs.seed(5)
        observations = envs.reset()
        observations, rewards, _, infos = envs.step(np.zeros((2, 2), dtype=np.float32))
        assert observations.shape == (2, 2)
        assert observations.dtype == np.float64
        assert rewards.tolist() == [0.0, 0.0]
        assert {"is_success", "distance_to_goal", "time"} <= set(infos[0])
    finally:
        envs.close()


# Reproducibility ----------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", [*golden.IDS, *golden.DISTURBED])
def test_golden_rollouts(env_id):
    """A hash that moves means that scores may move: bump the id's -vN (see golden/)."""
    assert golden.rollout_hash(env_id) == json.loads(golden.PATH.read_text())[env_id]


def test_same_seed_gives_the_same_episode_in_another_process():
    code = (
        "import importlib.util as u\n"
        f"s = u.spec_from_file_location('golden', {str(GOLDEN)!r})\n"
        "g = u.module_from_spec(s); s.loader.exec_module(g)\n"
        f"print([g.rollout_hash(i) for i in {FEW!r}])\n"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == str([golden.rollout_hash(i) for i in FEW])


@few_ids
def test_different_seeds_give_different_starts(env_id):
    env = make(env_id)
    starts = {tuple(env.reset(seed=s)[0]) for s in range(8)}
    assert len(starts) == 8


# Motion -------------------------------------------------------------------------------------


@every_id
def test_replay_gives_the_recordings_back(env_id):
    env = make(env_id).unwrapped
    demos = env.demonstrations.shown
    dataset = env.get_dataset()
    expected = np.concatenate([p[1:] for p in demos.positions])
    np.testing.assert_allclose(dataset["next_observations"], expected, rtol=0, atol=1e-9)
    assert dataset["timeouts"].sum() == len(demos)
    assert not dataset["terminals"].any()
    assert (np.abs(dataset["actions"]) < 1).all()


@few_ids
@both_modes
def test_dataset_actions_reproduce_its_observations(env_id, mode):
    env = make(env_id, control_mode=mode).unwrapped
    data = env.get_dataset()
    steps = [len(p) - 1 for p in env.demonstrations.positions]
    assert {len(v) for v in data.values()} == {sum(steps)}
    begins = np.flatnonzero(np.r_[True, data["timeouts"][:-1]])
    for index in (0, len(begins) - 1):
        observation, _ = env.reset(options={"demonstration": index})
        for k in range(begins[index], begins[index] + steps[index]):
            np.testing.assert_array_equal(observation, data["observations"][k])
            observation, reward, _, truncated, _ = env.step(data["actions"][k])
            np.testing.assert_array_equal(observation, data["next_observations"][k])
            assert reward == data["rewards"][k]
            assert truncated == data["timeouts"][k]


@every_id
def test_force_mode_tracks_the_recordings(env_id):
    """Default mass, damping and force are chosen so: within half a percent of the diagonal.

    Within one for letters, which are traced in pulses of ten samples.
    """
    env = make(env_id, control_mode="force").unwrapped
    starts = np.concatenate([p[:-1] for p in env.demonstrations.shown.positions])
    positions = env.get_dataset()["observations"][:, : env.n_dims]
    assert (
        np.linalg.norm(positions - starts, axis=1).max()
        < (0.005 if env.demonstrations.period is None else 0.01) * env.task.diagonal
    )


def test_dataset_of_the_generalisation_split():
    env = make(lasa_id("Angle")).unwrapped
    parts = {part: env.get_dataset("generalisation", part) for part in ("fit", "score")}
    assert {part: int(d["timeouts"].sum()) for part, d in parts.items()} == {"fit": 4, "score": 3}
    start = env.demonstrations.positions[4][0]
    np.testing.assert_array_equal(parts["score"]["observations"][0], start)
    with pytest.raises(ValueError, match="Expected part fit or score"):
        env.get_dataset("generalisation", "test")


def test_action_is_velocity_over_max_speed():
    env = own()
    x, _ = env.reset(options={"demonstration": 1})
    assert env.max_speed == SPEED_MARGIN * env.demonstrations.peak_speed
    y, *_ = env.step(np.array([0.25, -0.5]))
    np.testing.assert_allclose(y - x, env.dt * env.max_speed * np.array([0.25, -0.5]), rtol=1e-12)
    np.testing.assert_allclose((y - x) / env.dt, env.action_to_velocity([0.25, -0.5]), rtol=1e-12)


@both_modes
def test_actions_beyond_the_box_are_scaled_not_clipped(mode):
    env = own(control_mode=mode)
    ends = []
    for action in ([0.5, -1.0], [2.0, -4.0]):
        env.reset(options={"demonstration": 0})
        ends.append(env.step(np.array(action))[0])
    np.testing.assert_array_equal(*ends)


def test_float64_actions_keep_their_precision():
    env = own()
    x, _ = env.reset(options={"demonstration": 0})
    tiny = np.array([1e-12, 0.5])
    y, *_ = env.step(tiny)
    assert y[1] - x[1] == pytest.approx(env.dt * env.max_speed * 0.5, rel=1e-12)
    env.reset(options={"start": np.array([0.0, 0.0])})
    y, *_ = env.step(tiny)
    assert y[0] == pytest.approx(env.dt * env.max_speed * 1e-12, rel=1e-12)


def test_conversions_are_inverse():
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (5, 2))
    env, pushed = own(), own(control_mode="force")
    np.testing.assert_allclose(
        env.velocity_to_action(env.action_to_velocity(actions)), actions, rtol=1e-12
    )
    np.testing.assert_allclose(
        pushed.force_to_action(pushed.action_to_force(actions)), actions, rtol=1e-12
    )
    fast = env.velocity_to_action([3 * env.max_speed, -6 * env.max_speed])
    np.testing.assert_allclose(fast, [0.5, -1.0])
    with pytest.raises(ValueError, match="use command_to_action"):
        pushed.velocity_to_action(actions)
    with pytest.raises(ValueError, match="use velocity_to_action"):
        env.action_to_force(actions)


def test_force_mode_solves_the_equation_of_motion():
    env = own(control_mode="force", mass=2.0, damping=7.0)
    action = np.array([0.02, -0.03])
    start, _ = env.reset(options={"demonstration": 0})
    force = env.action_to_force(action)

    def rate(_, state):
        return np.concatenate([state[2:], (force - 7.0 * state[2:]) / 2.0])

    state = start
    for _ in range(60):
        state, *_ = env.step(action)
    exact = solve_ivp(rate, (0, 60 * env.dt), start, rtol=1e-11, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(state, exact, rtol=1e-8)


def test_force_mode_approaches_terminal_speed_exponentially():
    env = own(control_mode="force", mass=1.0, damping=20.0, horizon=10_000)
    env.reset(options={"start": np.array([0.0, 0.0])})
    action = np.array([0.1, 0.05])
    for k in range(1, 30):
        state, *_ = env.step(action)
        terminal = action * env.max_force / env.damping
        expected = terminal * (1 - np.exp(-20.0 * k * env.dt))
        np.testing.assert_allclose(state[2:], expected, rtol=1e-12)
    np.testing.assert_allclose(env.max_force / env.damping, env.max_speed)


def test_command_to_action_reaches_the_commanded_velocity():
    env = own(control_mode="force")
    state, _ = env.reset(options={"demonstration": 0})
    command = state[2:] + 0.05 * env.demonstrations.peak_speed
    state, *_ = env.step(env.command_to_action(command, state))
    np.testing.assert_allclose(state[2:], command, rtol=1e-12)
    assert np.abs(env.command_to_action(100 * command, state)).max() == 1.0
    with pytest.raises(ValueError, match=r"shape \(\.\.\., 4\) in force mode, got \(2,\)"):
        env.command_to_action(command, state[:2])


@both_modes
def test_walls_stop_the_mass(mode):
    env = own(control_mode=mode, horizon=20_000)
    env.reset(seed=0)
    for _ in range(2000):
        state, *_ = env.step(np.array([1.0, 0.5]))
        assert state in env.observation_space
    np.testing.assert_array_equal(state[:2], env.observation_space.high[:2])
    if mode == "force":
        np.testing.assert_array_equal(state[2:], [0.0, 0.0])


@pytest.mark.parametrize("n_dims", [1, 3, 4])
@both_modes
def test_other_dimensions(n_dims, mode):
    env = own(n_dims, control_mode=mode)
    check_env(env, skip_render_check=True, skip_close_check=True)
    rewards = env.get_dataset()["rewards"]
    assert rewards.mean() > 0.9
    with pytest.raises(ValueError, match="Expected demonstrations in the plane to render"):
        PointMassEnv(env.demonstrations, render_mode="rgb_array")


# Episodes -----------------------------------------------------------------------------------


@every_id
def test_an_episode_lasts_as_long_as_the_demonstration(env_id):
    env = make(env_id)
    demos = env.unwrapped.demonstrations
    index = len(demos) - 1
    _, info = env.reset(options={"demonstration": index})
    assert info["dt"] == demos.dt[index] == env.unwrapped.dt
    assert info["demonstration"] == index
    for k in range(1, len(demos.positions[index])):
        _, _, terminated, truncated, info = env.step(np.zeros(2, dtype=np.float32))
        assert not terminated
        assert truncated == (k == len(demos.positions[index]) - 1)
    assert info["time"] == pytest.approx(demos.durations[index])


def test_horizon_argument():
    env = own(horizon=3)
    assert [env.step(np.zeros(2))[3] for _ in range(3)] == [False, False, True]


def test_reset_starts():
    env = own()
    demos = env.demonstrations
    for i, path in enumerate(demos.positions):
        np.testing.assert_array_equal(env.reset(options={"demonstration": i})[0], path[0])
    start = np.array([0.3, 0.2])
    x, info = env.reset(options={"start": start})
    np.testing.assert_array_equal(x, start)
    assert (info["demonstration"], info["dt"]) == (-1, demos.mean_dt)
    x, info = env.reset(options={"start": start, "demonstration": 2})
    np.testing.assert_array_equal(x, start)
    assert (info["demonstration"], info["dt"]) == (2, demos.dt[2])


def test_force_mode_starts_with_the_demonstrations_velocity():
    env = own(control_mode="force")
    state, _ = env.reset(options={"demonstration": 1})
    np.testing.assert_array_equal(state[2:], env.demonstrations.velocities[1][0])
    state, _ = env.reset(options={"start": [0.0, 0.0]})
    np.testing.assert_array_equal(state[2:], [0.0, 0.0])


def test_start_noise_is_a_fraction_of_the_diagonal():
    env = own(start_noise=0.05)
    offsets = []
    for seed in range(400):
        x, info = env.reset(seed=seed)
        offsets.append(x - env.demonstrations.positions[info["demonstration"]][0])
    deviation = np.std(offsets) / env.task.diagonal
    assert deviation == pytest.approx(0.05, rel=0.1)  # 800 normal numbers: 2.5 % is one sigma
    exact = own(start_noise=0.0)
    x, info = exact.reset(seed=0)
    np.testing.assert_array_equal(x, exact.demonstrations.positions[info["demonstration"]][0])


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"demo": 1}, ValueError, r"Expected reset options among .*got \['demo'\]"),
        ({"demonstration": 3}, ValueError, r"from 0 to 2 \(3 recordings of 'spiral'\), got 3"),
        ({"demonstration": -1}, ValueError, "got -1"),
        ({"demonstration": 0.5}, TypeError, "whole number from 0 to 2, got 0.5"),
        ({"start": [0.0]}, ValueError, r"shape \(2,\) or \(1, 2\), got \(1,\)"),
        ({"start": [0.0, 1e9]}, ValueError, "inside the box from"),
        ({"start": [0.0, np.nan]}, ValueError, "inside the box from"),
        ({"start": "here"}, TypeError, "to be numbers, got 'here'"),
    ],
)
def test_reset_option_errors(options, error, match):
    with pytest.raises(error, match=match):
        own().reset(options=options)


@pytest.mark.parametrize(
    ("settings", "error", "match"),
    [
        ({"control_mode": "torque"}, ValueError, "'velocity' or 'force', got 'torque'"),
        ({"horizon": 0}, ValueError, "steps >= 1, got 0"),
        ({"horizon": 2.5}, ValueError, "got 2.5"),
        ({"start_noise": -1.0}, ValueError, "start_noise >= 0"),
        ({"perturbation": 0.4}, TypeError, "to be a Push or None, got 0.4"),
        ({"perturbation": Push(direction=(1.0,))}, ValueError, "2 finite components"),
        ({"control_mode": "force", "mass": 0.0}, ValueError, "mass > 0"),
        ({"control_mode": "force", "damping": -1.0}, ValueError, "damping > 0"),
        ({"render_mode": "ansi"}, ValueError, "'rgb_array' or 'human', got 'ansi'"),
    ],
)
def test_argument_errors(settings, error, match):
    with pytest.raises(error, match=match):
        own(**settings)


def test_demonstrations_argument_is_checked():
    with pytest.raises(TypeError, match=r"Demonstrations\.from_arrays"):
        PointMassEnv([np.zeros((5, 2))])


@pytest.mark.parametrize(
    ("action", "match"),
    [
        (np.zeros(3), r"shape \(2,\), got \(3,\)"),
        (np.zeros((1, 2)), r"shape \(2,\), got \(1, 2\)"),
        (np.float64(0.0), r"shape \(2,\), got \(\)"),
        (np.array([0.0, np.nan]), "finite action.*the policy gave NaN"),
        (np.array([np.inf, 0.0]), "finite action"),
    ],
)
def test_action_errors(action, match):
    with pytest.raises(ValueError, match=match):
        own().step(action)


def test_step_before_reset():
    with pytest.raises(gymnasium.error.ResetNeeded, match="Call reset"):
        PointMassEnv(golden.own_demonstrations()).step(np.zeros(2))


# Pushes -------------------------------------------------------------------------------------


@both_modes
def test_a_push_displaces_once_by_its_size(mode):
    push = Push(fraction=0.4, size=0.25)
    plain, pushed = own(control_mode=mode), own(control_mode=mode, perturbation=push)
    action = np.array([0.01, 0.02])
    for env in (plain, pushed):
        env.reset(seed=4, options={"demonstration": 0})
    jumps = []
    for k in range(1, 200):
        x, *_, info = pushed.step(action)
        jumps.append(x[:2] - plain.step(action)[0][:2])
        assert info["pushed"] == (k >= round(0.4 * 199))
    sizes = np.linalg.norm(np.diff([np.zeros(2), *jumps], axis=0), axis=1)
    at = round(0.4 * 199) - 1
    assert sizes[at] == pytest.approx(0.25 * plain.task.diagonal, rel=1e-12)
    assert np.delete(sizes, at).max() < 1e-12


def test_pushes_are_seeded():
    def end(seed):
        env = own(perturbation=Push(fraction=0.01))
        env.reset(seed=seed, options={"demonstration": 0})
        return tuple(env.step(np.zeros(2))[0] + env.step(np.zeros(2))[0])

    assert end(1) == end(1)
    assert len({end(seed) for seed in range(5)}) == 5


def test_a_push_can_have_a_direction():
    env = own(perturbation=Push(fraction=1e-9, size=0.5, direction=(0.0, -3.0)))
    x, _ = env.reset(options={"demonstration": 0})
    y, *_ = env.step(np.zeros(2))
    np.testing.assert_allclose(y - x, [0.0, -0.5 * env.task.diagonal], atol=1e-12)


@pytest.mark.parametrize("settings", [{"fraction": 0.0}, {"fraction": 1.5}, {"size": -1.0}])
def test_push_errors(settings):
    with pytest.raises(ValueError, match="Expected a push's"):
        Push(**settings)


# Rewards ------------------------------------------------------------------------------------


@every_id
def test_rewards_of_replaying_standing_and_oscillating(env_id):
    env = make(env_id).unwrapped
    data = env.get_dataset()
    ends = np.flatnonzero(data["timeouts"]) + 1
    replay = [r.mean() for r in np.split(data["rewards"], ends[:-1])]
    # A round of a letter lies among others of another tempo, which a cycle's reward compares with.
    assert min(replay) >= (0.9 if env.demonstrations.period is None else 0.75)
    assert np.abs(data["rewards"]).max() <= 1

    envs = gymnasium.make_vec(env_id, num_envs=len(env.demonstrations), **golden.arguments(env_id))
    indices = np.arange(envs.num_envs)
    middles = np.stack([p[len(p) // 2] for p in env.demonstrations.positions])
    along = np.stack([v[len(v) // 2] for v in env.demonstrations.velocities]) / env.max_speed
    for start in (env.demonstrations.starts, middles):
        for action in (np.zeros_like(along), along, 3 * along, np.full_like(along, 1.0)):
            envs.reset(options={"demonstration": indices, "start": start})
            sign = np.where(np.arange(100) % 2, -1, 1)
            rewards = np.mean([envs.step(s * action)[1] for s in sign], axis=0)
            far = np.ones(len(start), dtype=bool)
            if env.demonstrations.goal is not None:
                away = np.linalg.norm(start - env.demonstrations.goal, axis=1)
                far = away > 0.1 * envs.task.diagonal
            assert np.abs(rewards[far]).max() <= (0.05 if not action.any() else 0.1)


def test_rewards_are_antisymmetric_bounded_and_markov():
    """Undoing a step costs what it paid: r(x, x') = -r(x', x), to the last bit."""
    rng = np.random.default_rng(0)
    for shape in ("Angle", "heee", "Multi_Models_1"):
        demos = load_lasa(shape)
        guide = guide_for(demos)
        x = rng.uniform(-200, 200, (2, 20_000))
        y = x + rng.normal(0, 1, x.shape) * rng.choice([0.01, 1.0, 100.0], 20_000)
        dt = np.full(20_000, demos.mean_dt)
        away = np.full(20_000, np.inf)
        there = guide.reward(ARRAYS, list(x), list(y), dt, away)
        back = guide.reward(ARRAYS, list(y), list(x), dt, away)
        np.testing.assert_array_equal(there, -back)
        assert np.abs(there).max() <= 1


def test_faster_than_demonstrated_pays_no_more():
    env = own()
    path, velocity = env.demonstrations.positions[0], env.demonstrations.velocities[0]
    rewards = []
    for factor in (0.5, 1.0, 2.0):
        env.reset(options={"demonstration": 0, "start": path[80]})
        rewards.append(env.step(env.velocity_to_action(factor * velocity[80]))[1])
    assert rewards[0] == pytest.approx(0.5, abs=0.05)
    assert rewards[1] == pytest.approx(1.0, abs=0.05)
    assert rewards[2] == pytest.approx(1.0, abs=0.05)


@few_ids
def test_staying_at_the_goal_pays_and_coming_back_pays(env_id):
    env = make(env_id).unwrapped
    goal = env.demonstrations.attractor
    env.reset(options={"start": goal})
    _, reward, *_, info = env.step(np.zeros(2))
    assert (reward, info["is_success"], info["distance_to_goal"]) == (1.0, True, 0.0)
    corner = env.demonstrations.bounding_box.high + 3 * env.task.diagonal
    for sign in (1, -1):
        env.reset(options={"start": corner})
        home = env.demonstrations.positions[0][len(env.demonstrations.positions[0]) // 2] - corner
        reward = env.step(sign * home / np.abs(home).max())[1]
        assert sign * reward > 0.8


def test_a_push_is_not_charged_to_its_step():
    plain, pushed = own(), own(perturbation=Push(fraction=1e-9))
    rewards = []
    for env in (plain, pushed):
        env.reset(seed=0, options={"demonstration": 0})
        rewards.append(env.step(np.array([0.01, 0.0]))[1])
    assert rewards[0] == rewards[1]


# Pictures -----------------------------------------------------------------------------------


@few_ids
@both_modes
def test_frames_show_the_mass(env_id, mode):
    env = make(env_id, control_mode=mode, render_mode="rgb_array")
    env.reset(seed=0)
    env_render_passive_checker(env.unwrapped)
    before = env.render()
    again = env.render()
    for _ in range(40):
        env.step(np.array([0.2, 0.1]))
    after = env.render()
    assert before.dtype == np.uint8
    assert before.shape == (600, 600, 3)
    np.testing.assert_array_equal(before, again)
    changed = (before != after).any(axis=-1)
    assert 50 < changed.sum() < 0.2 * changed.size  # the mass, its trail and the clock
    env.close()


def test_streamlines_of_a_policy_are_drawn():
    class Contraction:
        def velocity(self, x):
            return -np.asarray(x)

    plain, drawn = (own(render_mode="rgb_array", policy=p) for p in (None, Contraction()))
    assert (plain.render() != drawn.render()).mean() > 0.05
    with pytest.raises(TypeError, match=r"Expected policy to have velocity\(x\)"):
        own(render_mode="rgb_array", policy=object()).render()


def test_a_window_without_a_display_says_so():
    pyplot = pytest.importorskip("matplotlib.pyplot")
    pyplot.switch_backend("agg")
    with pytest.warns(UserWarning, match="use render_mode='rgb_array'"):
        env = own(render_mode="human")
    env.step(np.zeros(2))
    env.close()
    assert not pyplot.get_fignums()


def test_render_without_a_mode_says_what_to_do():
    with pytest.warns(UserWarning, match="pass render_mode='rgb_array'"):
        assert own().render() is None


def test_package_exports():
    from iflow_gym.system import DynamicalSystem

    assert iflow_gym.DynamicalSystem is DynamicalSystem
    assert iflow_gym.load_lasa("Angle") is load_lasa("Angle")
    assert all(hasattr(iflow_gym, name) for name in iflow_gym.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        iflow_gym.nothing  # noqa: B018
    assert len(SHAPES) == 30
