"""Accuracy against closed forms, independent computations and similaritymeasures."""

import numpy as np
import pytest
import similaritymeasures
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from iflow_gym import metrics

PAIRWISE = [metrics.rmse, metrics.frechet, metrics.dtw, metrics.swept_area]
VELOCITY = [metrics.seds_error, metrics.direction_error, metrics.velocity_rmse]
PLANAR = [*PAIRWISE, *VELOCITY]


def curve(n_samples, seed, d=2):
    """Return a smooth curve with random harmonics, some tens of units across."""
    rng = np.random.default_rng(seed)
    s = np.linspace(0, 1, n_samples)[:, None]
    harmonics = np.arange(1, 6)
    waves = np.sin(2 * np.pi * s * harmonics + rng.uniform(0, 2 * np.pi, 5))
    return 40 * s + waves @ rng.normal(0, 10 / harmonics[:, None], (5, d))


def positions(max_samples=12, d=2):
    coordinate = st.floats(-100, 100, allow_subnormal=False).map(lambda v: round(v, 3))
    return st.integers(2, max_samples).flatmap(lambda n: arrays(float, (n, d), elements=coordinate))


def pairs_of_equal_length(max_samples=12):
    coordinate = st.floats(-100, 100, allow_subnormal=False).map(lambda v: round(v, 3))
    return st.integers(2, max_samples).flatmap(
        lambda n: arrays(float, (2, n, 2), elements=coordinate)
    )


def naive(x, y, combine):
    """Run the recursion cell by cell, as it is written in the papers."""
    cost = np.full((len(x), len(y)), np.inf)
    for i in range(len(x)):
        for j in range(len(y)):
            before = [
                cost[a, b] for a, b in ((i - 1, j), (i, j - 1), (i - 1, j - 1)) if a >= 0 and b >= 0
            ]
            cost[i, j] = combine(np.linalg.norm(x[i] - y[j]), min(before, default=0.0))
    return cost[-1, -1]


class TestClosedForms:
    def test_translated_trajectory(self):
        x, shift = curve(200, 0), np.array([3.0, -4.0])
        assert metrics.rmse(x, x + shift) == pytest.approx(5.0)
        # Translation: the end points alone force 5, and the identity coupling reaches it.
        assert metrics.frechet(x, x + shift) == pytest.approx(5.0)
        assert metrics.dtw(x, x + shift) <= 5.0

    def test_parallel_lines(self):
        s = np.linspace(0, 7, 50)
        x, y = np.c_[s, 0 * s], np.c_[s, 0 * s + 2.0]
        for distance in (metrics.rmse, metrics.frechet, metrics.dtw):
            assert distance(x, y) == pytest.approx(2.0)
        assert metrics.swept_area(x, y) == pytest.approx(2.0 * 7.0)
        assert metrics.swept_surface(np.c_[x, s], np.c_[y, s]) == pytest.approx(
            2.0 * 7.0 * np.sqrt(2)
        )

    def test_concentric_circles(self):
        angle = np.linspace(0, 2 * np.pi, 721)
        unit = np.c_[np.cos(angle), np.sin(angle)]
        assert metrics.rmse(3 * unit, 5 * unit) == pytest.approx(2.0)
        assert metrics.frechet(3 * unit, 5 * unit) == pytest.approx(2.0)
        ring_of_trapezia = 0.5 * 720 * np.sin(2 * np.pi / 720) * (5**2 - 3**2)
        assert metrics.swept_area(3 * unit, 5 * unit) == pytest.approx(ring_of_trapezia)
        assert metrics.swept_area(3 * unit, 5 * unit) == pytest.approx(np.pi * 16, rel=1e-4)

    def test_rmse_is_a_distance_and_not_one_per_coordinate(self):
        assert metrics.rmse(np.zeros((2, 3)), [[1, 2, 2], [0, 0, 0]]) == pytest.approx(
            np.sqrt(9 / 2)
        )

    def test_frechet_and_dtw_of_a_backtrack(self):
        # The demonstration waits at 1/2 while the reproduction goes to 1 and back to 0.
        x = np.array([[0, 0], [0.5, 0], [2, 0]])
        y = np.array([[0, 0], [1, 0], [0, 0], [2, 0]])
        assert metrics.frechet(x, y) == 0.5
        assert metrics.dtw(x, y) == pytest.approx((0 + 0.5 + 0.5 + 0) / 3)

    def test_dtw_is_divided_by_the_demonstrations_samples(self):
        x, y = np.zeros((3, 2)), np.tile([3.0, 4.0], (6, 1))
        # Six links of length 5 at least, whichever way round.
        assert metrics.dtw(x, y) == pytest.approx(6 * 5 / 3)
        assert metrics.dtw(y, x) == pytest.approx(6 * 5 / 6)

    def test_one_sample_against_many(self):
        x, y = np.zeros((1, 2)), np.array([[1.0, 0], [0, 2], [3, 0]])
        assert metrics.frechet(x, y) == metrics.frechet(y, x) == 3.0
        assert metrics.dtw(x, y) == pytest.approx(6.0)
        assert metrics.dtw(y, x) == pytest.approx(2.0)


