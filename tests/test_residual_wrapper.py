"""Residuals in environments: the base's bits without one, the same numbers single and batched."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from iflow_gym.baselines.dmp import DMP
from iflow_gym.baselines.imitation_flow import ImitationFlow
from iflow_gym.datasets.drums import load_drums
from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.datasets.letters import load_letter
from iflow_gym.policy import DynamicalSystemPolicy, policy_of
from iflow_gym.residual import ResidualActionWrapper, ResidualPolicy, ResidualVectorWrapper
from iflow_gym.residual.policy import Zero

LASA, FORCE, DISTURBED = "iflow/LASA-Angle-v0", "force", "iflow/Disturbed-Angle-v0"
LETTER, DRUMMING = "iflow/Letter-O-v0", "iflow/Drumming-v0"
CASES = [
    (LASA, {}),
    (LASA, {"control_mode": FORCE}),
    (DISTURBED, {}),
    (LETTER, {}),
    (DRUMMING, {"horizon": 60}),
    (DRUMMING, {"horizon": 60, "control_mode": "torque"}),
]
every_case = pytest.mark.parametrize(
    ("env_id", "settings"), CASES, ids=[f"{i[6:-3]}-{s.get('control_mode', '')}" for i, s in CASES]
)


@pytest.fixture(scope="module")
def bases():
    fit = ImitationFlow(n_steps=30)
    angle = fit.fit(load_lasa("Angle"), seed=0)
    letter = ImitationFlow(n_steps=30).fit(load_letter("O"), seed=0)
    drums = ImitationFlow(n_steps=30).fit(load_drums(), seed=0)
    return {LASA: angle, DISTURBED: angle, LETTER: letter, DRUMMING: drums}


@every_case
def test_without_a_residual_it_is_the_base_bit_for_bit(env_id, settings, bases):
    base = bases[env_id]
    env = gymnasium.make(env_id, **settings)
    wrapped = ResidualActionWrapper(gymnasium.make(env_id, **settings), base, stable=True)
    policy = DynamicalSystemPolicy(base, env)
    observation, _ = env.reset(seed=4)
    wrapped.reset(seed=4)
    for _ in range(40):
        observation, reward, _, _, info = env.step(policy.predict(observation)[0])
        _, ours, _, _, told = wrapped.step(np.zeros(env.unwrapped.n_dims))
        assert ours == reward
        np.testing.assert_array_equal(told["command"], told["base_command"])
        np.testing.assert_array_equal(wrapped._observation, observation)
        assert (
            told["distance_to_goal" if base.period_ is None else "phase"]
            == info["distance_to_goal" if base.period_ is None else "phase"]
        )


@every_case
@pytest.mark.filterwarnings("ignore:.*different from the unwrapped version:UserWarning")
def test_checkers_accept_it(env_id, settings, bases):
    env = ResidualActionWrapper(gymnasium.make(env_id, **settings), bases[env_id])
    check_env(env, skip_render_check=True)
    sb3 = pytest.importorskip("stable_baselines3.common.env_checker")
    sb3.check_env(env, warn=True, skip_render_check=True)


def vector(env_id, n, **settings):
    if gymnasium.spec(env_id).vector_entry_point is None:
        return gymnasium.make_vec(env_id, n, "sync", **settings)
    return gymnasium.make_vec(env_id, n, "vector_entry_point", **settings)


@pytest.mark.parametrize("stable", [False, True])
@pytest.mark.parametrize(
    ("env_id", "settings"),
    [(LASA, {"horizon": 9}), (DISTURBED, {"horizon": 9}), (LETTER, {}), (DRUMMING, {"horizon": 9})],
)
def test_the_batch_gives_the_numbers_of_single_ones(env_id, settings, stable, bases):
    """Across the ends of episodes, too: those begin anew in the step after."""
    base, n = bases[env_id], 3
    batch = ResidualActionWrapper(vector(env_id, n, **settings), base, stable=stable)
    assert isinstance(batch, ResidualVectorWrapper)
    singles = [
        ResidualActionWrapper(gymnasium.make(env_id, **settings), base, stable=stable)
        for _ in range(n)
    ]
    seen, _ = batch.reset(seed=2)
    alone = np.stack([env.reset(seed=2 + i)[0] for i, env in enumerate(singles)])
    np.testing.assert_allclose(seen, alone, rtol=1e-5, atol=1e-6)
    assert seen.dtype == np.float32
    rng, ended = np.random.default_rng(0), [False] * n
    for _ in range(14):
        actions = rng.uniform(-1, 1, (n, singles[0].unwrapped.n_dims))
        seen, rewards, _, truncated, _ = batch.step(actions)
        for i, env in enumerate(singles):
            if ended[i]:
                own, ended[i] = env.reset()[0], False
            else:
                own, reward, _, ended[i], _ = env.step(actions[i])
                assert rewards[i] == pytest.approx(reward, abs=1e-9)
            assert truncated[i] == ended[i]
            np.testing.assert_allclose(seen[i], own, rtol=1e-5, atol=2e-6)


def test_the_residual_is_added_to_the_command():
    env = ResidualActionWrapper(gymnasium.make(LASA), None, scale=0.2)
    env.reset(seed=0)
    x = env._observation.copy()
    _, _, _, _, info = env.step(np.array([0.5, -1.0]))
    task = env.unwrapped
    np.testing.assert_allclose(info["command"], 0.2 * task.max_speed * np.array([0.5, -1.0]))
    np.testing.assert_allclose(env._observation - x, task.dt * info["command"], rtol=1e-12)
    _, _, _, _, info = env.step(np.array([9.0, 0.0]))
    assert info["command"][0] == 0.2 * task.max_speed


@pytest.mark.parametrize("kind", ["system", "primitive"])
def test_methods_and_their_policies_are_the_same_base(kind, bases):
    base = bases[LASA] if kind == "system" else DMP().fit(load_lasa("Angle"), seed=0)
    plain = vector(LASA, 3)
    policy = policy_of(base, plain)
    wrapped = [ResidualActionWrapper(vector(LASA, 3), b) for b in (base, policy)]
    observation, _ = plain.reset(seed=1)
    for env in wrapped:
        env.reset(seed=1)
    state = None
    for _ in range(30):
        actions, state = policy.predict(observation, state)
        observation = plain.step(actions)[0]
        for env in wrapped:
            env.step(np.zeros((3, 2)))
            np.testing.assert_allclose(env._observation, observation, rtol=1e-12, atol=1e-9)


def test_a_policy_that_is_known_by_its_actions_alone_is_a_base_in_velocity_mode():
    class Eastward:
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return np.tile([3.0, 1.5], (len(observation), 1)), state

    env = ResidualActionWrapper(gymnasium.make(LASA), Eastward())
    _, info = env.reset(seed=0)
    speed = env.unwrapped.max_speed
    np.testing.assert_array_equal(info["base_command"], [speed, speed / 2])


def test_a_primitives_clock_starts_anew_with_each_episode_and_under_a_mask(bases):
    primitive = DMP().fit(load_lasa("Angle"), seed=0)
    envs = ResidualActionWrapper(vector(LASA, 3, horizon=5), primitive)
    envs.reset(seed=0)
    nothing = np.zeros((3, 2))
    for _ in range(5):
        _, _, _, truncated, _ = envs.step(nothing)
    assert truncated.all()
    assert (envs._memory["phase"] > 0.003).all()
    envs.step(nothing)  # begins anew
    once = envs._memory["phase"].copy()
    envs.step(nothing)
    mask = np.array([True, False, False])
    going_on = envs._memory["phase"].copy()
    envs.reset(options={"reset_mask": mask})
    assert envs._memory["phase"][0] == pytest.approx(once[0], rel=0.2)
    np.testing.assert_array_equal(envs._memory["phase"][1:], going_on[1:])


def test_a_policy_does_what_the_wrapper_does(bases):
    """With the same agent: what is trained in the wrapper is what is scored."""

    class Agent:
        def predict(self, features, state=None, episode_start=None, deterministic=True):
            return np.sin(7 * features[..., :2]), state

    for stable in (False, 0.5):
        envs = vector(DISTURBED, 4)
        wrapped = ResidualActionWrapper(vector(DISTURBED, 4), bases[LASA], stable=stable)
        policy = ResidualPolicy(Agent(), bases[LASA], stable=stable).for_environment(envs)
        observation, _ = envs.reset(seed=0)
        features, _ = wrapped.reset(seed=0)
        state = None
        for _ in range(25):
            action, state = policy.predict(observation, state)
            observation, reward, *_ = envs.step(action)
            features, ours, *_ = wrapped.step(Agent().predict(features)[0])
            np.testing.assert_array_equal(wrapped._observation, observation)
            np.testing.assert_array_equal(ours, reward)


def test_other_demonstrations_are_refused(bases):
    trained_on = load_lasa("Angle").sha256
    policy = ResidualPolicy(Zero(2), bases[LASA], demonstrations=trained_on)
    policy.for_environment(gymnasium.make(DISTURBED))
    with pytest.raises(ValueError, match="the motion that the residual was trained on"):
        policy.for_environment(gymnasium.make("iflow/LASA-Sshape-v0"))


def test_bad_arguments_say_what_was_expected(bases):
    env = gymnasium.make(LASA)
    for arguments, kind, message in [
        ((bases[LASA], 0.0), ValueError, "scale in"),
        ((bases[DRUMMING],), ValueError, "2 dimensions"),
        ((object(),), TypeError, "Expected a fitted method"),
        ((ImitationFlow(),), RuntimeError, "has not been fitted"),
    ]:
        with pytest.raises(kind, match=message):
            ResidualActionWrapper(env, *arguments)
    with pytest.raises(ValueError, match="lyapunov_function"):
        ResidualActionWrapper(env, None, stable=True)
    only_predict = type("P", (), {"predict": lambda *a, **k: None})()
    with pytest.raises(ValueError, match="known by its actions alone"):
        ResidualActionWrapper(gymnasium.make(LASA, control_mode=FORCE), only_predict)
    with pytest.raises(TypeError, match="no command_to_action"):
        ResidualActionWrapper(gymnasium.make("CartPole-v1"), None)
    wrapped = ResidualActionWrapper(env, bases[LASA])
    with pytest.raises(gymnasium.error.ResetNeeded):
        wrapped.step(np.zeros(2))
    wrapped.reset(seed=0)
    with pytest.raises(ValueError, match=r"shape \(2,\), got \(3,\)"):
        wrapped.step(np.zeros(3))
    with pytest.raises(ValueError, match="NaN or infinity"):
        wrapped.step(np.array([np.nan, 0.0]))
    sync = gymnasium.make_vec(DRUMMING, 1, "sync", control_mode="torque")
    with pytest.raises(ValueError, match="the one environment that they are for"):
        ResidualActionWrapper(sync, bases[DRUMMING])


def test_disabled_autoreset_is_understood(bases):
    envs = gymnasium.make_vec(
        LASA, 2, "sync", vector_kwargs={"autoreset_mode": AutoresetMode.DISABLED}, horizon=3
    )
    wrapped = ResidualActionWrapper(envs, bases[LASA])
    wrapped.reset(seed=0)
    for _ in range(3):
        _, _, _, truncated, _ = wrapped.step(np.zeros((2, 2)))
    assert truncated.all()
    seen, info = wrapped.reset(options={"reset_mask": np.array([True, True])})
    assert seen.shape == (2, 6)
    assert info["base_command"].shape == (2, 2)
