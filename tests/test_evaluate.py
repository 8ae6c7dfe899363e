"""The evaluation: what a score is made of, against closed forms and known answers."""

from __future__ import annotations

import math
from dataclasses import dataclass

import gymnasium
import numpy as np
import pytest

import iflow_gym  # noqa: F401 (registers the environments)
from iflow_gym import metrics
from iflow_gym.baselines.references import NearestDemonstration, Replay, ReplayPolicy
from iflow_gym.baselines.registry import load_method
from iflow_gym.demonstrations import Demonstrations
from iflow_gym.envs.guide import without_rewards
from iflow_gym.envs.point_mass import PointMassEnv
from iflow_gym.evaluate import FIT_COSTS, evaluate, score
from iflow_gym.policy import DynamicalSystemPolicy
from iflow_gym.system import DynamicalSystem, Guarantee

RATE = 2.0


@dataclass(frozen=True)
class DecayConfig:
    rate: float = RATE
    sign: float = 1.0


class Decay(DynamicalSystem):
    """dx/dt = -rate (x - goal), in closed form; with sign -1 it runs away from the goal."""

    name = "decay"
    title = "Decay"
    Config = DecayConfig
    integrator = "exact"

    def _fit(self, demonstrations, rng):
        pass

    def _velocity(self, x):
        return -self.config.sign * self.config.rate * (x - self.goal_)

    def _step(self, x, dt):
        shrink = np.exp(-self.config.sign * self.config.rate * dt)[:, None]
        return self.goal_ + shrink * (x - self.goal_)

    def _lyapunov(self, x):
        return ((x - self.goal_) ** 2).sum(axis=1)

    def _lyapunov_rate(self, x):
        return 2 * ((x - self.goal_) * self._velocity(x)).sum(axis=1)

    def _log_prob(self, x, x_next, dt):
        """A Gaussian of variance dt around the exact step."""
        error = x_next - self._step(x, np.full(len(x), dt))
        d = x.shape[1]
        return -0.5 * (error**2).sum(axis=1) / dt - 0.5 * d * np.log(2 * np.pi * dt)

    @property
    def guarantee(self):
        return Guarantee("proved", "closed form")

    def _arrays(self):
        return {"one": np.ones(3)}

    def _restore(self, arrays):
        pass


class Blind(Decay):
    """The same field without a density or a Lyapunov function."""

    name = "blind"

    def _lyapunov(self, x):
        return None

    def _log_prob(self, x, x_next, dt):
        return None


def straight(n=3, d=2, samples=41, rate=RATE, dt=0.05):
    """Recordings of the decay itself, of lengths and sample times of their own."""
    positions, velocities, steps = [], [], []
    for i in range(n):
        h = dt * (1 + 0.1 * i)
        t = h * np.arange(samples + i)
        start = np.roll(np.linspace(-2.0 - i, 1.0 + i, d), i) + 0.5
        path = start * np.exp(-rate * t)[:, None]
        positions.append(path)
        velocities.append(-rate * path)
        steps.append(h)
    return Demonstrations.from_arrays(
        positions, velocities=velocities, dt=steps, goal=np.zeros(d), goal_tolerance=0.5
    )


@pytest.fixture
def env():
    return PointMassEnv(straight())


def fitted(env, cls=Decay, **settings):
    return cls(**settings).fit(env.demonstrations, seed=0)


def test_the_true_system_has_no_error_converges_and_recovers(env):
    found = evaluate(fitted(env), env, seed=0)
    for name in ("rmse", "frechet", "dtw", "swept_area", "seds_error", "direction_error"):
        assert found.metrics[name] == pytest.approx(0, abs=1e-6), name
    assert found.metrics["velocity_rmse"] == pytest.approx(0, abs=1e-9)
    assert found.metrics["converged"] == found.metrics["perturbation_recovery"] == 1.0
    assert found.metrics["spurious_attractors"] == found.metrics["diverged"] == 0.0
    assert found.metrics["lyapunov_violation"] == 0.0
    assert found.metrics["n_parameters"] == 3
    assert found.metrics["step_us"] > 0
    assert set(found.metrics) == {m.name for m in metrics.metrics_of("goal")} - set(FIT_COSTS)
    assert len(found.per_demonstration["rmse"]) == 3


