"""Coupling layers for one state, for `realtime`: the twins of `CouplingField` without a batch.

A bound method of an array with an output given is NumPy's shortest call. In the plane a layer moves
one coordinate by one that stays, and all but the units is floats; in space the rotation is part of
the first product, as in the batch. Nothing is allocated but Python floats.
"""

from __future__ import annotations

from collections.abc import Callable
from math import exp, tanh
from typing import NamedTuple

import numpy as np

from iflow_gym.baselines.imitation_flow.fields.coupling import CouplingField
from iflow_gym.demonstrations import FloatArray

Vector = list[float]


def coupling_point(field: CouplingField) -> PlanePoint | SpacePoint:
    """Return h and its inverse for one state; not for several threads at once."""
    return PlanePoint(field) if field.n_dims == 2 else SpacePoint(field)


class PlanePoint:
    """Coupling layers in two dimensions, for a state of two floats."""

    def __init__(self, field: CouplingField) -> None:
        rotation, weight, bias, out_weight, out_bias = _weights(field)
        n_hidden = field.n_hidden
        self._bound = field.bound
        # Inputs and outputs of the products; a constant 1 carries the biases.
        self._seen, self._work = np.ones(2), np.ones(n_hidden + 1)
        self._units, self._slopes = self._work[:n_hidden], np.empty(n_hidden)
        self._out, self._d_out = np.empty(2), np.empty(2)
        first = _products(np.concatenate([weight, bias], axis=2))
        second = _products(np.concatenate([out_weight, out_bias], axis=2))
        self._layers = list(zip(rotation.tolist(), first, second, strict=True))
        turned_back = np.swapaxes(rotation, 1, 2).tolist()
        self._back = list(zip(turned_back, first, second, strict=True))[::-1]
        # One coordinate is seen, so its slope goes into the product of the tangent.
        third = _products(out_weight * np.swapaxes(weight, 1, 2))
        self._tangents = list(zip(self._layers, third, strict=True))

    def forward(self, z: Vector) -> Vector:
        """Return h(z)."""
        a, b = z
        seen, units, work, out, bound = self._seen, self._units, self._work, self._out, self._bound
        activate = np.tanh
        for ((r00, r01), (r10, r11)), first, second in self._layers:
            a, b = r00 * a + r01 * b, r10 * a + r11 * b
            seen[0] = a
            first(seen, units)
            activate(units, units)
            second(work, out)
            log_scale, shift = out.tolist()
            b = b * exp(bound * tanh(log_scale)) + shift
        return [a, b]

    def inverse(self, y: Vector) -> Vector:
        """Return h^-1(y)."""
        a, b = y
        seen, units, work, out, bound = self._seen, self._units, self._work, self._out, self._bound
        activate = np.tanh
        for ((r00, r01), (r10, r11)), first, second in self._back:
            seen[0] = a
            first(seen, units)
            activate(units, units)
            second(work, out)
            log_scale, shift = out.tolist()
            b = (b - shift) * exp(-bound * tanh(log_scale))
            a, b = r00 * a + r01 * b, r10 * a + r11 * b
        return [a, b]

    def push_forward(self, z: Vector, dz: Vector) -> tuple[Vector, Vector]:
        """Return h(z) and J_h(z) dz."""
        (a, b), (da, db) = z, dz
        seen, units, work, out, bound = self._seen, self._units, self._work, self._out, self._bound
        slopes, d_out, activate = self._slopes, self._d_out, np.tanh
        for (((r00, r01), (r10, r11)), first, second), third in self._tangents:
            a, b = r00 * a + r01 * b, r10 * a + r11 * b
            da, db = r00 * da + r01 * db, r10 * da + r11 * db
            seen[0] = a
            first(seen, units)
            activate(units, units)
            second(work, out)
            np.multiply(units, units, slopes)
            np.subtract(1.0, slopes, slopes)
            third(slopes, d_out)
            (log_scale, shift), (d_log_scale, d_shift) = out.tolist(), d_out.tolist()
            squashed = tanh(log_scale)
            scale = exp(bound * squashed)
            growth = bound * (1 - squashed * squashed) * d_log_scale
            db = scale * (db + b * growth * da) + d_shift * da
            b = b * scale + shift
        return [a, b], [da, db]


class _Step(NamedTuple):
    """A layer's products and the views that they work on, see `CouplingField`."""

    first: Callable[..., FloatArray]
    before: FloatArray  # [state; 1]
    after: FloatArray  # [u; 1; arguments of the units]
    units: FloatArray
    shown: FloatArray  # [1; units]
    second: Callable[..., FloatArray]


