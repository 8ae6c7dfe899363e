"""Comparisons of methods, against SciPy, published tables and cases made by hand."""

import math

import numpy as np
import pytest
from scipy import stats

from iflow_gym.metrics import mean_ranks
from iflow_gym.statistics import (
    compare_ranks,
    mean_intervals,
    nemenyi_quantile,
    performance_profile,
    probability_of_improvement,
)

nan, inf = math.nan, math.inf


# Probability of improvement -----------------------------------------------------------------


def test_the_probability_is_mann_whitneys_u_over_its_greatest_value():
    rng = np.random.default_rng(0)
    x = [rng.integers(0, 6, size=n) for n in (3, 5, 4)]  # integers: with ties
    y = [rng.integers(1, 7, size=n) for n in (4, 2, 4)]
    found = probability_of_improvement(x, y, "higher")
    each = [
        stats.mannwhitneyu(a, b).statistic / (len(a) * len(b)) for a, b in zip(x, y, strict=True)
    ]
    assert found.probability == pytest.approx(np.mean(each), abs=1e-15)
    assert found.n_environments == 3
    assert found.resampled == "seeds"


def test_a_probability_by_hand():
    # Of 2 x 2 pairs: 1 < 2, 1 < 3, 3 > 2, 3 = 3; then 1 pair that is worse.
    found = probability_of_improvement([[1.0, 3.0], [5.0]], [[2.0, 3.0], [4.0]], "lower")
    assert found.probability == ((1 + 1 + 0 + 0.5) / 4 + 0) / 2


@pytest.mark.parametrize(
    ("x", "y", "probability"),
    [
        (nan, inf, 0.0),  # failed is worse than a runaway
        (inf, nan, 1.0),
        (nan, nan, 0.5),
        (inf, inf, 0.5),
        (1e308, inf, 1.0),
        (0.0, nan, 1.0),
    ],
)
@pytest.mark.parametrize("better", ["lower", "higher"])
def test_failed_cells_are_worse_than_all_others(x, y, probability, better):
    sign = 1 if better == "lower" else -1
    found = probability_of_improvement([[sign * x]], [[sign * y]], better)
    assert found.probability == probability
    assert found.resampled == "nothing"
    assert math.isnan(found.interval[0])


def test_the_two_ways_round_add_up_to_one():
    rng = np.random.default_rng(1)
    x, y = rng.normal(size=(2, 6, 3))
    x[0, 0] = y[2, 1] = nan
    one = probability_of_improvement(x, y, "lower")
    other = probability_of_improvement(y, x, "lower")
    assert one.probability + other.probability == pytest.approx(1, abs=1e-15)
    assert probability_of_improvement(x, x, "lower").probability == 0.5


def test_the_interval_resamples_seeds_or_else_environments():
    """Without overlap of the seeds nothing depends on their draw; on the environments it does."""
    x = np.array([[1.0, 1.1], [2.0, 2.1], [9.0, 9.1], [1.0, 1.2]])
    y = np.array([[3.0, 3.1], [3.0, 3.1], [3.0, 3.1], [3.0, 3.1]])
    assert probability_of_improvement(x, y, "lower").interval == (0.75, 0.75)
    single = probability_of_improvement(x[:, :1], y[:, :1], "lower", n_resamples=20_000)
    assert single.resampled == "environments"
    # Wins of 4 draws are binomial(4, 3/4): P(<= 1) = 0.0508, P(0) = 0.0039, so 2.5 % is at 1/4.
    assert single.interval == (0.25, 1.0)


def test_the_bootstrap_of_two_seeds_by_hand():
    """One environment, wins [[1, 0], [1, 0]]: a resample's value is the share of y's first seed."""
    found = probability_of_improvement(
        [[1.0, 1.0]], [[2.0, 0.0]], "lower", n_resamples=20_000, confidence=0.4
    )
    # 0, 1/2, 1 with 1/4, 1/2, 1/4: the tails of 0.3 are both in the middle.
    assert found.interval == (0.5, 0.5)


# Ranks --------------------------------------------------------------------------------------