def test_settling_time_is_the_closed_forms(env):
    demos = env.demonstrations
    tolerance = metrics.convergence_tolerance(*demos.bounding_box)
    distances = np.linalg.norm(metrics.start_grid(*demos.bounding_box), axis=1)
    expected = np.median(np.log(np.maximum(distances / tolerance, 1)) / RATE)
    found = evaluate(fitted(env), env, seed=0).metrics["settling_time"]
    assert found * demos.durations.mean() == pytest.approx(expected, abs=demos.mean_dt)


def test_an_exact_flow_rolls_out_in_the_environment_as_by_itself(env):
    system = fitted(env, rate=3.0)
    demos = env.demonstrations
    alone = [
        system.rollout(p[0], len(p) - 1, h) for p, h in zip(demos.positions, demos.dt, strict=True)
    ]
    expected = [metrics.rmse(p, q) for p, q in zip(demos.positions, alone, strict=True)]
    assert evaluate(system, env, seed=0).per_demonstration["rmse"] == pytest.approx(expected)


def test_likelihood_is_the_gaussians_with_each_demonstrations_own_time(env):
    """The system is exact, so that only the logarithm of the normaliser is left."""
    found = evaluate(fitted(env), env, seed=0, protocol="generalisation").per_demonstration
    held_out = env.demonstrations.split("generalisation").score
    for k in (1, 10):
        expected = [0.5 * math.log(2 * math.pi * k * h) for h in held_out.dt]
        assert found[f"nll_{k}"] == pytest.approx(expected, abs=1e-9)


def test_nothing_is_held_out_in_reproduction(env):
    assert evaluate(fitted(env), env, seed=0, stability=False).metrics["nll_1"] is None


def test_the_lyapunov_function_is_tried_on_the_field_itself(env):
    class Liar(Decay):
        """Runs away, and says that V decreases."""

        def _velocity(self, x):
            return -super()._velocity(x)

        def _lyapunov_rate(self, x):
            return -np.ones(len(x))

    found = evaluate(fitted(env, Liar), env, seed=0, stability=False).metrics
    assert found["lyapunov_violation"] == 1.0


def test_a_straight_line_along_an_axis_is_scored():
    t = np.linspace(1, 0, 41)[:, None]
    demos = Demonstrations.from_arrays([np.hstack([t, 0 * t]), np.hstack([2 * t, 0 * t])], dt=0.05)
    env = PointMassEnv(demos)
    found = evaluate(Decay(rate=3.0).fit(demos, seed=0), env, seed=0).metrics
    assert found["converged"] == 1.0
    assert found["lyapunov_violation"] == 0.0


def test_what_a_method_does_not_have_is_none(env):
    found = evaluate(fitted(env, Blind), env, seed=0, protocol="generalisation")
    assert [found.metrics[n] for n in ("nll_1", "nll_10", "lyapunov_violation")] == [None] * 3
    assert "nll_1" not in found.medians
    assert found.metrics["swept_surface"] is None


def test_a_system_that_runs_away_diverges_and_never_settles(env):
    found = evaluate(fitted(env, sign=-1.0), env, seed=0).metrics
    assert found["diverged"] == 1.0
    assert found["converged"] == found["perturbation_recovery"] == 0.0
    assert found["settling_time"] == math.inf
    assert found["lyapunov_violation"] == 1.0


