"""DynamicalSystemPolicy: a system in an environment moves as the system says."""

from dataclasses import dataclass

import gymnasium
import numpy as np
import pytest

from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.demonstrations import Demonstrations
from iflow_gym.plotting import field_figure, plot_streamlines
from iflow_gym.policy import DynamicalSystemPolicy
from iflow_gym.system import DynamicalSystem, Guarantee

ANGLE = "iflow_gym:iflow/LASA-Angle-v0"


@dataclass(frozen=True)
class SpiralConfig:
    rate: float = 2.0
    turn: float = 3.0


class Spiral(DynamicalSystem):
    """x' = A (x - goal), A = -rate I + turn J: a spiral with a closed form and V = |x|^2."""

    name, title, Config, integrator = "spiral", "Spiral", SpiralConfig, "exact"

    def _fit(self, demonstrations, rng):
        self._goal = demonstrations.attractor

    def _velocity(self, x):
        offset = x - self._goal
        turned = np.stack([-offset[:, 1], offset[:, 0]], axis=1)
        return -self.config.rate * offset + self.config.turn * turned

    def _step(self, x, dt):
        offset = x - self._goal
        c, s = np.cos(self.config.turn * dt), np.sin(self.config.turn * dt)
        turned = np.stack(
            [c * offset[:, 0] - s * offset[:, 1], s * offset[:, 0] + c * offset[:, 1]], axis=1
        )
        return self._goal + np.exp(-self.config.rate * dt)[:, None] * turned

    def _lyapunov(self, x):
        return ((x - self._goal) ** 2).sum(axis=1)

    @property
    def guarantee(self):
        return Guarantee("proved", "linear with eigenvalues -rate ± i turn")

    def _arrays(self):
        return {"goal_": self._goal}

    def _restore(self, arrays):
        self._goal = arrays["goal_"]


@pytest.fixture
def spiral():
    return Spiral().fit(load_lasa("Angle"), seed=0)


def run(env, policy, n_steps, **options):
    x, _ = env.reset(seed=0, options=options)
    path = [x]
    for _ in range(n_steps):
        x, *_ = env.step(policy.predict(x)[0])
        path.append(x)
    return np.array(path)


def test_the_mass_follows_the_exact_flow(spiral):
    env = gymnasium.make(ANGLE)
    policy = DynamicalSystemPolicy(spiral, env)
    path = run(env, policy, 400, demonstration=2)
    exact = spiral.rollout(path[0], 400, env.unwrapped.dt)
    np.testing.assert_allclose(path, exact, rtol=0, atol=1e-9)


def test_dt_is_read_live(spiral):
    env = gymnasium.make(ANGLE)
    policy = DynamicalSystemPolicy(spiral, env)
    for index in (0, 6):
        env.reset(options={"demonstration": index})
        assert policy.dt == load_lasa("Angle").dt[index]


def test_saturated_commands_stay_on_the_orbit():
    """Far out the spiral is faster than the limit: the next state is on the same orbit, earlier."""
    env = gymnasium.make(ANGLE).unwrapped
    fast = Spiral(rate=40.0, turn=60.0).fit(env.demonstrations, seed=0)
    policy = DynamicalSystemPolicy(fast, env)
    rng = np.random.default_rng(0)
    x = rng.uniform(-300, 300, (200, 2))
    command = policy.command(x, env.dt)
    size = np.abs(command).max(axis=1) / policy.max_speed
    assert size.max() <= 1 + 1e-12
    saturated = np.abs(fast.step(x, env.dt) - x).max(axis=1) > env.dt * policy.max_speed
    assert saturated.mean() > 0.9
    assert size[saturated].min() > 1 - 1e-6  # the largest step that the limit allows
    following = x + env.dt * command
    # The time s dt that the step took, by the radius; the angle must agree with it.
    took = np.log(np.linalg.norm(x, axis=1) / np.linalg.norm(following, axis=1)) / 40.0
    np.testing.assert_allclose(following, fast.step(x, took), rtol=0, atol=1e-8)
    assert (took[saturated] < env.dt).all()
    assert (fast.lyapunov(following) < fast.lyapunov(x)).all()


def test_a_path_too_fast_for_bisection_still_moves_within_the_limit():
    class Jump(Spiral):
        def _step(self, x, dt):
            return np.broadcast_to(self._goal, x.shape).copy()

    env = gymnasium.make(ANGLE).unwrapped
    policy = DynamicalSystemPolicy(Jump().fit(env.demonstrations, seed=0), env)
    x = np.array([100.0, -40.0])
    command = policy.command(x, env.dt)
    np.testing.assert_allclose(command, -x / 100 * policy.max_speed, rtol=1e-12)


