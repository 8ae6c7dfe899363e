"""Spline couplings for one state, for `realtime`: the twins of `SplineField` without a batch.

A layer's conditioner gives the sizes of all bins in a few NumPy calls, and the sums of widths and
of heights in one; a bin is found by bisection, and the rational-quadratic in it is floats. Sizes
are kept as they are before they fill [-B, B], as in training: a point meets its own bin's numbers
and the two sums alone.
"""

from __future__ import annotations

from bisect import bisect_right
from math import sqrt

import numpy as np

from iflow_gym.baselines.imitation_flow.fields.points import Vector, chain, products, turned_back
from iflow_gym.baselines.imitation_flow.fields.spline import SplineField
from iflow_gym.demonstrations import FloatArray


class SplinePoint:
    """Spline couplings for a state of d floats."""

    def __init__(self, field: SplineField) -> None:
        rotation, weight, bias, *_ = field.arrays.values()
        d, k, n_bins, n_hidden = field.n_dims, field.n_kept, field.n_bins, weight.shape[1]
        self._bound, self._n_dims, self._n_bins = field.bound, d, n_bins
        self._n_moved = n_moved = d - k
        self._states = np.empty((2, d + 1 + n_hidden))
        self._start = self._states[0, : d + 1]
        self._tangent, self._turned = np.empty(d), np.empty(d + n_hidden)
        self._slopes = np.empty(n_hidden)
        bounds, out_weight, out_bias = rows_of(field)
        self._row_bounds = bounds
        # Widths, heights and knots' slopes; sums of the first two; and the same for a tangent.
        n_sizes = n_moved * n_bins
        self._out, self._d_out = np.empty(len(bounds)), np.empty(len(bounds))
        self._widths, self._heights = self._out[:n_sizes], self._out[n_sizes : 2 * n_sizes]
        self._sizes = self._out[: 2 * n_sizes].reshape(2 * n_moved, n_bins)
        self._sums = np.empty((2 * n_moved, n_bins))
        self._d_widths = self._d_out[:n_sizes]
        self._d_heights = self._d_out[n_sizes : 2 * n_sizes]
        self._d_sizes = self._d_out[: 2 * n_sizes].reshape(2 * n_moved, n_bins)
        self._d_sums = np.empty((2 * n_moved, n_bins))
        # A coordinate, where its bins' widths, heights and its first knot are, and its sums.
        self._places = [
            (k + j, j * n_bins, n_sizes + j * n_bins, 2 * n_sizes + j * (n_bins + 1), j)
            for j in range(n_moved)
        ]
        seen = np.zeros((len(rotation), n_hidden, d))
        seen[:, :, :k] = weight
        second = products(np.concatenate([out_bias, out_weight], axis=2))
        turns, self._last = turned_back(rotation)
        steps = chain(self._states, rotation, seen, bias[..., None])
        back = chain(self._states, turns, seen[::-1], bias[::-1, :, None])
        self._steps = list(zip(steps, second, strict=True))
        self._back = list(zip(back, second[::-1], strict=True))
        third = products(np.concatenate([rotation, seen @ rotation], axis=1))
        self._tangents = list(zip(self._steps, third, products(out_weight), strict=True))

    def forward(self, z: Vector) -> Vector:
        """Return h(z)."""
        out, sums, bound, last = self._out, self._sums, self._bound, self._n_bins - 1
        n_moved, length = self._n_moved, 2 * self._bound
        self._start[:] = (*z, 1.0)
        for (first, before, after, units, shown), second in self._steps:
            first(before, after)
            np.tanh(units, units)
            second(shown, out)
            self._fill()
            numbers, totals = out.tolist(), sums.tolist()
            for place, at_width, at_height, at_knot, j in self._places:
                value = after.item(place)
                if not -bound < value < bound:
                    continue
                to_widths, to_heights = totals[j], totals[n_moved + j]
                all_widths, all_heights = to_widths[last], to_heights[last]
                scaled = (value + bound) * all_widths / length
                i = bisect_right(to_widths, scaled, 0, last)
                width, height = numbers[at_width + i], numbers[at_height + i]
                left, right = numbers[at_knot + i], numbers[at_knot + i + 1]
                mean = height * all_widths / (width * all_heights)
                xi = (scaled - to_widths[i] + width) / width
                rest = 1 - xi
                mixed = mean + (left + right - 2 * mean) * xi * rest
                image = xi * (mean * xi + left * rest) / mixed
                reached = to_heights[i] - height + height * image
                after[place] = reached * length / all_heights - bound
        result: Vector = after[: self._n_dims].tolist()
        return result

    def inverse(self, y: Vector) -> Vector:
        """Return h^-1(y)."""
        out, sums, bound, last = self._out, self._sums, self._bound, self._n_bins - 1
        n_moved, length = self._n_moved, 2 * self._bound
        self._start[:] = (*y, 1.0)
        for (first, before, after, units, shown), second in self._back:
            first(before, after)
            np.tanh(units, units)
            second(shown, out)
            self._fill()
            numbers, totals = out.tolist(), sums.tolist()
            for place, at_width, at_height, at_knot, j in self._places:
                value = after.item(place)
                if not -bound < value < bound:
                    continue
                to_widths, to_heights = totals[j], totals[n_moved + j]
                all_widths, all_heights = to_widths[last], to_heights[last]
                scaled = (value + bound) * all_heights / length
                i = bisect_right(to_heights, scaled, 0, last)
                width, height = numbers[at_width + i], numbers[at_height + i]
                left, right = numbers[at_knot + i], numbers[at_knot + i + 1]
                mean = height * all_widths / (width * all_heights)
                image = (scaled - to_heights[i] + height) / height
                # Eqs. 6 to 8, divided by the bin's height; the root that does not cancel.
                b = left - image * (left + right - 2 * mean)
                c = image * mean
                xi = 2 * c / (b + sqrt(b * b + 4 * (mean - b) * c))
                reached = to_widths[i] - width + width * xi
                after[place] = reached * length / all_widths - bound
        result: Vector = self._last.dot(after[: self._n_dims]).tolist()
        return result

    def push_forward(self, z: Vector, dz: Vector) -> tuple[Vector, Vector]:
        """Return h(z) and J_h(z) dz."""
        d, bound, last = self._n_dims, self._bound, self._n_bins - 1
        n_moved, length = self._n_moved, 2 * self._bound
        slopes, turned, tangent = self._slopes, self._turned, self._tangent
        d_units = turned[d:]
        self._start[:] = (*z, 1.0)
        tangent[:] = dz
        for ((first, before, after, units, shown), second), third, fourth in self._tangents:
            first(before, after)
            np.tanh(units, units)
            second(shown, self._out)
            third(tangent, turned)
            np.multiply(units, units, slopes)
            np.subtract(1.0, slopes, slopes)
            np.multiply(slopes, d_units, slopes)
            fourth(slopes, self._d_out)
            self._fill_tangent()
            numbers, totals = self._out.tolist(), self._sums.tolist()
            d_numbers, d_totals = self._d_out.tolist(), self._d_sums.tolist()
            tangent[:] = turned[:d]
            for place, at_width, at_height, at_knot, j in self._places:
                value = after.item(place)
                if not -bound < value < bound:
                    continue
                to_widths, to_heights = totals[j], totals[n_moved + j]
                d_to_widths, d_to_heights = d_totals[j], d_totals[n_moved + j]
                all_widths, all_heights = to_widths[last], to_heights[last]
                d_all_widths, d_all_heights = d_to_widths[last], d_to_heights[last]
                inside = (value + bound) / length
                scaled = inside * all_widths
                i = bisect_right(to_widths, scaled, 0, last)
                width, height = numbers[at_width + i], numbers[at_height + i]
                d_width, d_height = d_numbers[at_width + i], d_numbers[at_height + i]
                left, right = numbers[at_knot + i], numbers[at_knot + i + 1]
                d_left, d_right = d_numbers[at_knot + i], d_numbers[at_knot + i + 1]
                mean = height * all_widths / (width * all_heights)
                d_mean = mean * (
                    d_height / height
                    - d_all_heights / all_heights
                    - d_width / width
                    + d_all_widths / all_widths
                )
                xi = (scaled - to_widths[i] + width) / width
                d_scaled = turned.item(place) * all_widths / length + inside * d_all_widths
                d_xi = (d_scaled - d_to_widths[i] + d_width - xi * d_width) / width
                rest = 1 - xi
                product, d_product = xi * rest, (rest - xi) * d_xi
                bend, d_bend = left + right - 2 * mean, d_left + d_right - 2 * d_mean
                mixed = mean + bend * product
                top = mean * xi * xi + left * product
                d_top = d_mean * xi * xi + 2 * mean * xi * d_xi
                d_top += d_left * product + left * d_product
                image = top / mixed
                d_image = (d_top - image * (d_mean + d_bend * product + bend * d_product)) / mixed
                reached = (to_heights[i] - height + height * image) / all_heights
                d_reached = d_to_heights[i] - d_height + d_height * image + height * d_image
                d_reached = (d_reached - reached * d_all_heights) / all_heights
                after[place] = reached * length - bound
                tangent[place] = d_reached * length
        return after[:d].tolist(), tangent.tolist()

    def _fill(self) -> None:
        """Make the conditioner's output the bins, and sum their sizes up."""
        out = self._out
        np.tanh(out, out)
        np.multiply(out, self._row_bounds, out)
        np.exp(out, out)
        np.multiply(self._widths, self._heights, self._heights)
        np.add.accumulate(self._sizes, 1, None, self._sums)

    def _fill_tangent(self) -> None:
        """Do the same for the output and its derivative."""
        out, d_out = self._out, self._d_out
        d_out *= self._row_bounds / np.cosh(out) ** 2
        self._fill()
        self._d_heights += self._d_widths
        d_out *= out
        np.add.accumulate(self._d_sizes, 1, None, self._d_sums)


def rows_of(field: SplineField) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the rows' bounds b and the output's V and v, divided by them.

    The rows are all widths, all heights, and the knots of each coordinate; those of the first and
    the last knot, whose slope is 1, are zeros.
    """
    _, _, _, weight, bias = field.arrays.values()
    n_layers, n_moved, _, n_hidden = weight.shape
    bounds = np.broadcast_to(field.row_bounds, bias.shape[1:])
    every = np.concatenate([weight, bias[..., None]], axis=3) / field.row_bounds[:, None]
    k, edge = field.n_bins, np.zeros((n_layers, n_moved, 1, n_hidden + 1))
    knots = np.concatenate([edge, every[:, :, 2 * k :], edge], axis=2)
    parts = [every[:, :, :k], every[:, :, k : 2 * k], knots]
    rows = np.concatenate([part.reshape(n_layers, -1, n_hidden + 1) for part in parts], axis=1)
    knot_bounds = np.pad(bounds[:, 2 * k :], ((0, 0), (1, 1)), constant_values=1.0)
    sizes = [bounds[:, :k], bounds[:, k : 2 * k], knot_bounds]
    return np.concatenate([b.ravel() for b in sizes]), rows[..., :-1], rows[..., -1:]
