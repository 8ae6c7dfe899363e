"""Stability on trajectories whose behaviour is known in closed form."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iflow_gym import metrics
from iflow_gym.metrics import stability

LOW, HIGH = np.array([-30.0, -10.0]), np.array([30.0, 70.0])  # diagonal 100, tolerance 2
GOAL = np.array([1.0, -2.0])
TOLERANCE = 2.0
DT = 0.01


def decays(radii, rate=2.0, goal=GOAL, n_samples=1000):
    """Straight exponential approaches to a goal from given distances, shape (n, T, 2)."""
    t = DT * np.arange(n_samples)
    radii = np.asarray(radii, dtype=float)
    angle = np.linspace(0, 5, len(radii))
    start = radii[:, None] * np.c_[np.cos(angle), np.sin(angle)]
    return goal + start[:, None, :] * np.exp(-rate * t)[None, :, None]


class TestBoxes:
    def test_enlarged_box_keeps_the_centre(self):
        low, high = metrics.enlarged_box(LOW, HIGH, 2.0)
        np.testing.assert_allclose(low, [-60, -50])
        np.testing.assert_allclose(high, [60, 110])
        np.testing.assert_allclose(metrics.enlarged_box(LOW, HIGH, 1.0), (LOW, HIGH))

    def test_scale(self):
        assert metrics.box_diagonal(LOW, HIGH) == pytest.approx(100.0)
        assert metrics.convergence_tolerance(LOW, HIGH) == pytest.approx(TOLERANCE)

    def test_start_grid_in_the_plane(self):
        starts = metrics.start_grid(LOW, HIGH)
        assert starts.shape == (256, 2)
        assert len(np.unique(starts, axis=0)) == 256
        np.testing.assert_allclose(starts.min(axis=0), [-60, -50])
        np.testing.assert_allclose(starts.max(axis=0), [60, 110])
        np.testing.assert_allclose(starts[1] - starts[0], [0, 160 / 15])  # the last axis is fastest
        np.testing.assert_allclose(starts.mean(axis=0), (LOW + HIGH) / 2)

    def test_start_grid_in_space_and_elsewhere(self):
        assert metrics.start_grid(np.zeros(3), np.ones(3)).shape == (343, 3)
        assert metrics.start_grid(np.zeros(4), np.ones(4), n_per_axis=3).shape == (81, 4)
        np.testing.assert_allclose(metrics.start_grid([0.0], [1.0], 2), [[-0.5], [1.5]])
        with pytest.raises(ValueError, match="2-D or 3-D, got 4-D: pass n_per_axis"):
            metrics.start_grid(np.zeros(4), np.ones(4))
        with pytest.raises(ValueError, match="n_per_axis of at least 2, got 1"):
            metrics.start_grid(LOW, HIGH, 1)

    @pytest.mark.parametrize(
        ("low", "high", "text"),
        [
            ([0, 0], [1, 0], "pad a side that has no length"),
            ([0, 0], [1, np.inf], "finite low < high"),
            ([0, 0], [1, 1, 1], r"of shape \(d,\), got \(2,\) and \(3,\)"),
            ([[0, 0]], [[1, 1]], r"of shape \(d,\), got \(1, 2\)"),
        ],
    )
    def test_what_is_no_box(self, low, high, text):
        with pytest.raises(ValueError, match=text):
            metrics.start_grid(low, high)

    def test_what_is_no_factor(self):
        with pytest.raises(ValueError, match="finite factor > 0, got 0"):
            metrics.enlarged_box(LOW, HIGH, 0)


class TestConverged:
    def test_decays_and_one_that_stays_away(self):
        rollouts = np.concatenate([decays([50, 20, 1]), decays([5, 5], goal=GOAL + 10)])
        outcome = metrics.converged(rollouts, GOAL, TOLERANCE)
        assert outcome.tolist() == [True, True, True, False, False]
        assert metrics.fraction(outcome) == pytest.approx(0.6)

    def test_needs_the_whole_last_twentieth(self):
        rollouts = np.tile(GOAL, (4, 1000, 1))
        rollouts[0, 949, 0] += 3.0  # just before the last 50 samples
        rollouts[1, 950, 0] += 3.0
        rollouts[2, 999, 0] += 3.0
        rollouts[3, 975, 0] += 2.0  # on the tolerance is within it
        assert metrics.converged(rollouts, GOAL, TOLERANCE).tolist() == [True, False, False, True]

    @pytest.mark.parametrize(("n_samples", "n_final"), [(1, 1), (20, 1), (21, 2), (40, 2), (41, 3)])
    def test_last_twentieth_is_rounded_up(self, n_samples, n_final):
        rollouts = np.tile(GOAL, (n_samples, n_samples, 1))
        rollouts[np.arange(n_samples), np.arange(n_samples), 0] += 3.0  # outside at one sample each
        expected = np.arange(n_samples) < n_samples - n_final
        np.testing.assert_array_equal(metrics.converged(rollouts, GOAL, TOLERANCE), expected)

    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
    def test_not_finite_anywhere(self, value):
        rollouts = np.tile(GOAL, (2, 100, 1))
        rollouts[0, 10, 1] = value
        assert metrics.converged(rollouts, GOAL, TOLERANCE).tolist() == [False, True]

    def test_far_beyond_what_squares_hold(self):
        assert not metrics.converged(np.full((1, 100, 2), 1e300), GOAL, TOLERANCE).any()

    def test_errors(self):
        with pytest.raises(ValueError, match=r"of shape \(n, T, d\), got \(100, 2\)"):
            metrics.converged(np.zeros((100, 2)), GOAL, TOLERANCE)
        with pytest.raises(ValueError, match=r"finite goal of shape \(2,\)"):
            metrics.converged(np.zeros((1, 100, 2)), np.zeros(3), TOLERANCE)
        with pytest.raises(ValueError, match="finite tolerance > 0, got -1"):
            metrics.converged(np.zeros((1, 100, 2)), GOAL, -1)

    def test_fraction_takes_booleans(self):
        with pytest.raises(ValueError, match=r"booleans of shape \(n,\), got float64"):
            metrics.fraction([0.0, 1.0])


class TestSettlingTime:
    @pytest.mark.parametrize("rate", [1.0, 2.5])
    def test_exponential_decay(self, rate):
        radii = [10.0, 20.0, 40.0]
        value = metrics.settling_time(decays(radii, rate), GOAL, TOLERANCE, DT, mean_duration=4.0)
        exact = np.log(20.0 / TOLERANCE) / rate / 4.0  # of the median start
        assert exact <= value <= exact + DT / 4.0  # the first sample after it

    def test_only_for_good_counts(self):
        rollout = decays([20.0])
        rollout[0, 600] = GOAL + 5.0
        value = metrics.settling_time(rollout, GOAL, TOLERANCE, DT, mean_duration=1.0)
        assert value == pytest.approx(601 * DT)

    def test_inside_from_the_start_takes_no_time(self):
        assert metrics.settling_time(decays([1.0]), GOAL, TOLERANCE, DT, 1.0) == 0.0

    def test_a_start_that_never_settles_takes_for_ever(self):
        lost = decays([5.0, 5.0], goal=GOAL + 10)
        lost[1, 500:] = np.nan
        settled = decays([20.0, 20.0, 20.0])
        some = np.concatenate([settled, lost])
        assert metrics.settling_time(some, GOAL, TOLERANCE, DT, 1.0) == pytest.approx(
            np.log(10) / 2, abs=DT
        )
        for most in (some[1:], some[2:], lost):  # half, fewer than half, none
            assert metrics.settling_time(most, GOAL, TOLERANCE, DT, 1.0) == np.inf

    def test_passing_through_at_the_end_is_not_settling(self):
        rollout = np.tile(GOAL + 10, (1, 1000, 1))
        rollout[0, 970:] = GOAL  # in for the last 3 %
        assert metrics.settling_time(rollout, GOAL, TOLERANCE, DT, 1.0) == np.inf
        rollout[0, 950:] = GOAL
        assert metrics.settling_time(rollout, GOAL, TOLERANCE, DT, 1.0) == pytest.approx(9.5)

    @given(st.lists(st.floats(0.1, 200), min_size=1, max_size=9))
    @settings(max_examples=30, deadline=None)
    def test_finite_exactly_where_more_than_half_converge(self, radii):
        rollouts = decays(radii, rate=0.4)
        half = metrics.fraction(metrics.converged(rollouts, GOAL, TOLERANCE)) > 0.5
        value = metrics.settling_time(rollouts, GOAL, TOLERANCE, DT, 1.0)
        assert np.isfinite(value) == half

    @pytest.mark.parametrize(("dt", "duration", "name"), [(0, 1, "dt"), (1, -1, "mean_duration")])
    def test_errors(self, dt, duration, name):
        with pytest.raises(ValueError, match=f"finite {name} > 0"):
            metrics.settling_time(decays([1.0]), GOAL, TOLERANCE, dt, duration)


class TestSpuriousAttractors:
    def count(self, rollouts):
        return metrics.spurious_attractors(rollouts, GOAL, TOLERANCE)

    def test_none(self):
        assert self.count(decays([50, 20, 1])) == 0

    def test_each_cluster_once(self):
        # The third is a single end state, which is a cluster too.
        second = decays([10, 20, 30], goal=GOAL + np.array([40, 0]))
        third = decays([10], goal=GOAL + np.array([0, 40]))
        assert self.count(np.concatenate([decays([50, 20]), second])) == 1
        assert self.count(np.concatenate([decays([50, 20]), second, third])) == 2

    def test_a_line_of_equilibria_is_one(self):
        ends = GOAL + np.c_[np.linspace(10, 40, 20), np.zeros(20)]  # hops of 1.6 < tolerance
        assert self.count(np.repeat(ends[:, None], 100, axis=1)) == 1
        assert self.count(np.repeat(ends[::2, None], 100, axis=1)) == 10  # hops of 3.2

    def test_still_moving_is_not_stopped(self):
        t = DT * np.arange(1000)
        drifting = GOAL + 10 + np.c_[t, 0 * t]  # 0.49 in the last 50 samples, below a quarter of 2
        assert self.count(drifting[None]) == 1
        assert self.count((GOAL + 10 + np.c_[1.1 * t, 0 * t])[None]) == 0

    def test_a_cycle_is_no_point_but_a_chatter_is(self):
        t = np.arange(1000)
        circle = np.c_[np.cos(t), np.sin(t)]
        assert self.count((GOAL + 20 + 5 * circle)[None]) == 0
        assert self.count((GOAL + 20 + 0.2 * circle)[None]) == 1

    def test_runaways_are_in_no_cluster(self):
        rollouts = np.tile(GOAL + 20, (3, 100, 1))
        rollouts[0, -1] = np.nan
        rollouts[1, 3] = np.inf
        assert self.count(rollouts) == 1
        assert self.count(rollouts[:2]) == 0

    def test_too_short(self):
        with pytest.raises(ValueError, match=r"at least 21 samples, .* got 20"):
            self.count(np.zeros((1, 20, 2)))


class TestDiverged:
    def test_leaving_at_any_time(self):
        rollouts = np.zeros((5, 100, 2))
        rollouts[1, 50] = [301, 0]  # the box enlarged ten times is [-300, 300] x [-370, 430]
        rollouts[2, 50] = [299, 429]
        rollouts[3, -1] = np.nan
        rollouts[4, 20:] = -np.inf
        outcome = metrics.diverged(rollouts, LOW, HIGH)
        assert outcome.tolist() == [False, True, False, True, True]

    def test_growing_exponential(self):
        rollouts = decays([1.0, 0.5], rate=-70.0)  # up to 1e303, whose square overflows
        assert metrics.diverged(rollouts, LOW, HIGH).all()
        assert not metrics.converged(rollouts, GOAL, TOLERANCE).any()
        assert metrics.settling_time(rollouts, GOAL, TOLERANCE, DT, 1.0) == np.inf
        assert metrics.spurious_attractors(rollouts, GOAL, TOLERANCE) == 0

    def test_dimension(self):
        with pytest.raises(ValueError, match=r"finite low of shape \(3,\)"):
            metrics.diverged(np.zeros((1, 5, 3)), LOW, HIGH)


class TestLyapunov:
    def test_states_fill_the_enlarged_box(self):
        states = metrics.uniform_states(LOW, HIGH, rng=np.random.default_rng(0))
        assert states.shape == (10_000, 2)
        low, high = metrics.enlarged_box(LOW, HIGH, 2.0)
        assert (states >= low).all()
        assert (states <= high).all()
        counts = np.histogramdd(states, bins=4, range=list(zip(low, high, strict=True)))[0]
        assert np.abs(counts - 625).max() < 5 * np.sqrt(625)  # 5 standard deviations

    def test_quadratic_function_along_a_saddle(self):
        # V = x² + y² along f = (-x, 2y): dV/dt = -2x² + 4y² < 0 where |y| < |x| / sqrt(2).
        states = metrics.uniform_states([-1, -1], [1, 1], 40_000, rng=np.random.default_rng(0))
        derivative = -2 * states[:, 0] ** 2 + 4 * states[:, 1] ** 2
        exact = 1 - 1 / (2 * np.sqrt(2))
        value = metrics.lyapunov_violation(derivative, states, np.zeros(2))
        assert value == pytest.approx(exact, abs=5 * 0.5 / np.sqrt(40_000))

    def test_zero_is_a_violation_except_at_the_goal(self):
        states = np.array([[1.0, 0.0], [2.0, 0.0], [0.0, 0.0], [0.0, 5.0]])
        assert metrics.lyapunov_violation([-1, 0, 0, -1], states, [0, 0]) == pytest.approx(1 / 3)
        assert metrics.lyapunov_violation([-1, -1, 0, -1], states, [0, 0]) == 0.0

    def test_nan_is_a_violation(self):
        assert metrics.lyapunov_violation([np.nan, -1.0], [[1.0, 0], [2, 0]], [0, 0]) == 0.5

    def test_errors(self):
        with pytest.raises(ValueError, match=r"got \(3,\) and \(2, 2\)"):
            metrics.lyapunov_violation(np.zeros(3), np.zeros((2, 2)), [0, 0])
        with pytest.raises(ValueError, match="states other than the goal, got 2 at the goal"):
            metrics.lyapunov_violation(np.zeros(2), np.zeros((2, 2)), [0, 0])
        with pytest.raises(ValueError, match="n of at least 1"):
            metrics.uniform_states(LOW, HIGH, 0, rng=np.random.default_rng(0))


def test_grid_of_a_linear_system():
    """The suite's protocol on x' = -(x - goal): everything converges, at a known median time."""
    starts = metrics.start_grid(LOW, HIGH)
    n_samples = int(stability.HORIZON * 2.0 / DT)  # demonstrations of 2 s
    decay = np.exp(-DT * np.arange(n_samples))
    rollouts = GOAL + (starts - GOAL)[:, None] * decay[None, :, None]
    tolerance = metrics.convergence_tolerance(LOW, HIGH)
    assert metrics.fraction(metrics.converged(rollouts, GOAL, tolerance)) == 1.0
    assert metrics.fraction(metrics.diverged(rollouts, LOW, HIGH)) == 0.0
    assert metrics.spurious_attractors(rollouts, GOAL, tolerance) == 0
    exact = np.median(np.log(np.linalg.norm(starts - GOAL, axis=1) / tolerance)) / 2.0
    value = metrics.settling_time(rollouts, GOAL, tolerance, DT, mean_duration=2.0)
    assert exact <= value <= exact + DT / 2.0