class TestOracles:
    @pytest.mark.parametrize(("n", "m", "d"), [(80, 80, 2), (60, 91, 2), (97, 40, 3), (50, 50, 1)])
    def test_similaritymeasures(self, n, m, d):
        x, y = curve(n, 1, d), curve(m, 2, d)
        assert metrics.frechet(x, y) == pytest.approx(similaritymeasures.frechet_dist(x, y))
        assert metrics.dtw(x, y) * n == pytest.approx(similaritymeasures.dtw(x, y)[0])

    @given(positions(), positions())
    @settings(max_examples=100, deadline=None)
    def test_cell_by_cell_recursion_at_unequal_lengths(self, x, y):
        assert metrics.frechet(x, y) == pytest.approx(naive(x, y, max), abs=1e-12)
        total = naive(x, y, lambda distance, before: distance + before)
        assert metrics.dtw(x, y) * len(x) == pytest.approx(total, abs=1e-9)

    @pytest.mark.parametrize(("n", "m"), [(1000, 1000), (700, 300), (63, 500), (65, 2), (2, 200)])
    def test_blocks_of_diagonals_join(self, n, m):
        # One row at a time, so that sequences much longer than a block of diagonals are covered.
        x, y = curve(n, 3), curve(m, 4)
        distance = np.linalg.norm(x[:, None] - y[None], axis=-1)
        row = np.cumsum(distance[0])
        for line in distance[1:]:
            reach = np.minimum(row, np.r_[np.inf, row[:-1]])
            # c_j = line_j + min(reach_j, c_{j-1}), unrolled over j by cumulative sums
            summed = np.cumsum(line)
            row = summed + np.minimum.accumulate(reach - np.r_[0.0, summed[:-1]])
        assert metrics.dtw(x, y) * n == pytest.approx(row[-1])
        # Fréchet: the value is a distance, reachable at it, and not just below it.
        value = metrics.frechet(x, y)
        nearest = np.abs(distance - value).min()
        assert nearest < 1e-9
        assert self.reachable(distance <= value + 1e-9)
        assert not self.reachable(distance <= value - 1e-9)

    @staticmethod
    def reachable(free):
        """Whether the last cell can be reached through free cells by the three steps."""
        row = np.logical_and.accumulate(free[0])
        for line in free[1:]:
            enter = line & (row | np.r_[False, row[:-1]])
            row = enter.copy()
            for j in np.flatnonzero(enter):
                k = j + 1
                while k < len(line) and line[k] and not row[k]:
                    row[k] = True
                    k += 1
        return bool(row[-1])


