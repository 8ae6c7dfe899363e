"""The evaluation of motions that repeat, against Hopf oscillators whose orbits are known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from iflow_gym import metrics
from iflow_gym.baselines.references import NearestDemonstration, Replay
from iflow_gym.demonstrations import Demonstrations
from iflow_gym.envs.point_mass import PointMassEnv
from iflow_gym.evaluate import FIT_COSTS, evaluate
from iflow_gym.policy import DynamicalSystemPolicy
from iflow_gym.system import DynamicalSystem, Guarantee

DT, PERIOD = 0.01, 2.0


@dataclass(frozen=True)
class HopfConfig:
    radius: float = 1.0
    tempo: float = 1.0
    shift: float = 0.0
    decay: float = 4.0


class Hopf(DynamicalSystem):
    """A circle in closed form: the radius decays to `radius`, the angle turns at `tempo`."""

    name = "hopf"
    title = "Hopf"
    Config = HopfConfig
    integrator = "exact"
    learns_cycles = True

    def _fit(self, demonstrations, rng):
        pass

    def _centred(self, x):
        return x - np.array([self.config.shift, 0.0])

    def _velocity(self, x):
        y = self._centred(x)
        rho = np.linalg.norm(y, axis=1, keepdims=True)
        spin = 2 * np.pi * self.config.tempo / self.period_
        return (
            spin * np.stack([-y[:, 1], y[:, 0]], axis=1)
            + self.config.decay * (self.config.radius / rho - 1) * y
        )

    def _step(self, x, dt):
        y = self._centred(x)
        rho, angle = np.linalg.norm(y, axis=1), np.arctan2(y[:, 1], y[:, 0])
        after = self.config.radius + np.exp(-self.config.decay * dt) * (rho - self.config.radius)
        angle = angle + 2 * np.pi * self.config.tempo / self.period_ * dt
        moved = after[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return moved + np.array([self.config.shift, 0.0])

    def _lyapunov(self, x):
        return (np.linalg.norm(self._centred(x), axis=1) - self.config.radius) ** 2

    def _log_prob(self, x, x_next, dt):
        error = x_next - self._step(x, np.full(len(x), dt))
        return -0.5 * (error**2).sum(axis=1) / dt - np.log(2 * np.pi * dt)

    @property
    def guarantee(self):
        return Guarantee("proved", "closed form")

    def _arrays(self):
        return {"one": np.ones(1)}

    def _restore(self, arrays):
        pass


def circles(n=4, radius=1.0, tempo=1.0):
    t = np.arange(round(4 * PERIOD / DT) + 1) * DT
    paths = []
    for i in range(n):
        angle = 2 * np.pi * tempo * t / PERIOD + i
        paths.append(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return Demonstrations.from_arrays(paths, dt=DT, period=PERIOD / tempo, held_out=n // 2)


@pytest.fixture
def env():
    return PointMassEnv(circles())


def scores(env, protocol="reproduction", **settings):
    return evaluate(
        Hopf(**settings).fit(env.demonstrations, seed=0), env, seed=0, protocol=protocol
    )


@pytest.mark.parametrize("protocol", ["reproduction", "generalisation"])
def test_the_true_system(env, protocol):
    found = scores(env, protocol)
    values = found.metrics
    assert set(values) == {m.name for m in metrics.metrics_of("cycle")} - set(FIT_COSTS)
    for name in ("orbit_distance", "orbit_hausdorff", "phase_rmse", "dtw", "period_error"):
        # The samples of orbit and demonstrations lie at most half a step apart: 1.6 % of a radius.
        assert values[name] == pytest.approx(0, abs=0.02), name
        assert len(found.per_demonstration[name]) == 2
    assert values["period_error"] < 1e-3
    assert values["attraction"] == values["perturbation_recovery"] == 1.0
    assert values["diverged"] == values["lyapunov_violation"] == 0.0
    assert values["seds_error"] < 0.01
    assert (values["nll_1"] is None) == (protocol == "reproduction")


@pytest.mark.parametrize("tempo", [0.8, 1.25])
def test_a_wrong_tempo_shows_in_the_period_and_the_phase_alone(env, tempo):
    values = scores(env, tempo=tempo).metrics
    assert values["period_error"] == pytest.approx(abs(1 / tempo - 1), rel=0.02)
    assert values["orbit_hausdorff"] < 0.03
    assert values["phase_rmse"] > 0.2
    assert values["attraction"] == 1.0


def test_a_shifted_orbit_shows_in_the_distances(env):
    values = scores(env, shift=0.1).metrics
    assert values["orbit_hausdorff"] == pytest.approx(0.1, rel=0.05)
    assert values["orbit_distance"] == pytest.approx(2 / np.pi * 0.1, rel=0.1)
    assert values["period_error"] < 1e-3
    assert values["attraction"] == 1.0  # 0.1 is within 5 % of the diagonal 2.83


def test_an_orbit_elsewhere_attracts_nothing(env):
    values = scores(env, radius=0.5).metrics
    assert values["attraction"] == values["perturbation_recovery"] == 0.0
    assert values["orbit_distance"] == pytest.approx(0.5, rel=0.01)


def test_what_runs_away_scores_infinity_and_what_stands_still_has_no_period(env):
    gone = scores(env, radius=1e5, decay=10.0).metrics
    assert gone["diverged"] == 1.0
    assert gone["attraction"] == 0.0
    still = scores(env, tempo=0.0).metrics
    assert still["period_error"] == np.inf
    assert still["attraction"] == 1.0


def test_force_mode_and_a_policy_score_as_well(env):
    system = Hopf().fit(env.demonstrations, seed=0)
    slow = PointMassEnv(env.demonstrations, control_mode="force")
    values = evaluate(DynamicalSystemPolicy(system, slow), slow, seed=0).metrics
    assert values["attraction"] == 1.0
    assert values["period_error"] < 0.02
    assert values["orbit_hausdorff"] < 0.05


def test_the_references_score_the_recordings_themselves(env):
    played = Replay().evaluate(env, seed=0, protocol="reproduction").metrics
    assert played["orbit_hausdorff"] < 0.03
    assert played["dtw"] < 1e-9
    assert played["attraction"] is None
    apart = NearestDemonstration().evaluate(env, seed=0, protocol="generalisation").metrics
    assert apart["orbit_hausdorff"] < 0.03
    assert apart["period_error"] == pytest.approx(0, abs=1e-3)
    assert apart["phase_rmse"] is None


def test_rivals_are_told_apart_by_the_density(monkeypatch):
    large = PointMassEnv(circles(radius=1.5))
    small = PointMassEnv(circles())
    for one, other in ((large, small), (small, large)):
        monkeypatch.setattr(one, "rivals", (one, other))
        radius = 1.5 if one is large else 1.0
        system = Hopf(radius=radius, decay=20.0).fit(one.demonstrations, seed=0)
        found = evaluate(system, one, seed=0, protocol="generalisation").likelihoods
        assert [len(values) for values in found.values()] == [2, 2]
        assert min(found[one]) > max(found[other])
    assert scores(small, radius=1.0).likelihoods == {}  # nothing is held out
