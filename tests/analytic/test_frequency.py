"""Periods of recordings against curves whose period is known, and how a cycle's fit takes them."""

import numpy as np
import pytest

from iflow_gym import Demonstrations
from iflow_gym.baselines.imitation_flow import ImitationFlow, frequency
from iflow_gym.baselines.imitation_flow.config import ImitationFlowConfig
from iflow_gym.baselines.imitation_flow.data import Frame, Task


def ring(n, period, phase=0.0, size=(1.0, 1.0)):
    angle = phase + 2 * np.pi * np.arange(n) / period
    return np.column_stack([size[0] * np.cos(angle), size[1] * np.sin(angle)])


def eight(n, period, phase=0.0):
    """A curve that goes along its long axis twice a round and does not go round its centre."""
    angle = phase + 2 * np.pi * np.arange(n) / period
    return np.column_stack([2 * np.sin(2 * angle), np.sin(angle)])


def crescent(n, period, phase=0.0):
    """There over a high arch and back over a low one; the mean lies between them."""
    angle = phase + 2 * np.pi * np.arange(n) / period
    return np.column_stack([np.cos(angle), 0.3 * np.sin(angle) + 0.4 * np.cos(2 * angle)])


@pytest.mark.parametrize("phase", [0.0, 1.0, 3.0])
def test_main_frequency_of_a_cosine(phase):
    samples = 5.0 + np.cos(phase + 2 * np.pi * np.arange(500) / 123.0)
    assert 1 / frequency.main_frequency(samples) == pytest.approx(123.0, rel=0.02)


@pytest.mark.parametrize("curve", [ring, eight, crescent])
@pytest.mark.parametrize("phase", [0.0, 0.7, 2.0, 4.0])
@pytest.mark.parametrize("rounds", [2.1, 3.4])
@pytest.mark.parametrize("given", [125.0, 160.0])
def test_the_period_is_found_wherever_the_recording_begins(curve, phase, rounds, given):
    (found,) = frequency.periods([curve(round(rounds * 140.3), 140.3, phase)], [given])
    assert found == pytest.approx(140.3, rel=2e-3)


def test_a_harmonic_is_told_for_all_recordings_together():
    """Three say that the main frequency is the second harmonic, against one period that is off."""
    paths = [eight(500, period) for period in (150.0, 130.0, 110.0)] + [eight(400, 130.0)]
    found = frequency.periods(paths, [150.0, 130.0, 110.0, 65.0])
    np.testing.assert_allclose(found, [150.0, 130.0, 110.0, 130.0], rtol=2e-3)


def test_the_given_period_tells_what_turns_several_times_a_round():
    angle = 2 * np.pi * np.arange(900) / 200
    rosette = np.stack([0.5 * np.cos(angle) + np.cos(5 * angle),
                        0.5 * np.sin(angle) + np.sin(5 * angle)], axis=1)  # fmt: skip
    (found,) = frequency.periods([rosette], [210.0])
    assert found == pytest.approx(200.0, rel=2e-3)


def test_less_than_a_round_and_a_half_says_nothing():
    assert frequency.periods([ring(130, 100.0), ring(5, 100.0)], [100.0, 100.0]) == [None, None]


def recordings(periods, given, dt=0.01, n_rounds=3.3):
    paths = [
        ring(round(n_rounds * p / dt), p / dt, phase, (3.0, 1.0)) for phase, p in enumerate(periods)
    ]
    return Demonstrations.from_arrays(paths, dt=dt, period=given, name="ring")


class TestTempo:
    def test_each_recording_is_timed_by_its_own_rounds(self):
        task = Task([recordings([1.0, 1.5, 2.0], given=1.3)])
        frame = Frame.of(task)
        np.testing.assert_allclose(task.periods, [1.0, 1.5, 2.0], rtol=5e-3)
        assert frame.time == pytest.approx(1.5, rel=5e-3)
        np.testing.assert_allclose(task.steps(frame), 0.01 / np.array([1, 1.5, 2]), rtol=5e-3)
        # In the frame all go round at one speed, up to the few parts in a thousand above.
        assert task.peak_speed(frame) == pytest.approx(6 * np.pi, rel=0.02)

    def test_a_recording_too_short_to_tell_has_the_given_period(self):
        task = Task([recordings([2.0], given=2.1, n_rounds=1.2)])
        assert task.periods == [2.1]

    def test_the_frame_makes_a_circle_of_an_ellipse(self):
        task = Task([recordings([1.0], given=1.0, n_rounds=4)])
        (path,) = task.scaled(Frame.of(task))
        np.testing.assert_allclose(np.linalg.norm(path, axis=1), 1.0, atol=1e-6)

    def test_a_period_that_is_a_little_off_is_put_right(self):
        motion = recordings([1.5, 1.5], given=1.8)
        system = ImitationFlow(n_steps=200, n_layers=4).fit(motion, seed=0)
        path = system.rollout(motion.starts[:1], 600, 0.01)[0, -450:]
        turned = np.unwrap(np.arctan2(path[:, 1] / 1.0, path[:, 0] / 3.0))
        assert 4.49 * 2 * np.pi / (turned[-1] - turned[0]) == pytest.approx(1.5, rel=0.01)


@pytest.mark.parametrize(("cyclic", "steps", "slope"), [(False, 4500, 3.0), (True, 1500, 1.5)])
def test_defaults_are_those_of_the_kind_of_motion_until_they_are_given(cyclic, steps, slope):
    config, given = ImitationFlowConfig(), ImitationFlowConfig(n_steps=7, sharpness=2.0)
    for settings, expected in ((config, (steps, slope)), (given, (7, 2.0))):
        found = settings.resolved(cyclic=cyclic, n_dims=2)
        assert (found.n_steps, found.sharpness) == expected


@pytest.mark.parametrize("setting", [{"n_steps": 0}, {"sharpness": 0.0}])
def test_what_is_given_is_checked(setting):
    with pytest.raises(ValueError, match=f"{next(iter(setting))} >=? ?[01], got 0"):
        ImitationFlowConfig(**setting)