def test_single_and_batched_observations_agree(spiral):
    env = gymnasium.make(ANGLE)
    env.reset(options={"demonstration": 1})
    policy = DynamicalSystemPolicy(spiral, env)
    x = np.random.default_rng(0).uniform(-500, 500, (20, 2))
    actions, state = policy.predict(x, state="kept")
    assert actions.dtype == np.float64
    assert actions.shape == (20, 2)
    assert state == "kept"
    assert np.abs(actions).max() <= 1
    np.testing.assert_allclose(actions[3], policy.predict(x[3])[0], rtol=1e-12)


def test_vector_environment_with_a_dt_each(spiral):
    envs = gymnasium.make_vec(ANGLE, num_envs=3)
    policy = DynamicalSystemPolicy(spiral, envs)
    x, _ = envs.reset(options={"demonstration": np.array([0, 3, 6])})
    y, *_ = envs.step(policy.predict(x)[0])
    np.testing.assert_allclose(y, spiral.step(x, envs.dt), rtol=0, atol=1e-10)
    with pytest.raises(ValueError, match="Expected observations of all 3 environments"):
        policy.predict(x[0])


def test_force_mode_converges(spiral):
    env = gymnasium.make(ANGLE, control_mode="force", horizon=3000)
    policy = DynamicalSystemPolicy(spiral, env)
    path = run(env, policy, 3000, demonstration=0)
    assert np.linalg.norm(path[-1, :2]) < 0.02 * env.unwrapped.task.diagonal


def test_without_an_environment(spiral):
    policy = DynamicalSystemPolicy(spiral, max_speed=500.0, dt=0.01)
    x = np.array([10.0, 5.0])
    action, _ = policy.predict(x)
    np.testing.assert_allclose(x + 0.01 * 500.0 * action, spiral.step(x, 0.01), atol=1e-12)


def test_stable_baselines_evaluates_it(spiral):
    evaluation = pytest.importorskip("stable_baselines3.common.evaluation")
    env = gymnasium.make(ANGLE, horizon=50)
    policy = DynamicalSystemPolicy(spiral, env)
    mean, _ = evaluation.evaluate_policy(policy, env, n_eval_episodes=2, warn=False)
    assert -50 <= mean <= 50


def test_errors(spiral):
    env = gymnasium.make(ANGLE)
    with pytest.raises(ValueError, match=r"call fit\(demonstrations, seed=0\) first"):
        DynamicalSystemPolicy(Spiral(), env)
    with pytest.raises(TypeError, match="or both max_speed and dt"):
        DynamicalSystemPolicy(spiral)
    with pytest.raises(TypeError, match="got both"):
        DynamicalSystemPolicy(spiral, env, dt=0.1)
    with pytest.raises(TypeError, match="it has no command_to_action"):
        DynamicalSystemPolicy(spiral, gymnasium.make("CartPole-v1"))
    with pytest.raises(ValueError, match="max_speed > 0"):
        DynamicalSystemPolicy(spiral, max_speed=0.0, dt=0.1)
    with pytest.raises(ValueError, match=r"shape \(\.\.\., 2\), got \(3,\)"):
        DynamicalSystemPolicy(spiral, env).predict(np.zeros(3))
    line = Demonstrations.from_arrays([np.linspace(1, 0, 9)[:, None]], dt=0.1)
    own = gymnasium.make("iflow/PointMass-v0", demonstrations=line)
    with pytest.raises(ValueError, match="a system of 1 dimensions"):
        DynamicalSystemPolicy(spiral, own)


def test_field_figure_draws_everything(spiral):
    demos = load_lasa("Angle")
    figure = field_figure(spiral, demos, [spiral.rollout(s, 50, 0.01) for s in demos.starts])
    (ax,) = figure.axes
    assert ax.get_xlabel() == "x (mm)"
    assert ax.get_aspect() == 1
    assert len(ax.lines) == 7 + 2 * 7 + 1  # demonstrations, rollouts with their ends, the goal
    low, high = np.array([ax.get_xlim(), ax.get_ylim()]).T
    assert all(((p > low) & (p < high)).all() for p in demos.positions)


def test_streamlines_leave_out_what_is_not_finite():
    from matplotlib.figure import Figure

    def broken(x):
        return np.where(x[:, :1] > 0, np.nan, -x)

    ax = Figure().add_subplot()
    plot_streamlines(ax, broken, [-1, -1], [1, 1])
    (lines,) = ax.collections
    ends = np.concatenate([p.vertices for p in lines.get_paths()])
    assert ends[:, 0].max() < 0.1
    empty = Figure().add_subplot()
    plot_streamlines(empty, np.zeros_like, [-1, -1], [1, 1])
    assert not empty.collections
