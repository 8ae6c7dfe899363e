"""The disturbed point mass: its plant, its wind, its batch, its reward."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from scipy.integrate import solve_ivp

import iflow_gym
from iflow_gym.datasets.lasa import SHAPES, load_lasa
from iflow_gym.datasets.letters import load_letter
from iflow_gym.envs.disturbed import DisturbedEnv, DisturbedVectorEnv, Wind
from iflow_gym.envs.point_mass import PointMassEnv
from iflow_gym.envs.task import Push
from iflow_gym.registration import disturbed_id

ANGLE = disturbed_id("Angle")
STILL = Wind(strength=0.0, curl=0.0)


def spiral(d=3):
    t = np.linspace(0, 1, 100)[:, None]
    paths = [s * (1 - t) * np.cos(3 * t + np.arange(d)) for s in (1.0, 1.2)]
    return iflow_gym.Demonstrations.from_arrays(paths, dt=0.01)


def test_every_shape_is_registered():
    for shape in SHAPES:
        spec = gymnasium.spec(disturbed_id(shape))
        assert spec.kwargs == {"shape": shape}
        assert spec.vector_entry_point.endswith("DisturbedLASAVectorEnv")


@pytest.mark.parametrize("env_id", [ANGLE, disturbed_id("Multi_Models_2")])
def test_gymnasium_and_stable_baselines_accept_it(env_id):
    check_env(gymnasium.make(env_id).unwrapped, skip_render_check=True)
    sb3 = pytest.importorskip("stable_baselines3.common.env_checker")
    sb3.check_env(gymnasium.make(env_id), warn=True, skip_render_check=True)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_undisturbed_it_is_the_point_mass_in_force_mode(d):
    demos = spiral(d)
    ours = DisturbedEnv(demos, mass_ratio=1.0, damping_ratio=1.0, wind=STILL)
    theirs = PointMassEnv(demos, control_mode="force")
    rng = np.random.default_rng(0)
    first, _ = ours.reset(seed=3)
    np.testing.assert_array_equal(first, theirs.reset(seed=3)[0])
    for _ in range(50):
        action = rng.uniform(-2, 2, d)
        made, expected = ours.step(action)[0], theirs.step(action)[0]
        np.testing.assert_allclose(made, expected, rtol=1e-12, atol=1e-12)
        command = rng.normal(size=d)
        at = rng.normal(size=2 * d)
        np.testing.assert_array_equal(
            ours.command_to_action(command, at), theirs.command_to_action(command, at)
        )


def test_a_step_is_the_solution_of_the_plants_equation():
    """m' dv/dt = F + F_wind(x_0) - c' v, with the wind of the step's beginning held."""
    env = gymnasium.make(ANGLE, mass_ratio=2.5, damping_ratio=0.7).unwrapped
    state, _ = env.reset(seed=1)
    mass, damping = 2.5 * env.mass, 0.7 * env.damping
    rng = np.random.default_rng(2)
    for _ in range(5):
        action = rng.uniform(-0.2, 0.2, 2)
        force = env.action_to_force(action) + env.wind_force(state[:2], state[2:])

        def slope(_, y, force=force):
            return np.concatenate([y[2:], (force - damping * y[2:]) / mass])

        solved = solve_ivp(slope, (0, env.dt), state, rtol=1e-10, atol=1e-12)
        state = env.step(action)[0]
        np.testing.assert_allclose(state, solved.y[:, -1], rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("wind", [Wind(), Wind(0.7, (-1.0, 2.0), -0.6, 0.1), Wind(0.0, curl=1.0)])
def test_the_wind_is_as_documented(wind):
    env = gymnasium.make(ANGLE, wind=wind).unwrapped
    demos = env.demonstrations
    rng = np.random.default_rng(0)
    x = demos.goal + rng.normal(size=(500, 2)) * demos.bounding_box.diagonal
    v = rng.normal(size=(500, 2)) * demos.peak_speed
    size = np.linalg.norm(x - demos.goal, axis=1, keepdims=True)
    square = (size / (wind.reach * demos.bounding_box.diagonal)) ** 2
    turned = np.stack([-v[:, 1], v[:, 0]], axis=1)
    steady = demos.peak_speed * wind.strength * square / (1 + square) * wind.unit(2)
    expected = env.damping * (steady + wind.curl * turned)
    np.testing.assert_allclose(env.wind_force(x, v), expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(env.wind_force(demos.goal, np.zeros(2)), np.zeros(2))
    assert Wind().unit(2) @ [0.6, -0.8] == pytest.approx(1.0)


@pytest.mark.parametrize("settings", [{"horizon": 25}, {"perturbation": Push(0.05, 0.1)}])
def test_the_batch_gives_the_same_bits(settings):
    ours, theirs = (
        gymnasium.make_vec(ANGLE, num_envs=4, vectorization_mode=mode, **settings)
        for mode in ("vector_entry_point", "sync")
    )
    rng = np.random.default_rng(0)
    np.testing.assert_array_equal(ours.reset(seed=5)[0], theirs.reset(seed=5)[0])
    for _ in range(80):
        actions = rng.uniform(-1.5, 1.5, (4, 2))
        for a, b in zip(ours.step(actions)[:4], theirs.step(actions)[:4], strict=True):
            np.testing.assert_array_equal(a, b)


def test_like_keeps_the_plant():
    wind = Wind(0.3, (1.0, 0.0), 0.2)
    settings = {"mass": 2.0, "mass_ratio": 1.3, "damping_ratio": 1.1, "wind": wind}
    env = DisturbedEnv(load_lasa("Angle"), **settings)
    for other in (env.like(), env.like(3, horizon=7), DisturbedVectorEnv.like(env.like(2))):
        for name, value in settings.items():
            assert getattr(other, name) == value
        assert other.damping == env.damping
    assert env.like(3, horizon=7).num_envs == 3


def test_the_reward_is_how_well_the_recording_is_kept_at_its_own_time():
    """By its formula; and playing the recording late, early or beside it pays less than 1."""
    demos = load_lasa("Angle")
    env = DisturbedEnv(demos, mass_ratio=1.0, damping_ratio=1.0, wind=STILL, horizon=2000)
    observation, _ = env.reset(options={"demonstration": 3})
    w, w_v = 0.1 * demos.bounding_box.diagonal, 0.1 * demos.peak_speed
    rng = np.random.default_rng(0)
    for t in range(1, 1500):
        observation, reward, *_ = env.step(rng.uniform(-0.1, 0.1, 2))
        k = min(t, len(demos.positions[3]) - 1)
        off = ((observation[:2] - demos.positions[3][k]) ** 2).sum() / w**2
        off_v = ((observation[2:] - demos.velocities[3][k]) ** 2).sum() / w_v**2
        assert reward == pytest.approx(0.5 / (1 + off) + 0.5 / (1 + off_v), rel=1e-9)
    data = env.get_dataset()
    assert data["rewards"].mean() > 0.95
    env.reset(options={"demonstration": 3, "start": demos.positions[3][300]})  # early, and at rest
    assert env.step(np.zeros(2))[1] < 0.7


def test_other_starts_and_motions_that_repeat_keep_the_point_masss_reward():
    wind, still = (
        {"wind": STILL, "mass_ratio": 1.0, "damping_ratio": 1.0},
        {"control_mode": "force"},
    )
    for demos, options in ((load_lasa("Angle"), {"start": [-20.0, 5.0]}), (load_letter("O"), {})):
        ours, theirs = DisturbedEnv(demos, **wind), PointMassEnv(demos, **still)
        ours.reset(seed=0, options=options)
        theirs.reset(seed=0, options=options)
        for _ in range(20):
            action = np.array([0.02, -0.01])
            assert ours.step(action)[1] == pytest.approx(theirs.step(action)[1], abs=1e-12)


def test_bad_arguments_say_what_was_expected():
    demos = load_lasa("Angle")
    for settings, message in [
        ({"mass_ratio": 0.0}, "mass_ratio > 0"),
        ({"damping_ratio": np.nan}, "damping_ratio > 0"),
        ({"control_mode": "velocity"}, "control_mode='force'"),
        ({"wind": Wind(direction=(1.0, 0.0, 0.0))}, "2 finite components"),
        ({"wind": Wind(direction=(0.0, 0.0))}, "2 finite components"),
    ]:
        with pytest.raises(ValueError, match=message):
            DisturbedEnv(demos, **settings)
    with pytest.raises(TypeError, match="Expected wind to be a Wind"):
        DisturbedEnv(demos, wind=0.5)
    with pytest.raises(ValueError, match="reach > 0"):
        Wind(reach=0.0)
    with pytest.raises(ValueError, match="strength >= 0 and finite"):
        Wind(strength=np.inf)
    with pytest.raises(ValueError, match="finite curl"):
        Wind(curl=np.nan)