@pytest.mark.parametrize("ties", [False, True])
def test_friedman_as_scipy(ties):
    rng = np.random.default_rng(2)
    scores = rng.normal(size=(5, 12)) + np.arange(5)[:, None] / 2
    if ties:
        scores = np.round(scores)
    found = compare_ranks(scores, "lower")
    expected = stats.friedmanchisquare(*scores)
    assert found.statistic == pytest.approx(expected.statistic, rel=1e-12)
    assert found.p_value == pytest.approx(expected.pvalue, rel=1e-10)
    np.testing.assert_allclose(found.mean_ranks, mean_ranks(scores, "lower"), rtol=1e-15)


def test_friedman_by_hand():
    """Four environments that agree on three methods: ranks 1, 2, 3, and the greatest statistic."""
    found = compare_ranks([[3.0] * 4, [1.0] * 4, [2.0] * 4], "lower")
    assert found.mean_ranks.tolist() == [3.0, 1.0, 2.0]
    assert found.statistic == pytest.approx(4 * (3 - 1))  # E (M - 1)
    assert compare_ranks([[3.0] * 4, [1.0] * 4, [2.0] * 4], "higher").mean_ranks.tolist() == [
        1.0, 3.0, 2.0,
    ]  # fmt: skip


def test_failed_cells_rank_last_in_either_direction():
    scores = [[nan, 1.0, 1.0], [inf, 2.0, 2.0], [nan, 3.0, 3.0]]
    assert compare_ranks(scores, "lower").mean_ranks.tolist() == pytest.approx(
        [(2.5 + 1 + 1) / 3, (1 + 2 + 2) / 3, (2.5 + 3 + 3) / 3]
    )
    for better in ("lower", "higher"):
        np.testing.assert_allclose(
            compare_ranks(scores, better).mean_ranks, mean_ranks(scores, better), rtol=1e-15
        )


def test_all_ties_say_nothing():
    found = compare_ranks(np.ones((3, 6)), "lower")
    assert math.isnan(found.statistic)
    assert found.p_value == 1.0
    assert found.groups == ((0, 1, 2),)


@pytest.mark.parametrize(
    ("n", "q05", "q10"),
    [
        (2, 1.960, 1.645),
        (3, 2.343, 2.052),
        (5, 2.728, 2.459),
        (8, 3.031, 2.780),
        (10, 3.164, 2.920),
    ],
)
def test_nemenyis_quantiles_are_those_of_demsars_table_5(n, q05, q10):
    assert nemenyi_quantile(n, 0.05) == pytest.approx(q05, abs=1e-3)
    assert nemenyi_quantile(n, 0.10) == pytest.approx(q10, abs=1e-3)


def test_the_critical_difference_of_demsars_example():
    """Section 3.2.2: four classifiers on 14 data sets; ranks and statistic are printed there."""
    data = np.array(
        [
            [0.763, 0.599, 0.954, 0.628, 0.882, 0.936, 0.661, 0.583, 0.775, 1.000, 0.940, 0.619,
             0.972, 0.957],
            [0.768, 0.591, 0.971, 0.661, 0.888, 0.931, 0.668, 0.583, 0.838, 1.000, 0.962, 0.666,
             0.981, 0.978],
            [0.771, 0.590, 0.968, 0.654, 0.886, 0.916, 0.609, 0.563, 0.866, 1.000, 0.965, 0.614,
             0.9751, 0.946],
            [0.798, 0.569, 0.967, 0.657, 0.898, 0.931, 0.685, 0.625, 0.875, 1.000, 0.962, 0.669,
             0.975, 0.970],
        ]
    )  # fmt: skip
    found = compare_ranks(data, "higher")
    np.testing.assert_allclose(found.mean_ranks, [3.143, 2.000, 2.893, 1.964], atol=5e-4)
    assert found.critical_difference == pytest.approx(2.569 * math.sqrt(4 * 5 / (6 * 14)), abs=1e-3)


def test_groups_are_the_largest_that_cannot_be_told_apart():
    # Strict order on every environment: mean ranks 1 to 6; CD = 2.850 sqrt(42 / (6 E)).
    scores = np.repeat(np.arange(6.0)[:, None], 12, axis=1)
    found = compare_ranks(scores, "lower")
    assert 2 < found.critical_difference < 3
    assert found.groups == ((0, 1, 2), (1, 2, 3), (2, 3, 4), (3, 4, 5))
    many = compare_ranks(np.repeat(scores, 30, axis=1), "lower")
    assert many.critical_difference < 1
    assert many.groups == ()


