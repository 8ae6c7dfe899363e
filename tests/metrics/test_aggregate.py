"""Aggregates against scipy, and the rules for cells that failed."""

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from iflow_gym import metrics

SCORES = np.random.default_rng(0).gamma(2.0, size=(12, 5)) * np.arange(1, 13)[:, None]


class TestInterquartileMean:
    @given(arrays(float, array_shapes(max_dims=2, max_side=13), elements=st.floats(-1e6, 1e6)))
    @settings(max_examples=100, deadline=None)
    def test_scipy(self, scores):
        expected = scipy.stats.trim_mean(scores, 0.25, axis=None)
        assert metrics.interquartile_mean(scores) == pytest.approx(expected, rel=1e-9, abs=1e-6)

    def test_outliers_and_infinity_do_not_move_it(self):
        assert metrics.interquartile_mean([1, 2, 3, np.inf]) == 2.5
        assert metrics.interquartile_mean([1, 2, np.inf]) == np.inf  # nothing is trimmed of three

    def test_nan_is_refused(self):
        with pytest.raises(ValueError, match="got 1 nan of 3: use aggregate_scores"):
            metrics.interquartile_mean([1.0, np.nan, 2.0])
        with pytest.raises(ValueError, match="got 0 nan of 0"):
            metrics.interquartile_mean([])


class TestBootstrap:
    def test_one_environment_against_scipy(self):
        scores = SCORES.ravel()
        ours = metrics.stratified_bootstrap(scores[None])
        theirs = scipy.stats.bootstrap(
            (scores,), np.mean, method="percentile", rng=np.random.default_rng(1)
        ).confidence_interval
        # Two Monte Carlo runs of 10 000: their percentiles differ by a few hundredths of a width.
        assert ours.mean == pytest.approx(tuple(theirs), abs=0.05 * (theirs.high - theirs.low))
        assert ours.resampled == "seeds"

    def test_one_environment_against_scipy_for_the_iqm(self):
        scores = SCORES.ravel()
        ours = metrics.stratified_bootstrap(scores[None])
        theirs = scipy.stats.bootstrap(
            (scores,),
            lambda x, axis: scipy.stats.trim_mean(x, 0.25, axis=axis),
            method="percentile",
            rng=np.random.default_rng(1),
        ).confidence_interval
        assert ours.iqm == pytest.approx(tuple(theirs), abs=0.05 * (theirs.high - theirs.low))

    def test_strata_remove_the_variance_between_environments(self):
        # Variance of the stratified mean, exactly: sum of s_e² / S over E², s_e with 1/S inside.
        ours = metrics.stratified_bootstrap(SCORES)
        error = np.sqrt((SCORES.var(axis=1) / 5).sum()) / 12
        width = ours.mean[1] - ours.mean[0]
        assert width == pytest.approx(2 * 1.96 * error, rel=0.05)  # close to normal
        pooled = metrics.stratified_bootstrap(SCORES.reshape(1, -1))
        assert width < 0.9 * (pooled.mean[1] - pooled.mean[0])

    def test_one_seed_resamples_the_environments(self):
        one = metrics.stratified_bootstrap(SCORES[:, :1])
        assert one.resampled == "environments"
        assert one.mean == metrics.stratified_bootstrap(SCORES[:, 0][None]).mean
        assert metrics.stratified_bootstrap(SCORES[:, :2]).resampled == "seeds"
        assert one.mean[0] < SCORES[:, 0].mean() < one.mean[1]

    def test_one_score_has_no_interval(self):
        for scores in ([[3.0]], [[np.nan], [3.0]], [[np.nan]]):
            result = metrics.stratified_bootstrap(scores)
            assert result.resampled == "nothing"
            assert np.isnan([*result.mean, *result.iqm]).all()

    def test_equal_seeds_have_no_width(self):
        result = metrics.stratified_bootstrap(np.repeat([[1.0], [3.0]], 3, axis=1))
        assert result.mean == (2.0, 2.0)

    def test_unequal_numbers_of_seeds(self):
        ragged = {"b": [3.0, 3.0], "a": [1.0, 1.0, 1.0], "c": [np.nan]}
        assert metrics.stratified_bootstrap(ragged).mean == pytest.approx((9 / 5, 9 / 5))

    def test_reproducible_and_blind_to_the_mappings_order(self):
        rows = {f"environment {i}": row for i, row in enumerate(SCORES)}
        backwards = dict(reversed(rows.items()))
        first = metrics.stratified_bootstrap(rows)
        assert first == metrics.stratified_bootstrap(backwards)
        assert first != metrics.stratified_bootstrap(rows, seed=1)

    def test_confidence(self):
        wide = metrics.stratified_bootstrap(SCORES, confidence=0.99).mean
        narrow = metrics.stratified_bootstrap(SCORES, confidence=0.5).mean
        assert wide[0] < narrow[0] < SCORES.mean() < narrow[1] < wide[1]

    def test_infinite_scores(self):
        scores = SCORES.copy()
        scores[0, 0] = np.inf
        result = metrics.stratified_bootstrap(scores)
        assert np.isfinite(result.mean[0])  # the seed is drawn in two thirds of the resamples
        assert result.mean[1] == np.inf
        assert np.isfinite(result.iqm).all()

    def test_errors(self):
        with pytest.raises(ValueError, match=r"got \(4,\): for one seed pass scores\[:, None\]"):
            metrics.stratified_bootstrap(np.ones(4))
        with pytest.raises(ValueError, match=r"of shape \(S,\), got shapes \[\(1, 2\)\]"):
            metrics.stratified_bootstrap({"a": [[1.0, 2.0]]})
        with pytest.raises(ValueError, match=r"of shape \(S,\), got shapes \[\]"):
            metrics.stratified_bootstrap({})
        with pytest.raises(ValueError, match=r"confidence in \(0, 1\), got 100 and 95"):
            metrics.stratified_bootstrap(SCORES, n_resamples=100, confidence=95)


