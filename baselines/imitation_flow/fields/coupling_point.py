"""Coupling layers for one state, for `realtime`: the twins of `CouplingField` without a batch."""

from __future__ import annotations

from math import exp, tanh

import numpy as np

from iflow_gym.baselines.imitation_flow.fields.coupling import CouplingField
from iflow_gym.baselines.imitation_flow.fields.points import (
    PlanePoint,
    Vector,
    chain,
    products,
    turned_back,
)
from iflow_gym.demonstrations import FloatArray


def coupling_point(field: CouplingField) -> PlanePoint | SpacePoint:
    """Return h and its inverse for one state; not for several threads at once."""
    if field.n_dims > 2:
        return SpacePoint(field)
    rotation, weight, bias, out_weight, out_bias = _weights(field)
    back, still = np.swapaxes(rotation, 1, 2), np.zeros(len(rotation))
    return PlanePoint(rotation, back, still, weight, bias, out_weight, out_bias, field.bound)


class SpacePoint:
    """Coupling layers in three dimensions or more, for a state of d floats."""

    def __init__(self, field: CouplingField) -> None:
        rotation, weight, bias, out_weight, out_bias = _weights(field)
        d, k, n_hidden = field.n_dims, field.n_kept, field.n_hidden
        self._bound, self._n_dims = field.bound, d
        n_moved = d - k
        self._places = [(k + j, j, n_moved + j) for j in range(n_moved)]
        self._states = np.empty((2, d + 1 + n_hidden))
        self._start = self._states[0, : d + 1]
        self._tangent, self._turned = np.empty(d), np.empty(d + n_hidden)
        self._slopes = np.empty(n_hidden)
        self._out, self._d_out = np.empty(2 * n_moved), np.empty(2 * n_moved)
        second = products(np.concatenate([out_bias, out_weight], axis=2))
        seen = np.zeros((len(rotation), n_hidden, d))
        seen[:, :, :k] = weight
        turns, self._last = turned_back(rotation)
        steps = chain(self._states, rotation, seen, bias)
        back = chain(self._states, turns, seen[::-1], bias[::-1])
        self._steps = list(zip(steps, second, strict=True))
        self._back = list(zip(back, second[::-1], strict=True))
        third = products(np.concatenate([rotation, seen @ rotation], axis=1))
        self._tangents = list(zip(self._steps, third, products(out_weight), strict=True))

    def forward(self, z: Vector) -> Vector:
        """Return h(z)."""
        out, bound, places, activate = self._out, self._bound, self._places, np.tanh
        self._start[:] = (*z, 1.0)
        for (first, before, after, units, shown), second in self._steps:
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
        self._start[:] = (*y, 1.0)
        for (first, before, after, units, shown), second in self._back:
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
