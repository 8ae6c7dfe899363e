"""The orbit that recordings have in common: what it is, and how precisely it is known where."""

import numpy as np
import pytest
import torch

from iflow_gym import Demonstrations
from iflow_gym.baselines.imitation_flow import ImitationFlow
from iflow_gym.baselines.imitation_flow.config import ENDS, IN_PLANE, ImitationFlowConfig
from iflow_gym.baselines.imitation_flow.data import Recordings, Task
from iflow_gym.baselines.imitation_flow.emissions import make_flow
from iflow_gym.baselines.imitation_flow.limit_cycle import LimitCycleLatent
from iflow_gym.baselines.imitation_flow.mean_orbit import N_PHASES, MeanOrbit, mean_orbit
from iflow_gym.baselines.imitation_flow.passes import evaluate
from iflow_gym.metrics import period

PERIOD, DT = 2.0, 0.01


def rounds(n: int = 6) -> Demonstrations:
    """Circles in space; their heights differ by (1 - cos 2 pi u) / 2 / 10, not at u = 0."""
    u = np.arange(0, 3 * PERIOD, DT) / PERIOD
    angle = 2 * np.pi * u
    circle = np.stack([np.cos(angle), np.sin(angle), 0.3 * np.cos(2 * angle)], axis=1)
    lift = 0.1 * (1 - np.cos(angle)) / 2
    offsets = np.linspace(-1, 1, n)
    paths = [circle + np.outer(k * lift, [0, 0, 1]) for k in offsets]
    return Demonstrations.from_arrays(paths, dt=DT, period=PERIOD)


def test_mean_is_the_common_curve_and_its_spread_that_of_the_phase() -> None:
    curve, covariance = mean_orbit(rounds())
    angle = 2 * np.pi * np.arange(N_PHASES) / N_PHASES
    expected = np.stack([np.cos(angle), np.sin(angle), 0.3 * np.cos(2 * angle)], axis=1)
    np.testing.assert_allclose(curve, expected, atol=0.01)
    height = np.sqrt(covariance[:, 2, 2])
    spread = np.linspace(-1, 1, 6).std() * 0.1
    assert height[0] < 0.05 * spread
    assert height[N_PHASES // 2] == pytest.approx(spread, rel=0.1)
    assert np.linalg.eigvalsh(covariance).min() > -1e-9


def test_turns_are_not_blurred_by_uneven_tempo() -> None:
    rng = np.random.default_rng(0)
    paths = []
    for _ in range(6):
        u = np.arange(0, 3, DT / PERIOD)
        u = u + 0.02 * np.sin(2 * np.pi * (u + rng.uniform())) / (2 * np.pi) * 2
        height = np.abs((u % 1.0) - 0.5)  # a sharp turn at 0.5, from slope -1 to 1
        paths.append(np.stack([np.cos(2 * np.pi * u), np.sin(2 * np.pi * u), height], axis=1))
    curve, _ = mean_orbit(Demonstrations.from_arrays(paths, dt=DT, period=PERIOD))
    assert curve[:, 2].min() < 0.006  # a mean over time has 0.01 there


def test_error_counts_where_recordings_agree() -> None:
    """A model's orbit, moved in height, costs its squared error by the precision."""
    task = Task([rounds()])
    data = Recordings([task], torch.device("cpu"))
    config = ImitationFlowConfig()
    flow = make_flow(config, 3, 0, [torch.Generator().manual_seed(0)], cyclic=True)
    latent = LimitCycleLatent(1, 3, min_decay=0.05)
    latent.initialise(2 * np.pi * task.turns, 3.0, 1.0)
    losses = [
        evaluate(flow, latent, data, [MeanOrbit([task], data, resolution)(latent)])[0].item()
        for resolution in (0.01, 0.1, 1e3)
    ]
    assert losses[0] > losses[1] > 1.0
    assert losses[2] == pytest.approx(0.0, abs=1e-3)


def test_fit_with_the_term_goes_round_in_the_period() -> None:
    motion = rounds()
    system = ImitationFlow(n_steps=60, orbit_weight=1.0).fit(motion, seed=0)
    path = system.rollout(motion.starts[:1], n_steps=1000, dt=DT)[0]
    assert period(path[500:], DT) == pytest.approx(PERIOD, rel=0.02)


def test_defaults_are_of_the_kind_of_motion() -> None:
    config = ImitationFlowConfig()
    in_space = config.resolved(cyclic=True, n_dims=3)
    assert in_space.orbit_weight > 0
    assert in_space.min_decay > 1
    plane, ends = config.resolved(cyclic=True, n_dims=2), config.resolved(cyclic=False, n_dims=3)
    assert (plane, ends) == (IN_PLANE, ENDS)
    assert ImitationFlowConfig(objective="paper").resolved(cyclic=True, n_dims=3) == IN_PLANE
    given = ImitationFlowConfig(orbit_weight=0.0, calm_weight=0.5, min_decay=1.0)
    found = given.resolved(cyclic=True, n_dims=3)
    assert (found.calm_weight, found.orbit_weight, found.min_decay) == (0.5, 0.0, 1.0)
    assert found.inward_weight == 0.0  # it belongs to the orbit's stage
    with pytest.raises(ValueError, match="an orbit_weight > 0 with inward_weight"):
        ImitationFlowConfig(inward_weight=1.0).resolved(cyclic=True, n_dims=2)


def test_a_cycle_in_space_comes_back_within_a_period() -> None:
    """The distance to the latent cycle falls by exp(-4) in a period at least."""
    motion = rounds()
    starts = motion.starts + np.array([0.2, -0.1, 0.3])
    left = []
    for settings in ({}, {"min_decay": 0.05}):
        system = ImitationFlow(n_steps=20, **settings).fit(motion, seed=0)
        path = system.rollout(starts, n_steps=round(PERIOD / DT), dt=DT)
        before, after = system.lyapunov(path[:, 0]), system.lyapunov(path[:, -1])
        left.append(np.sqrt(after / before).max())
    assert left[0] < 1.1 * np.exp(-4)  # the period found is not PERIOD to the last digit
    assert left[1] > 2 * left[0]


@pytest.mark.parametrize("n_recordings", [1, 6])
def test_recordings_of_one_round_have_an_orbit(n_recordings: int) -> None:
    """No recording sees the last places of the round: they are interpolated."""
    angle = 2 * np.pi * np.arange(200) / 200
    path = np.column_stack([np.cos(angle), np.sin(angle), 0.3 * np.cos(2 * angle)])
    motion = Demonstrations.from_arrays(
        [(1 + 0.01 * k) * path for k in range(n_recordings)], dt=0.01, period=2.0, name="one round"
    )
    curve, spread = mean_orbit(motion)
    assert np.isfinite(spread).all()
    radius = np.hypot(curve[:, 0], curve[:, 1])
    np.testing.assert_allclose(radius, 1 + 0.005 * (n_recordings - 1), atol=0.02)