def test_the_same_seed_gives_the_same_scores_and_another_other_pushes(env, monkeypatch):
    def without_time(found):
        return {k: v for k, v in found.items() if k != "step_us"}

    system = fitted(env)
    first = without_time(score(system, env, 0))
    assert first == without_time(score(system, env, 0)) == without_time(env.score(system, 0))
    ends = []
    record = metrics.converged

    def spy(paths, *rest):
        ends.append(paths)
        return record(paths, *rest)

    monkeypatch.setattr(metrics, "converged", spy)
    for seed in (0, 0, 1):
        score(system, env, seed)
    pushed = ends[1::2]
    np.testing.assert_array_equal(pushed[0], pushed[1])
    assert np.abs(pushed[0] - pushed[2]).max() > 0.1 * env.demonstrations.bounding_box.diagonal
    np.testing.assert_array_equal(ends[0], ends[4])  # the grid has no randomness


def test_the_callers_environment_is_not_stepped(env):
    observation, _ = env.reset(options={"demonstration": 1})
    score(fitted(env), env, 0)
    following, *_ = env.step(np.zeros(2))
    np.testing.assert_array_equal(observation, following)


def test_ids_wrappers_vectors_and_policies_of_a_system_score_the_same():
    env = gymnasium.make("iflow/LASA-Line-v0")
    system = Decay().fit(env.unwrapped.demonstrations, seed=0)
    vector = gymnasium.make_vec(
        "iflow/LASA-Line-v0", num_envs=2, vectorization_mode="vector_entry_point"
    )
    vector.reset(seed=0)
    expected = evaluate(system, env, seed=0, stability=False).metrics
    others = [
        evaluate(system, "iflow/LASA-Line-v0", seed=0, stability=False),
        evaluate(DynamicalSystemPolicy(system, vector), vector, seed=0, stability=False),
    ]
    for other in others:
        assert other.metrics["rmse"] == expected["rmse"]
        assert other.metrics["nll_1"] == expected["nll_1"]
    assert expected["converged"] is None


class Clockwork:
    """A policy that depends on time: it counts its steps in the state that it is handed back."""

    def __init__(self):
        self.starts = []

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        if np.ndim(observation) == 2:
            self.starts.append((None if state is None else int(state), bool(np.all(episode_start))))
        step = 0 if state is None else state
        return np.full(np.shape(observation), 0.01 if step % 2 else -0.01), step + 1


def test_a_policy_gets_its_state_back_and_has_no_teacher_forced_scores(env):
    policy = Clockwork()
    found = evaluate(policy, env, seed=0, stability=False)
    n_steps = max(len(p) for p in env.demonstrations.positions) - 1
    assert policy.starts == [(None, True), *((k, False) for k in range(1, n_steps))]
    assert found.metrics["rmse"] > 0
    names = ("velocity_rmse", "seds_error", "lyapunov_violation", "n_parameters")
    assert [found.metrics[name] for name in names] == [None] * 4