class TestInvariants:
    @pytest.mark.parametrize("metric", PLANAR)
    @given(pair=pairs_of_equal_length())
    @settings(max_examples=25, deadline=None)
    def test_zero_on_itself_and_never_negative(self, metric, pair):
        x, y = pair
        assume(np.any(x != 0))
        assert metric(x, x) == 0.0
        assert metric(x, y) >= 0.0

    @pytest.mark.parametrize("metric", [*PAIRWISE, metrics.direction_error, metrics.velocity_rmse])
    @given(pair=pairs_of_equal_length())
    @settings(max_examples=25, deadline=None)
    def test_symmetric_at_equal_lengths(self, metric, pair):
        x, y = pair
        assume(metric is not metrics.direction_error or (x.any(axis=1) & y.any(axis=1)).all())
        assert metric(x, y) == pytest.approx(metric(y, x), rel=1e-9, abs=1e-9)

    @pytest.mark.parametrize("metric", PAIRWISE)
    @given(pair=pairs_of_equal_length(), shift=arrays(float, 2, elements=st.floats(-50, 50)))
    @settings(max_examples=25, deadline=None)
    def test_moves_with_both(self, metric, pair, shift):
        x, y = pair
        assert metric(x + shift, y + shift) == pytest.approx(metric(x, y), rel=1e-8, abs=1e-6)

    @pytest.mark.parametrize("metric", PAIRWISE)
    @given(pair=pairs_of_equal_length())
    @settings(max_examples=25, deadline=None)
    def test_same_backwards_and_turned(self, metric, pair):
        x, y = pair
        c, s = np.cos(0.7), np.sin(0.7)
        turn = np.array([[c, -s], [s, c]])
        assert metric(x[::-1], y[::-1]) == pytest.approx(metric(x, y), rel=1e-9, abs=1e-9)
        assert metric(x @ turn, y @ turn) == pytest.approx(metric(x, y), rel=1e-8, abs=1e-6)

    @given(pairs_of_equal_length())
    @settings(max_examples=50, deadline=None)
    def test_bounds(self, pair):
        x, y = pair
        frechet, dtw = metrics.frechet(x, y), metrics.dtw(x, y)
        distance = np.linalg.norm(x - y, axis=1)
        ends = max(distance[0], distance[-1])
        assert ends <= frechet + 1e-9
        assert frechet <= distance.max() + 1e-9  # the identity coupling
        assert dtw * len(x) <= distance.sum() + 1e-9
        assert dtw <= metrics.rmse(x, y) + 1e-9
        nearest = np.linalg.norm(x[:, None] - y[None], axis=-1).min(axis=1)
        assert nearest.max() <= frechet + 1e-9
        assert nearest.sum() <= dtw * len(x) + 1e-9  # every sample is linked at least once

    @pytest.mark.parametrize("metric", PLANAR)
    @pytest.mark.parametrize("n_pairs", [1, 5])
    def test_batch_equals_one_at_a_time(self, metric, n_pairs):
        x = np.stack([curve(150, seed) for seed in range(n_pairs)])
        y = np.stack([curve(150, 100 + seed) for seed in range(n_pairs)])
        batched = metric(x, y)
        assert batched.shape == (n_pairs,)
        singles = [metric(a, b) for a, b in zip(x, y, strict=True)]
        assert all(type(value) is float for value in singles)
        np.testing.assert_allclose(batched, singles, rtol=1e-12)

    @pytest.mark.parametrize("metric", [metrics.frechet, metrics.dtw])
    def test_batch_of_unequal_lengths(self, metric):
        x = np.stack([curve(150, seed) for seed in range(3)])
        y = np.stack([curve(70, 100 + seed) for seed in range(3)])
        singles = [metric(a, b) for a, b in zip(x, y, strict=True)]
        np.testing.assert_allclose(metric(x, y), singles, rtol=1e-12)

    @pytest.mark.parametrize("metric", PLANAR)
    def test_arguments_are_left_alone(self, metric):
        x, y = curve(30, 0), curve(30, 1)
        y[3] = np.nan
        before = x.copy(), y.copy()
        metric(x, y)
        np.testing.assert_array_equal((x, y), before)


def scanline_area(vertices, n_lines=4001):
    """Area where the polygon winds an odd number of times, by integration over horizontal lines.

    Knows nothing of crossings or of triangles; a tetragon winds at most once around any point.
    """
    low, high = vertices[:, 1].min(), vertices[:, 1].max()
    levels = low + (np.arange(n_lines) + 0.5) * (high - low) / n_lines
    total = 0.0
    for level in levels:
        cuts = []
        for (x0, y0), (x1, y1) in zip(vertices, np.roll(vertices, -1, axis=0), strict=True):
            if (y0 <= level) != (y1 <= level):
                cuts.append(x0 + (level - y0) * (x1 - x0) / (y1 - y0))
        cuts.sort()
        total += sum(cuts[1::2]) - sum(cuts[::2])
    return total * (high - low) / n_lines


def swept(a, b, c, d):
    """Swept area of the single tetragon abcd: (x^_t, x^_{t+1}, x_{t+1}, x_t)."""
    return metrics.swept_area(np.array([d, c]), np.array([a, b]))