# Profiles -----------------------------------------------------------------------------------


def test_a_profile_is_the_share_of_cells_that_reach_a_threshold():
    found = performance_profile([[1.0, 3.0], [2.0, nan], [inf, 2.0]], [0.5, 1, 2, 3, 1e9], "lower")
    np.testing.assert_allclose(found.fraction, np.array([0, 1, 3, 4, 4]) / 6, rtol=1e-15)
    higher = performance_profile([[0.1, nan], [0.9, 1.0]], [0.0, 0.5, 1.0], "higher")
    np.testing.assert_allclose(higher.fraction, [0.75, 0.5, 0.25])


def test_environments_count_alike_however_many_seeds_they_have():
    found = performance_profile([[1.0, 1.0, 1.0], [5.0]], [2.0], "lower")
    assert found.fraction.tolist() == [0.5]


def test_a_profiles_band():
    found = performance_profile(np.arange(50.0)[:, None], [-1, 9, 24, 60], "lower")
    assert found.resampled == "environments"
    assert (found.low <= found.fraction).all()
    assert (found.fraction <= found.high).all()
    assert found.low[0] == found.high[0] == 0
    assert found.low[-1] == found.high[-1] == 1
    # Binomial(50, 0.5) / 50: its 2.5 % and 97.5 % quantiles.
    assert found.low[2] == pytest.approx(stats.binom.ppf(0.025, 50, 0.5) / 50, abs=0.021)
    assert found.high[2] == pytest.approx(stats.binom.ppf(0.975, 50, 0.5) / 50, abs=0.021)
    fixed = performance_profile([[1.0, 1.1], [5.0, 5.1]], [3.0], "lower")
    assert (fixed.low[0], fixed.high[0]) == (0.5, 0.5)


# Intervals of means -------------------------------------------------------------------------


def test_intervals_of_means_as_scipys_bootstrap():
    rng = np.random.default_rng(3)
    values = rng.gamma(2.0, size=(3, 7))
    low, high = mean_intervals(values, n_resamples=20_000)
    for row, a, b in zip(values, low, high, strict=True):
        expected = stats.bootstrap(
            (row,), np.mean, n_resamples=20_000, method="percentile", rng=rng
        ).confidence_interval
        assert a == pytest.approx(expected.low, rel=0.03)
        assert b == pytest.approx(expected.high, rel=0.03)


def test_sets_do_not_depend_on_their_neighbours():
    values = np.random.default_rng(4).normal(size=(600, 5))
    low, high = mean_intervals(values, n_resamples=200)
    alone = mean_intervals(values[577:578], n_resamples=200)
    assert (low[577], high[577]) == pytest.approx((alone[0][0], alone[1][0]), rel=1e-12)


def test_intervals_of_what_is_not_finite():
    low, high = mean_intervals([[1.0, 2.0, inf], [1.0, nan, 2.0], [4.0, 4.0, 4.0]])
    assert low[0] < 3
    assert high[0] == inf
    assert math.isnan(low[1])
    assert math.isnan(high[1])
    assert (low[2], high[2]) == pytest.approx((4, 4))
    assert np.isnan(mean_intervals([[1.0], [2.0]])).all()


# Errors -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: probability_of_improvement([[1.0]], [[1.0], [2.0]], "lower"), "same environments"),
        (lambda: probability_of_improvement([], [], "lower"), "one or more environments"),
        (lambda: probability_of_improvement([[]], [[1.0]], "lower"), "at least one"),
        (lambda: probability_of_improvement([[1.0]], [[1.0]], "less"), "lower"),
        (lambda: probability_of_improvement([[1.0]], [[1.0]], "lower", confidence=1), "confidence"),
        (lambda: compare_ranks([[1.0, 2.0]], "lower"), "at least two"),
        (lambda: compare_ranks(np.eye(3), "lower", alpha=0), "alpha"),
        (lambda: performance_profile([[1.0]], [nan], "lower"), "without nan"),
        (lambda: performance_profile([[1.0]], [1.0], "lower", n_resamples=0), "n_resamples"),
        (lambda: mean_intervals([1.0, 2.0]), "shape"),
    ],
)
def test_errors_say_what_was_expected(call, message):
    with pytest.raises(ValueError, match=message):
        call()
