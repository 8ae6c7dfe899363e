"""Demonstrations: what they hold, what they compute, and what they say of bad input."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iflow_gym.demonstrations import Demonstrations


def line(samples=20, end=(0.0, 0.0), start=(1.0, 2.0)):
    return np.linspace(start, end, samples)


class TestFromArrays:
    def test_recordings_of_different_lengths_and_dt(self):
        motion = Demonstrations.from_arrays([line(20), line(35)], dt=[0.1, 0.02], name="own")
        assert [p.shape for p in motion.positions] == [(20, 2), (35, 2)]
        assert motion.dt == (0.1, 0.02)
        np.testing.assert_allclose(motion.durations, [1.9, 0.68])
        np.testing.assert_allclose(motion.times(1), np.arange(35) * 0.02)
        np.testing.assert_array_equal(motion.goal, [0, 0])
        assert "own" in repr(motion)
        assert "20-35" in repr(motion)

    def test_velocities_are_estimated_where_absent(self):
        t = np.linspace(0, 1, 101)
        curve = np.stack([np.sin(3 * t) - np.sin(3), t**2 - 1], axis=1)
        motion = Demonstrations.from_arrays([curve], dt=0.01)
        exact = np.stack([3 * np.cos(3 * t), 2 * t], axis=1)
        np.testing.assert_allclose(motion.velocities[0][1:-1], exact[1:-1], atol=1e-3)
        np.testing.assert_allclose(motion.velocities[0], exact, atol=0.02)
        assert motion.peak_speed == pytest.approx(
            np.linalg.norm(motion.velocities[0], axis=1).max()
        )

    def test_recorded_velocities_are_kept(self):
        speeds = np.random.default_rng(0).normal(size=(20, 2))
        motion = Demonstrations.from_arrays([line()], dt=0.1, velocities=[speeds])
        np.testing.assert_array_equal(motion.velocities[0], speeds)

    def test_immutable_and_independent_of_its_input(self):
        positions = line()
        motion = Demonstrations.from_arrays([positions], dt=0.1)
        positions[:] = 7
        assert motion.positions[0].max() == 2
        with pytest.raises(ValueError, match="read-only"):
            motion.positions[0][0] = 1
        with pytest.raises(AttributeError):
            motion.dt = (1.0,)

    def test_uneven_times_are_resampled_on_request(self):
        t = np.array([0.0, 0.1, 0.3, 0.35, 0.6])
        positions = np.stack([t - 0.6, 2 * (t - 0.6)], axis=1)
        motion = Demonstrations.from_arrays([positions], times=[t], resample=True)
        assert motion.dt == (0.15,)
        even = np.linspace(0, 0.6, 5) - 0.6
        np.testing.assert_allclose(motion.positions[0], np.stack([even, 2 * even], axis=1))
        np.testing.assert_allclose(motion.velocities[0], np.tile([1.0, 2.0], (5, 1)))

    def test_a_period_takes_the_place_of_a_goal(self):
        motion = Demonstrations.from_arrays([line(end=(5, 5)), line()], dt=0.1, period=0.7)
        assert motion.goal is None
        assert motion.period == 0.7
        with pytest.raises(ValueError, match=r"repeats with a period of 0\.7 s and has no goal"):
            _ = motion.attractor

    def test_a_tolerance_accepts_a_spread(self):
        motion = Demonstrations.from_arrays(
            [line(end=(0.2, 0)), line(end=(-0.2, 0))], dt=0.1, goal_tolerance=0.3
        )
        np.testing.assert_allclose(motion.goal, [0, 0], atol=1e-15)

    @given(spread=st.floats(0.05, 50), seed=st.integers(0, 1000))
    @settings(max_examples=60, deadline=None)
    def test_the_advised_tolerance_suffices(self, spread, seed):
        ends = np.random.default_rng(seed).normal(0, spread, size=(3, 2))
        recordings = [line(end=end, start=(1, 2)) for end in ends]
        with pytest.raises(ValueError, match="goal_tolerance=") as caught:
            Demonstrations.from_arrays(recordings, dt=0.1, goal_tolerance=1e-9)
        advice = float(str(caught.value).split("goal_tolerance=")[1].split(" ")[0])
        Demonstrations.from_arrays(recordings, dt=0.1, goal_tolerance=advice)

    @pytest.mark.parametrize(
        ("positions", "arguments", "message"),
        [
            ([np.full((20, 2), np.nan)], {"dt": 0.1}, "20 samples with NaN or infinity, the first"),
            ([line(1)], {"dt": 0.1}, "at least 3 samples, got 1"),
            ([line(), np.zeros((20, 3))], {"dt": 0.1}, r"one dimension, got dimensions \[2, 3\]"),
            ([line()], {"dt": 0.0}, "dt > 0 in seconds, got 0.0"),
            ([line()], {"dt": [0.1, 0.1]}, "one for each of 1 recordings, got 2"),
            ([line()] * 2, {"dt": 0.1, "held_out": 2}, "held_out .* from 0 to 1, .* got 2"),
            ([line()], {}, "either dt .* or times .*, got neither"),
            ([line()], {"dt": 0.1, "times": [np.arange(20)]}, "got both"),
            ([line()], {"times": [np.arange(20)[::-1]]}, "to increase, got 19.0 then 18.0"),
            ([line()], {"times": [np.arange(20) ** 2]}, "evenly spaced.*resample=True"),
            ([line()], {"times": [np.arange(19)]}, r"times\[0\] of shape \(20,\), got \(19,\)"),
            ([line(), line(end=(1, 0))], {"dt": 0.1}, r"up to 0\.5 away.*goal_tolerance="),
            ([line()], {"dt": 0.1, "goal": [1.0, 1.0]}, r"up to 1\.414 away"),
            ([line()], {"dt": 0.1, "goal": [0.0]}, r"finite goal of shape \(2,\)"),
            (
                [line()],
                {"dt": 0.1, "goal_tolerance": np.nan},
                "goal_tolerance >= 0, got nan",
            ),
            ([line()], {"dt": 0.1, "period": 1.0, "goal": [0, 0]}, "either a goal .* or a period"),
            ([line()], {"dt": 0.1, "period": -1.0}, "positive period in seconds, got -1.0"),
            (
                [line()],
                {"dt": 0.1, "velocities": [line(19)]},
                "of the positions' shapes",
            ),
            ([line()], {"dt": 0.1, "velocities": [0 * line()]}, "got zeros throughout"),
            ([np.ones((9, 2))], {"dt": 0.1}, "of a motion, got samples that are all"),
            (line(), {"dt": 0.1}, r"put it into a list, \[array\]"),
            ([np.arange(20.0)], {"dt": 0.1}, r"use array\[:, None\]"),
            ([], {"dt": 0.1}, "at least one recording, got none"),
        ],
    )
    def test_bad_input_says_what_was_expected(self, positions, arguments, message):
        with pytest.raises(ValueError, match=message):
            Demonstrations.from_arrays(positions, **arguments)

    def test_what_is_not_numbers(self):
        with pytest.raises(TypeError, match=r"positions\[0\] to be an array of numbers"):
            Demonstrations.from_arrays([[["a", "b"]] * 5], dt=0.1)


class TestSplits:
    def test_reproduction_fits_and_scores_on_all(self):
        motion = Demonstrations.from_arrays([line()] * 3, dt=0.1)
        fit, score = motion.split("reproduction")
        assert fit is motion
        assert score is motion

    @pytest.mark.parametrize(("n", "n_fit"), [(2, 1), (3, 2), (7, 4), (10, 6)])
    def test_generalisation_holds_out_the_last(self, n, n_fit):
        recordings = [line(start=(i + 1, 2)) for i in range(n)]
        motion = Demonstrations.from_arrays(recordings, dt=[0.1 + i for i in range(n)])
        fit, score = motion.split("generalisation")
        assert fit.dt == motion.dt[:n_fit]
        assert score.dt == motion.dt[n_fit:]
        np.testing.assert_array_equal(score.goal, motion.goal)

    def test_what_is_held_out_is_never_fitted_on(self):
        steps = [0.1 + i for i in range(5)]
        motion = Demonstrations.from_arrays([line()] * 5, dt=steps, held_out=2)
        for protocol, scored in (("reproduction", steps[:3]), ("generalisation", steps[3:])):
            fit, score = motion.split(protocol)
            assert list(fit.dt) == steps[:3]
            assert list(score.dt) == scored
            assert fit.held_out == score.held_out == 0
        assert motion.sha256 != motion.subset(range(5)).sha256

    def test_errors(self):
        motion = Demonstrations.from_arrays([line()], dt=0.1)
        with pytest.raises(ValueError, match="at least 2 recordings"):
            motion.split("generalisation")
        with pytest.raises(ValueError, match=r"protocol of .*got 'test'"):
            motion.split("test")
        with pytest.raises(ValueError, match="at least one index"):
            motion.subset([])


def test_the_hash_is_of_the_numbers():
    one = Demonstrations.from_arrays([line()], dt=0.1)
    same = Demonstrations.from_arrays([line()], dt=0.1, name="other")
    moved = Demonstrations.from_arrays([line() + np.array([1e-12, 0])], dt=0.1)
    slower = Demonstrations.from_arrays([line()], dt=0.2)
    assert one.sha256 == same.sha256
    assert len({one.sha256, moved.sha256, slower.sha256}) == 3