class SometimesNaN:
    """Stands still, and has no idea on the right."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.where(observation[..., :1] > 0.0, np.nan, 0.0 * observation), state


def test_a_runaway_costs_only_its_own_trajectory(env):
    found = evaluate(SometimesNaN(), env, seed=0)
    to_the_right = env.demonstrations.starts[:, 0] > 0
    np.testing.assert_array_equal(np.isinf(found.per_demonstration["rmse"]), to_the_right)
    assert found.metrics["rmse"] == math.inf
    grid = metrics.start_grid(*env.demonstrations.bounding_box)
    assert found.metrics["diverged"] == np.mean(grid[:, 0] > 0)


def test_generalisation_scores_the_held_out_recordings_in_the_box_of_all():
    demos = straight(n=7)
    env = PointMassEnv(demos)
    system = Decay(rate=3.0).fit(demos.split("generalisation").fit, seed=0)
    whole = evaluate(system, env, seed=0)
    part = evaluate(system, env, seed=0, protocol="generalisation")
    for name in ("rmse", "velocity_rmse", "perturbation_recovery"):
        assert part.per_demonstration[name] == pytest.approx(whole.per_demonstration[name][4:])
    for name in ("settling_time", "converged", "lyapunov_violation"):
        assert part.metrics[name] == whole.metrics[name]


def test_other_dimensions_have_a_grid_too():
    for d, area in ((1, None), (3, "swept_surface"), (4, None)):
        env = PointMassEnv(straight(d=d, samples=30))
        found = evaluate(fitted(env), env, seed=0).metrics
        assert found["converged"] == 1.0
        assert found["rmse"] == pytest.approx(0, abs=1e-6)
        assert (found["swept_surface"] is not None) == (area == "swept_surface")


def test_force_control_is_scored_through_the_mass():
    """The mass lags behind the command by a percent of the duration, and is pushed as well."""
    env = PointMassEnv(straight(samples=101, dt=0.02), control_mode="force")
    found = evaluate(fitted(env), env, seed=0).metrics
    assert found["converged"] == found["perturbation_recovery"] == 1.0
    assert 0 < found["rmse"] < 0.05 * env.demonstrations.bounding_box.diagonal


def test_what_is_no_policy_or_no_environment_is_refused(env):
    with pytest.raises(TypeError, match=r"Expected a fitted method or a policy"):
        score(object(), env, 0)
    with pytest.raises(TypeError, match=r"Expected an environment of iflow_gym"):
        score(fitted(env), gymnasium.make("CartPole-v1"), 0)
    with pytest.raises(ValueError, match="fitted system"):
        score(Decay(), env, 0)
    with pytest.raises(ValueError, match="protocol"):
        evaluate(fitted(env), env, seed=0, protocol="training")


def test_a_replay_is_the_recording_to_rounding(env):
    found = Replay().evaluate(env, seed=0, protocol="reproduction")
    assert found.metrics["rmse"] < 1e-12
    assert found.metrics["converged"] is None
    assert found.metrics["velocity_rmse"] is None


def test_a_replay_of_a_fitted_recording_ends_where_that_one_does():
    demos = straight(n=7)
    env = PointMassEnv(demos)
    fit, held_out = demos.split("generalisation")
    found = Replay().evaluate(env, seed=0, protocol="generalisation")
    assert len(found.per_demonstration["rmse"]) == len(held_out)
    assert 0 < found.metrics["rmse"] < math.inf
    with pytest.raises(ValueError, match="for_environment"):
        ReplayPolicy(fit).predict(np.zeros(2))


def test_the_nearest_demonstration_is_the_smallest_distance_to_another():
    demos = straight(n=7)
    env = PointMassEnv(demos)
    for protocol in ("reproduction", "generalisation"):
        fit, scored = demos.split(protocol)
        found = NearestDemonstration().evaluate(env, seed=0, protocol=protocol)
        expected = [
            min(metrics.frechet(p, q) for q in fit.positions if q is not p)
            for p in scored.positions
        ]
        assert found.per_demonstration["frechet"] == pytest.approx(expected)
        assert found.metrics["frechet"] == pytest.approx(np.mean(expected))
        assert found.metrics["rmse"] is None
        assert found.metrics["swept_area"] is None  # no two lengths agree


def test_a_single_demonstration_has_no_nearest_one():
    with pytest.raises(ValueError, match="at least two demonstrations"):
        NearestDemonstration().evaluate(
            PointMassEnv(straight(n=1)), seed=0, protocol="reproduction"
        )


@pytest.mark.parametrize("env_id", ["iflow/LASA-Sharpc-v0", "iflow/Letter-O-v0"])
def test_scores_do_not_depend_on_rewards(env_id):
    env = gymnasium.make(env_id)
    system = load_method("gmr")(n_components=3).fit(env.unwrapped.demonstrations, seed=0)
    found = evaluate(system, env, seed=0)
    with without_rewards():
        env.reset(seed=0)
        assert np.isnan(env.unwrapped.step(np.zeros(2, dtype=np.float32))[1])
        spared = evaluate(system, env, seed=0)
    assert np.isfinite(env.step(np.zeros(2, dtype=np.float32))[1])
    timed = {"step_us": None}
    assert spared.metrics | timed == found.metrics | timed
    assert spared.per_demonstration == found.per_demonstration