class SpacePoint:
    """Coupling layers in three dimensions or more, for a state of d floats."""

    def __init__(self, field: CouplingField) -> None:
        rotation, weight, bias, out_weight, out_bias = _weights(field)
        d, k, n_hidden = field.n_dims, field.n_kept, field.n_hidden
        self._bound, self._n_dims = field.bound, d
        n_moved = d - k
        self._places = [(k + j, j, n_moved + j) for j in range(n_moved)]
        self._states = np.ones((2, d + 1 + n_hidden))
        self._tangent, self._turned = np.empty(d), np.empty(d + n_hidden)
        self._slopes = np.empty(n_hidden)
        self._out, self._d_out = np.empty(2 * n_moved), np.empty(2 * n_moved)
        second = _products(np.concatenate([out_bias, out_weight], axis=2))
        seen = np.zeros((len(rotation), n_hidden, d))
        seen[:, :, :k] = weight
        turned_back = np.swapaxes(rotation, 1, 2)
        back = np.concatenate([turned_back[1:], np.eye(d)[None]])
        self._steps = self._chain(rotation, seen, bias, second)
        self._back = self._chain(back[::-1], seen[::-1], bias[::-1], second[::-1])
        self._last = np.ascontiguousarray(turned_back[0])
        third = _products(np.concatenate([rotation, seen @ rotation], axis=1))
        self._tangents = list(zip(self._steps, third, _products(out_weight), strict=True))

    def _chain(
        self,
        turns: FloatArray,
        seen: FloatArray,
        bias: FloatArray,
        second: list[Callable[..., FloatArray]],
    ) -> list[_Step]:
        n_layers, d = turns.shape[:2]
        first = np.zeros((n_layers, len(self._states[0]), d + 1))
        first[:, :d, :d], first[:, d, d] = turns, 1
        first[:, d + 1 :, :d], first[:, d + 1 :, d:] = seen @ turns, bias
        steps = []
        for i, product in enumerate(_products(first)):
            before, after = self._states[i % 2], self._states[(i + 1) % 2]
            views = (before[: d + 1], after, after[d + 1 :], after[d:])
            steps.append(_Step(product, *views, second[i]))
        return steps

    def forward(self, z: Vector) -> Vector:
        """Return h(z)."""
        out, bound, places, activate = self._out, self._bound, self._places, np.tanh
        self._states[0, : self._n_dims] = z
        for first, before, after, units, shown, second in self._steps:
            first(before, after)
            activate(units, units)
            second(shown, out)
            values = out.tolist()
            for i, s, t in places:
                after[i] = after.item(i) * exp(bound * tanh(values[s])) + values[t]
        result: Vector = after[: self._n_dims].tolist()
        return result

    def inverse(self, y: Vector) -> Vector:
        """Return h^-1(y)."""
        out, bound, places, activate = self._out, self._bound, self._places, np.tanh
        self._states[0, : self._n_dims] = y
        for first, before, after, units, shown, second in self._back:
            first(before, after)
            activate(units, units)
            second(shown, out)
            values = out.tolist()
            for i, s, t in places:
                after[i] = (after.item(i) - values[t]) * exp(-bound * tanh(values[s]))
        result: Vector = self._last.dot(after[: self._n_dims]).tolist()
        return result

    def push_forward(self, z: Vector, dz: Vector) -> tuple[Vector, Vector]:
        """Return h(z) and J_h(z) dz."""
        d, bound, slopes, turned, d_out = (
            self._n_dims, self._bound, self._slopes, self._turned, self._d_out,
        )  # fmt: skip
        d_units, tangent = turned[d:], self._tangent
        self._states[0, :d] = z
        tangent[:] = dz
        for (first, before, after, units, shown, second), third, fourth in self._tangents:
            first(before, after)
            np.tanh(units, units)
            second(shown, self._out)
            third(tangent, turned)
            np.multiply(units, units, slopes)
            np.subtract(1.0, slopes, slopes)
            np.multiply(slopes, d_units, slopes)
            fourth(slopes, d_out)
            values, d_values = self._out.tolist(), d_out.tolist()
            tangent[:] = turned[:d]
            for i, s, t in self._places:
                squashed, place = tanh(values[s]), after.item(i)
                scale = exp(bound * squashed)
                growth = bound * (1 - squashed * squashed) * d_values[s]
                tangent[i] = scale * (turned.item(i) + place * growth) + d_values[t]
                after[i] = place * scale + values[t]
        return after[:d].tolist(), tangent.tolist()


def _weights(field: CouplingField) -> tuple[FloatArray, ...]:
    """Return R, W, w (layers, h, 1), V and v (layers, 2 moved, 1), for outputs s^ / b and t."""
    rotation, weight, bias, out_weight, out_bias = field.arrays.values()
    scale = np.ones((out_weight.shape[1], 1))
    scale[: field.n_dims - field.n_kept] = field.bound
    return rotation, weight, bias[..., None], out_weight / scale, out_bias[..., None] / scale


def _products(matrices: FloatArray) -> list[Callable[..., FloatArray]]:
    """Return the bound `dot` of each matrix (rows, columns) of a stack."""
    return [np.ascontiguousarray(matrix).dot for matrix in matrices]