class TestSweptArea:
    def test_steps_cross(self):
        # An X of unit arms: the triangles left and right, of area 1/4 each; the shoelace says 0.
        assert swept((0, 0), (1, 1), (1, 0), (0, 1)) == pytest.approx(0.5)

    def test_links_cross(self):
        # The reproduction steps right, the demonstration steps left above it.
        assert swept((0, 0), (1, 0), (0, 1), (1, 1)) == pytest.approx(0.5)

    def test_uneven_crossing(self):
        # ab on the x axis from 0 to 4, cd crosses it at x = 1: triangles of 1·2/2 and 3·1/2.
        assert swept((0, 0), (4, 0), (1, 1), (1, -2)) == pytest.approx(1.0 + 1.5)

    def test_concave(self):
        # An arrowhead: the triangle (0,0) (4,0) (2,4) without (0,0) (4,0) (2,1).
        arrow = [(0.0, 0.0), (2.0, 1.0), (4.0, 0.0), (2.0, 4.0)]
        for turn in range(4):
            assert swept(*np.roll(arrow, turn, axis=0)) == pytest.approx(8.0 - 2.0)

    @pytest.mark.parametrize(
        ("tetragon", "area"),
        [
            ([(0, 0), (1, 0), (2, 0), (3, 0)], 0.0),  # on a line, in order
            ([(0, 0), (2, 0), (1, 0), (3, 0)], 0.0),  # on a line, folded
            ([(1, 1), (1, 1), (1, 1), (1, 1)], 0.0),  # a point
            ([(0, 0), (0, 0), (1, 0), (0, 1)], 0.5),  # the reproduction stands still
            ([(0, 0), (2, 0), (0, 2), (0, 0)], 2.0),  # the first samples coincide
            ([(0, 0), (1, 1), (0, 0), (1, 1)], 0.0),  # exchanged ends
            ([(0, 0), (1, 0), (1, 0), (0, 0)], 0.0),  # the same step twice
            ([(0, 0), (2, 0), (1, 0), (0, 1)], 0.5),  # c lies on ab: a spike has no area
            ([(0, 0), (4, 0), (2, 0), (2, 2)], 2.0),  # c touches ab from above: a triangle
            ([(0, 0), (2, 2), (4, 0), (2, 0)], 4.0),  # d lies on the line from c to a
        ],
    )
    def test_degenerate(self, tetragon, area):
        for turn in range(4):
            assert swept(*np.roll(tetragon, turn, axis=0)) == pytest.approx(area, abs=1e-12)

    @pytest.mark.parametrize("seed", range(60))
    def test_integration_over_scanlines(self, seed):
        vertices = np.random.default_rng(seed).uniform(-1, 1, (4, 2))
        assert swept(*vertices) == pytest.approx(scanline_area(vertices), abs=2e-3)

    def test_seeds_above_hold_every_kind_of_tetragon(self):
        kinds = set()
        for seed in range(60):
            a, b, c, d = np.random.default_rng(seed).uniform(-1, 1, (4, 2))
            areas = [
                np.linalg.det(np.array([q - p, r - p]))
                for p, q, r in ((a, b, c), (b, c, d), (c, d, a), (d, a, b))
            ]
            signs = np.sign(areas)
            kinds.add(int(signs[0] * signs[1]) if abs(signs.sum()) == 0 else int(abs(signs.sum())))
        assert kinds == {4, 2, 1, -1}  # convex, concave, and crossing in either pair of sides

    def test_crossing_curves_count_both_lobes(self):
        s = np.linspace(0, 2 * np.pi, 2001)
        x, y = np.c_[s, 0 * s], np.c_[s, np.sin(s)]
        assert metrics.swept_area(x, y) == pytest.approx(4.0, rel=1e-5)

    def test_continuous_through_a_touch(self):
        # c moves through ab: on one side the tetragon is simple, on the other it crosses.
        areas = [swept((0, 0), (4, 0), (2, height), (2, 2)) for height in (1e-9, 0.0, -1e-9)]
        np.testing.assert_allclose(areas, areas[1], rtol=0, atol=1e-8)


