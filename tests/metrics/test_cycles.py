"""Metrics of limit cycles on closed forms: circles, an ellipse, a spiral that never closes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import directed_hausdorff

from iflow_gym.metrics import cycles

DT, PERIOD = 0.01, 2.0
N = round(PERIOD / DT)


def circle(n_periods=4.0, period=PERIOD, radii=(1.0, 1.0), centre=(0.0, 0.0), phase=0.0, dt=DT):
    t = np.arange(round(n_periods * PERIOD / dt)) * dt
    angle = 2 * np.pi * t / period + phase
    return np.stack([radii[0] * np.cos(angle), radii[1] * np.sin(angle)], axis=1) + centre


class TestOrbit:
    def test_the_same_circle_is_at_no_distance_whatever_its_phase_and_speed(self):
        shown = circle(dt=0.001)
        for made in (circle(), circle(phase=1.0), circle(period=2.7)):
            assert cycles.orbit_distance(made, shown) < 5e-3
            assert cycles.orbit_hausdorff(made, shown) < 2e-2

    @pytest.mark.parametrize("radius", [0.7, 1.3])
    def test_a_concentric_circle_is_at_the_difference_of_the_radii(self, radius):
        made = circle(radii=(radius, radius))
        assert cycles.orbit_distance(made, circle()) == pytest.approx(abs(1 - radius), rel=1e-3)
        assert cycles.orbit_hausdorff(made, circle()) == pytest.approx(abs(1 - radius), rel=1e-3)

    def test_a_shifted_circle(self):
        # From a point at angle a of the unit circle, the nearest of a circle shifted by c is at
        # | |p - c| - 1 |: at most |c|.
        made, shown = circle(centre=(0.2, 0.0), dt=1e-3), circle(dt=1e-3)
        angle = np.linspace(0, 2 * np.pi, 100_000, endpoint=False)
        away = np.abs(np.hypot(np.cos(angle) - 0.2, np.sin(angle)) - 1)
        assert cycles.orbit_hausdorff(made, shown) == pytest.approx(0.2, rel=1e-3)
        assert cycles.orbit_distance(made, shown) == pytest.approx(away.mean(), rel=1e-2)

    def test_an_ellipse(self):
        made = circle(radii=(1.5, 1.0), dt=1e-3)
        assert cycles.orbit_hausdorff(made, circle(dt=1e-3)) == pytest.approx(0.5, rel=1e-3)

    @given(st.integers(0, 2**31))
    @settings(max_examples=20, deadline=None)
    def test_scipy_has_the_same_hausdorff_distance(self, seed):
        rng = np.random.default_rng(seed)
        left, right = rng.normal(size=(40, 3)), rng.normal(size=(30, 3))
        expected = max(directed_hausdorff(left, right)[0], directed_hausdorff(right, left)[0])
        assert cycles.orbit_hausdorff(left, right) == pytest.approx(expected)
        assert cycles.orbit_distance(left, right) == cycles.orbit_distance(right, left)
        assert cycles.orbit_distance(left, right) <= cycles.orbit_hausdorff(left, right)

    def test_a_runaway_is_infinitely_far(self):
        made = circle()
        made[3, 0] = np.nan
        assert cycles.orbit_distance(made, circle()) == np.inf
        assert cycles.orbit_hausdorff(made, circle()) == np.inf

    def test_errors(self):
        with pytest.raises(ValueError, match=r"\(T, d\) .* got \(4,\)"):
            cycles.orbit_distance(np.zeros(4), circle())
        with pytest.raises(ValueError, match="one dimension, got 3 and 2"):
            cycles.orbit_distance(np.zeros((4, 3)), circle())
        with pytest.raises(ValueError, match="in this order"):
            cycles.orbit_hausdorff(circle(), np.full((4, 2), np.nan))


class TestPeriod:
    @pytest.mark.parametrize("period", [1.0, 1.37, PERIOD, 2.6])
    def test_of_a_circle_between_samples_too(self, period):
        assert cycles.period(circle(period=period), DT) == pytest.approx(period, rel=2e-3)

    def test_a_stroke_there_and_back_is_one_round(self):
        # There over a high arch, back over a low one: half a round later the mass is on the other
        # side of the swing, and a quarter later nearly where it was.
        t = np.arange(4 * N) * DT
        angle = 2 * np.pi * t / PERIOD
        height = np.where(np.sin(angle) > 0, 1.0, 0.4) * np.abs(np.sin(angle))
        path = np.stack([np.cos(angle), height], axis=1)
        assert cycles.period(path, DT) == pytest.approx(PERIOD, rel=1e-2)

    def test_two_loops_that_nearly_agree_are_two_rounds_and_differing_ones_are_one(self):
        angle = 2 * np.pi * np.arange(6 * N) * DT / PERIOD
        nearly = 1 + 0.02 * np.cos(angle / 2)
        twice = 1 + 0.6 * np.cos(angle / 2)
        loop = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        assert cycles.period(nearly[:, None] * loop, DT) == pytest.approx(PERIOD, rel=1e-2)
        assert cycles.period(twice[:, None] * loop, DT) == pytest.approx(2 * PERIOD, rel=1e-2)

    def test_about_says_which_of_the_peaks_is_meant(self):
        angle = 2 * np.pi * np.arange(6 * N) * DT / PERIOD
        twice = 1 + 0.6 * np.cos(angle / 2)
        loop = twice[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        assert cycles.period(loop, DT, about=1.1 * PERIOD) == pytest.approx(PERIOD, rel=2e-2)
        assert cycles.period(loop, DT, about=2 * PERIOD) == pytest.approx(2 * PERIOD, rel=2e-2)
        # Nothing recurs near it: as if nothing were known.
        assert cycles.period(loop, DT, about=0.2 * PERIOD) == cycles.period(loop, DT)

    def test_what_turns_twice_meanwhile_is_faster(self):
        assert cycles.period(circle(period=PERIOD / 2), DT, about=PERIOD) == pytest.approx(
            PERIOD / 2, rel=1e-2
        )

    def test_what_never_repeats_has_none(self):
        assert cycles.period(np.ones((100, 2)), DT) == np.inf
        assert cycles.period(np.linspace(0, 1, 100)[:, None], DT) == np.inf
        assert cycles.period(1e-9 * circle(), DT, size=1.0) == np.inf
        assert cycles.period(np.full((100, 2), np.nan), DT) == np.inf

    def test_a_spiral_that_never_closes_keeps_its_tempo_and_leaves_the_orbit(self):
        t = np.arange(4 * N) * DT
        spiral = np.exp(-0.3 * t)[:, None] * circle()
        assert cycles.period(spiral, DT) == pytest.approx(PERIOD, rel=0.02)
        assert cycles.orbit_hausdorff(spiral[-2 * N :], circle()) > 0.5

    def test_error(self):
        assert cycles.period_error(2.2, 2.0) == pytest.approx(0.1)
        assert cycles.period_error(np.inf, 2.0) == np.inf
        with pytest.raises(ValueError, match="period > 0"):
            cycles.period_error(1.0, 0.0)


class TestPhase:
    def test_a_shifted_start_costs_nothing(self):
        assert cycles.phase_rmse(circle(2, phase=2.0), circle(1)) < 0.02

    def test_a_wrong_speed_costs_what_the_lag_makes_of_it(self):
        # At the best shift the angle is off by w (t - T/2), |w T| <= 2 pi / 10: 2 - 2 cos of it.
        shown, made = circle(1), circle(2, period=PERIOD / 1.1)
        lag = 2 * np.pi * 0.1 * np.linspace(-0.5, 0.5, 10_001)
        expected = np.sqrt(np.mean(2 - 2 * np.cos(lag)))
        assert cycles.phase_rmse(made, shown) == pytest.approx(expected, rel=2e-2)

    def test_it_is_the_best_of_all_shifts(self):
        rng = np.random.default_rng(0)
        orbit, shown = rng.normal(size=(50, 3)) + 9.0, rng.normal(size=(20, 3)) + 9.0
        tried = [
            np.sqrt(np.mean(np.sum((orbit[s : s + 20] - shown) ** 2, axis=1))) for s in range(31)
        ]
        assert cycles.phase_rmse(orbit, shown) == pytest.approx(min(tried), rel=1e-12)

    def test_errors(self):
        with pytest.raises(ValueError, match=r"at least the 200 samples .* got 100"):
            cycles.phase_rmse(circle(0.5), circle(1))
        assert cycles.phase_rmse(np.full((300, 2), np.inf), circle(1)) == np.inf


class TestAttraction:
    def test_the_last_period_counts_and_all_of_it(self):
        on = circle()
        late = on.copy()
        late[: -N - 1] += 5.0
        away = on.copy()
        away[-3] += 1.0
        gone = on.copy()
        gone[0] = np.nan
        still = np.tile(on[0], (len(on), 1))
        found = cycles.attracted(np.stack([on, late, away, gone, still]), circle(), 0.1, N)
        assert found.tolist() == [True, True, False, False, True]

    def test_errors(self):
        with pytest.raises(ValueError, match="n_samples from 1 to the 800"):
            cycles.attracted(circle()[None], circle(), 0.1, 900)