class TestAggregate:
    def test_complete(self):
        result = metrics.aggregate_scores(SCORES)
        intervals = metrics.stratified_bootstrap(SCORES)
        assert result.mean == pytest.approx(SCORES.mean())
        assert result.iqm == pytest.approx(scipy.stats.trim_mean(SCORES, 0.25, axis=None))
        assert (result.mean_interval, result.iqm_interval) == (intervals.mean, intervals.iqm)
        assert result.resampled == "seeds"
        assert result.complete
        assert result.coverage == "60 of 60"

    def test_failed_cells_are_counted(self):
        scores = SCORES.copy()
        scores[2, 1] = scores[7] = np.nan
        result = metrics.aggregate_scores(scores)
        assert result.mean == pytest.approx(np.nanmean(scores))
        assert not result.complete
        assert result.coverage == "54 of 60"

    def test_cells_that_were_never_run_are_counted(self):
        result = metrics.aggregate_scores({"a": [1.0], "b": [2.0]}, n_expected=26)
        assert result.coverage == "2 of 26"
        assert not result.complete
        with pytest.raises(ValueError, match="at most 1 cells, got 2"):
            metrics.aggregate_scores({"a": [1.0], "b": [2.0]}, n_expected=1)

    def test_everything_failed(self):
        result = metrics.aggregate_scores(np.full((3, 2), np.nan))
        assert np.isnan([result.mean, result.iqm, *result.mean_interval]).all()
        assert result.coverage == "0 of 6"
        assert result.resampled == "nothing"

    def test_infinity_is_not_averaged_away(self):
        result = metrics.aggregate_scores([[1.0, 2.0, 3.0, np.inf]])
        assert result.mean == np.inf
        assert result.iqm == 2.5
        assert result.complete


class TestMeanRanks:
    @given(
        arrays(float, array_shapes(min_dims=2, max_dims=2, max_side=6), elements=st.integers(0, 4))
    )
    @settings(max_examples=50, deadline=None)
    def test_scipy(self, scores):
        lower, higher = (metrics.mean_ranks(scores, better) for better in ("lower", "higher"))
        np.testing.assert_allclose(lower, scipy.stats.rankdata(scores, axis=0).mean(axis=1))
        np.testing.assert_allclose(higher, scipy.stats.rankdata(-scores, axis=0).mean(axis=1))
        np.testing.assert_allclose(lower + higher, len(scores) + 1)

    @pytest.mark.parametrize("better", ["lower", "higher"])
    def test_failed_cells_rank_last_and_tie(self, better):
        bad = np.inf if better == "lower" else -np.inf
        scores = np.array([[1.0, np.nan], [np.nan, np.nan], [bad, np.nan], [np.nan, 1.0]])
        # First environment: 1, then the infinite score, then a tie of ranks 3 and 4.
        expected = [(1 + 3) / 2, (3.5 + 3) / 2, (2 + 3) / 2, (3.5 + 1) / 2]
        np.testing.assert_allclose(metrics.mean_ranks(scores, better), expected)

    def test_errors(self):
        with pytest.raises(ValueError, match=r"\(methods, environments\), got \(3,\)"):
            metrics.mean_ranks(np.ones(3), "lower")
        with pytest.raises(ValueError, match='"lower" or "higher", got \'best\''):
            metrics.mean_ranks(np.ones((2, 2)), "best")