class TestSweptSurface:
    @given(pairs_of_equal_length(max_samples=2))
    @settings(max_examples=100, deadline=None)
    def test_in_a_plane_it_is_the_swept_area_unless_sides_cross(self, pair):
        x, y = pair
        area = metrics.swept_area(x, y)
        surface = metrics.swept_surface(np.c_[x, [0, 0]], np.c_[y, [0, 0]])
        (d, c), (a, b) = x, y
        corners = np.array([a, b, c, d])
        following = np.roll(corners, -1, axis=0)
        shoelace = 0.5 * abs((corners[:, 0] * following[:, 1]).sum()
                             - (corners[:, 1] * following[:, 0]).sum())  # fmt: skip
        assert surface >= area - 1e-9
        if area == pytest.approx(shoelace, abs=1e-9) and shoelace > 1e-6:
            assert surface == pytest.approx(area, rel=1e-6, abs=1e-6)

    def test_twisted_tetragon(self):
        # Two opposite edges of the unit cube's tetrahedron: both diagonals give sqrt(3)/2 twice.
        x = np.array([[1.0, 0, 1], [0, 1, 1]])
        y = np.array([[0.0, 0, 0], [1, 1, 0]])
        assert metrics.swept_surface(x, y) == pytest.approx(2 * np.sqrt(3) / 4 * 2)

    def test_symmetric(self):
        x, y = curve(60, 0, 3), curve(60, 1, 3)
        assert metrics.swept_surface(x, y) == pytest.approx(metrics.swept_surface(y, x))
        np.testing.assert_allclose(
            metrics.swept_surface(np.stack([x, y]), np.stack([y, y])),
            [metrics.swept_surface(x, y), 0.0],
        )


class TestVelocities:
    def test_by_the_formula(self):
        v = np.array([[2.0, 0.0], [0.0, 1.0]])
        v_hat = np.array([[1.0, 1.0], [0.0, -3.0]])
        eps = 1e-4 * (4 + 1) / 2
        cosine = np.array([np.sqrt(0.5), -1.0])
        relative = np.array([2 / (4 + eps), 16 / (1 + eps)])
        expected = np.sqrt(0.6 * (1 - cosine) ** 2 + 0.4 * relative).mean()
        assert metrics.seds_error(v, v_hat) == pytest.approx(expected)
        assert metrics.direction_error(v, v_hat) == pytest.approx((1 - cosine).mean())
        assert metrics.velocity_rmse(v, v_hat) == pytest.approx(np.sqrt((2 + 16) / 2))

    def test_second_denominator_has_no_hat(self):
        v, v_hat = np.array([[1.0, 0.0]] * 4), np.array([[3.0, 0.0]] * 4)
        assert metrics.seds_error(v, v_hat) == pytest.approx(np.sqrt(0.4 * 4 / (1 + 1e-4)))
        assert metrics.seds_error(v_hat, v) == pytest.approx(np.sqrt(0.4 * 4 / 9 / (1 + 1e-4)))

    @pytest.mark.parametrize("angle", [1e-9, 1e-4, 0.5, np.pi / 2, np.pi])
    def test_direction_error_of_an_angle(self, angle):
        # 2 sin²(angle/2) keeps its digits where 1 - cos does not.
        v = curve(20, 0)
        c, s = np.cos(angle), np.sin(angle)
        turned = 7.0 * v @ np.array([[c, s], [-s, c]])
        error = metrics.direction_error(v, turned)
        assert error == pytest.approx(2 * np.sin(angle / 2) ** 2, rel=1e-5)

    def test_demonstration_at_rest_has_no_direction_to_miss(self):
        v = np.array([[1.0, 0.0], [0.0, 0.0]])
        v_hat = np.array([[0.0, 1.0], [0.5, 0.0]])
        assert metrics.direction_error(v, v_hat) == pytest.approx((1 + 0) / 2)
        eps = 1e-4 * 0.5
        expected = (np.sqrt(0.6 + 0.4 * 2 / (1 + eps)) + np.sqrt(0.4 * 0.25 / eps)) / 2
        assert metrics.seds_error(v, v_hat) == pytest.approx(expected)

    def test_prediction_at_rest_is_as_wrong_as_a_right_angle(self):
        v, v_hat = np.array([[1.0, 0.0]]), np.zeros((1, 2))
        assert metrics.direction_error(v, v_hat) == 1.0
        expected = np.sqrt(0.6 + 0.4 / (1 + 1e-4))
        assert metrics.seds_error(v, v_hat) == pytest.approx(expected)

    def test_both_at_rest_agree(self):
        v = np.array([[1.0, 0.0], [0.0, 0.0]])
        for metric in VELOCITY:
            assert metric(v, v) == 0.0

    @pytest.mark.parametrize("metric", [metrics.seds_error, metrics.direction_error])
    @pytest.mark.parametrize("scale", [1e-3, 1e3])
    def test_no_unit(self, metric, scale):
        v, v_hat = curve(50, 0), curve(50, 1)
        v[-1] = 0.0
        assert metric(scale * v, scale * v_hat) == pytest.approx(metric(v, v_hat))

    def test_direction_of_tiny_and_huge_velocities(self):
        for scale in (1e-200, 1e200):
            v = scale * np.array([[1.0, 0.0]])
            assert metrics.direction_error(v, scale * np.array([[1.0, 1.0]])) == pytest.approx(
                1 - np.sqrt(0.5)
            )

    def test_nll(self):
        # Standard normal in 3-D at its mean: log(2 pi)/2 a dimension.
        log_density = np.full(10, -1.5 * np.log(2 * np.pi))
        assert metrics.nll(log_density, 3) == pytest.approx(0.5 * np.log(2 * np.pi))
        assert metrics.nll([-1.0, -np.inf], 2) == np.inf
        assert metrics.nll([-1.0, np.nan], 2) == np.inf


class TestRunaways:
    @pytest.mark.parametrize("metric", [*PLANAR, metrics.swept_surface])
    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e200, 1.7e308])
    def test_score_is_infinite_and_only_that_of_the_pair(self, metric, value):
        d = 3 if metric is metrics.swept_surface else 2
        x = np.stack([curve(40, seed, d) for seed in range(3)])
        y = np.stack([curve(40, 10 + seed, d) for seed in range(3)])
        expected = metric(x, y)
        y[1, 20:] = value * np.array([1, -1, 1])[:d]
        if metric is metrics.direction_error and np.isfinite(value):
            assert np.isfinite(metric(x, y)).all()  # a direction has no length to overflow
            return
        scores = metric(x, y)
        assert scores[1] == np.inf
        np.testing.assert_array_equal(scores[[0, 2]], expected[[0, 2]])
        assert metric(x[1], y[1]) == np.inf


class TestErrors:
    def test_dimension_suggests_the_other_function(self):
        text = r"Expected positions of shape \(T, 2\) or \(B, T, 2\), got \(1000, 3\): "
        with pytest.raises(ValueError, match=text + "use swept_surface for 3-D"):
            metrics.swept_area(np.zeros((1000, 3)), np.zeros((1000, 3)))
        with pytest.raises(ValueError, match="use swept_area for 2-D"):
            metrics.swept_surface(np.zeros((10, 2)), np.zeros((10, 2)))

    @pytest.mark.parametrize("metric", PLANAR)
    def test_number_of_axes(self, metric):
        with pytest.raises(ValueError, match=r"Expected \w+ of shape .*, got \(5,\)$"):
            metric(np.zeros(5), np.zeros(5))
        with pytest.raises(ValueError, match=r"got \(0, 2\)$"):
            metric(np.zeros((0, 2)), np.zeros((0, 2)))

    @pytest.mark.parametrize("metric", PLANAR)
    def test_batches_must_match(self, metric):
        with pytest.raises(ValueError, match="the same batch and dimension"):
            metric(np.ones((2, 5, 2)), np.ones((3, 5, 2)))
        with pytest.raises(ValueError, match="the same batch and dimension"):
            metric(np.ones((2, 5, 2)), np.ones((5, 2)))

    @pytest.mark.parametrize("metric", [metrics.rmse, metrics.swept_area, *VELOCITY])
    def test_lengths_must_match(self, metric):
        with pytest.raises(ValueError, match=r"roll out for 5 samples, or use frechet or dtw"):
            metric(np.ones((5, 2)), np.ones((6, 2)))

    @pytest.mark.parametrize("metric", PLANAR)
    def test_demonstration_must_be_finite(self, metric):
        x = np.ones((5, 2))
        x[2, 0] = np.nan
        with pytest.raises(ValueError, match=r"\(demonstration, reproduction\), in this order"):
            metric(x, np.ones((5, 2)))

    def test_an_area_takes_two_samples(self):
        with pytest.raises(ValueError, match="at least 2 samples, got 1 and 1"):
            metrics.swept_area(np.ones((1, 2)), np.ones((1, 2)))

    def test_a_demonstration_that_rests_has_no_seds_error(self):
        with pytest.raises(ValueError, match="a demonstration that moves"):
            metrics.seds_error(np.zeros((5, 2)), np.ones((5, 2)))

    def test_nll(self):
        with pytest.raises(ValueError, match=r"of shape \(n,\), got \(2, 3\)"):
            metrics.nll(np.zeros((2, 3)), 2)
        with pytest.raises(ValueError, match="at least 1, got 0"):
            metrics.nll(np.zeros(3), 0)
