"""Masked autoregressive layers for one state: the twins of `AutoregressiveField` without a batch.

No unit sees the last coordinate and none is seen by the first, whose log-scale and shift are
constants of the layer: they are part of the rotation. So in the plane both directions take one
pass, as a coupling does. In d dimensions h takes d - 1, the units of one degree in each, and h^-1
one.
"""

from __future__ import annotations

from math import exp, tanh
from typing import NamedTuple

import numpy as np

from iflow_gym.baselines.imitation_flow.fields.autoregressive import AutoregressiveField
from iflow_gym.baselines.imitation_flow.fields.points import (
    PlanePoint,
    Product,
    Vector,
    chain,
    products,
    turned_back,
)
from iflow_gym.demonstrations import FloatArray


class _Weights(NamedTuple):
    """Arrays of all layers; the first coordinate's constants are apart from the others' outputs.

    R (layers, d, d), w (layers, h, d), the units' bias (layers, h, 1), V (layers, d - 1, 2, h) and
    v (layers, d - 1, 2, 1) for outputs s^ / b and t, the scale and the shift (layers,) of u_0.
    """

    rotation: FloatArray
    weight: FloatArray
    bias: FloatArray
    out_weight: FloatArray
    out_bias: FloatArray
    scale: FloatArray
    shift: FloatArray


def autoregressive_point(field: AutoregressiveField) -> PlanePoint | SpacePoint:
    """Return h and its inverse for one state; not for several threads at once."""
    if field.n_dims > 2:
        return SpacePoint(field)
    layer = _weights(field)
    turns, backs = layer.rotation.copy(), np.swapaxes(layer.rotation, 1, 2).copy()
    turns[:, 0] *= layer.scale[:, None]
    backs[:, :, 0] /= layer.scale[:, None]
    return PlanePoint(
        turns, backs, layer.shift, layer.weight[:, :, :1], layer.bias, layer.out_weight[:, 0],
        layer.out_bias[:, 0], field.bound,
    )  # fmt: skip


class _Stage(NamedTuple):
    """One coordinate's share of a layer of h, in views of the work vectors."""

    place: int
    argue: Product | None  # from the coordinates before it to its units; None: already done
    state: FloatArray  # [y_0 .. y_{i-1}, u_i ..; 1]
    units: FloatArray  # of degree i
    shown: FloatArray  # [1; units up to degree i]
    second: Product
    # of the tangent: products, and views of [dy_0 .. dy_{i-1}, du_i ..; d units]
    argue_tangent: Product | None
    d_units: FloatArray
    d_shown: FloatArray
    d_second: Product
    slopes: FloatArray


class SpacePoint:
    """Autoregressive layers in three dimensions or more, for a state of d floats."""

    def __init__(self, field: AutoregressiveField) -> None:
        layer = _weights(field)
        (n_layers, d, _), n_hidden = layer.rotation.shape, layer.weight.shape[1]
        self._bound, self._n_dims = field.bound, d
        self._states = np.empty((2, d + 1 + n_hidden))
        self._start = self._states[0, : d + 1]
        self._tangent, self._turned = np.empty(d), np.empty(d + n_hidden)
        self._slopes = np.empty(n_hidden)
        self._out, self._d_out = np.empty(2), np.empty(2)
        self._outs = np.empty(2 * (d - 1))
        # h: the first coordinate's map goes into the turn, and with it the units of degree 1.
        turns, offsets = layer.rotation.copy(), np.zeros((n_layers, d, 1))
        turns[:, 0] *= layer.scale[:, None]
        offsets[:, 0, 0] = layer.shift
        n_first = field.ends[1]
        seen, bias = layer.weight[:, :n_first], layer.bias[:, :n_first]
        steps = chain(self._states, turns, seen, bias, offsets)
        third = products(np.concatenate([turns, seen @ turns], axis=1))
        after = self._turned[: d + n_first]
        stages = [self._stages(layer, field.ends, i) for i in range(n_layers)]
        self._steps = list(zip(steps, stages, strict=True))
        self._tangents = [
            (step, product, after, stage)
            for (step, stage), product in zip(self._steps, third, strict=True)
        ]
        # Its inverse: rows of s^ / b and then of t, of all coordinates but the first.
        turns, self._last = turned_back(layer.rotation)
        back = chain(self._states, turns, layer.weight[::-1], layer.bias[::-1])
        rows = np.concatenate([layer.out_bias, layer.out_weight], axis=3)
        second = products(np.swapaxes(rows, 1, 2).reshape(n_layers, 2 * (d - 1), -1))
        constants = zip(layer.shift.tolist(), (1 / layer.scale).tolist(), strict=True)
        self._back = list(zip(back, second[::-1], list(constants)[::-1], strict=True))
        self._places = [(1 + j, j, d - 1 + j) for j in range(d - 1)]

    def _stages(self, layer: _Weights, ends: list[int], number: int) -> list[_Stage]:
        d, row = self._n_dims, self._states[(number + 1) % 2]
        stages = []
        for i in range(1, d):
            start, end = ends[i - 1], ends[i]
            argue = np.concatenate([layer.weight, layer.bias], axis=2)[number, start:end]
            out_weight = layer.out_weight[number, i - 1, :, :end]
            out_bias = layer.out_bias[number, i - 1]
            (first, d_first), (second, d_second) = (
                products([argue, argue[:, :d]]),
                products([np.concatenate([out_bias, out_weight], axis=1), out_weight]),
            )
            stages.append(
                _Stage(
                    i, first if i > 1 else None, row[: d + 1], row[d + 1 + start : d + 1 + end],
                    row[d : d + 1 + end], second, d_first if i > 1 else None,
                    self._turned[d + start : d + end], self._turned[d : d + end], d_second,
                    self._slopes[start:end],
                )
            )  # fmt: skip
        return stages

    def forward(self, z: Vector) -> Vector:
        """Return h(z)."""
        out, bound, activate = self._out, self._bound, np.tanh
        self._start[:] = (*z, 1.0)
        for (first, before, after, _, _), stages in self._steps:
            first(before, after)
            for i, argue, state, units, shown, second, *_ in stages:
                if argue is not None:
                    argue(state, units)
                activate(units, units)
                second(shown, out)
                log_scale, shift = out.tolist()
                after[i] = after.item(i) * exp(bound * tanh(log_scale)) + shift
        result: Vector = after[: self._n_dims].tolist()
        return result

    def inverse(self, y: Vector) -> Vector:
        """Return h^-1(y)."""
        out, bound, places, activate = self._outs, self._bound, self._places, np.tanh
        self._start[:] = (*y, 1.0)
        for (first, before, after, units, shown), second, (constant, shrink) in self._back:
            first(before, after)
            activate(units, units)
            second(shown, out)
            values = out.tolist()
            after[0] = (after.item(0) - constant) * shrink
            for i, s, t in places:
                after[i] = (after.item(i) - values[t]) * exp(-bound * tanh(values[s]))
        result: Vector = self._last.dot(after[: self._n_dims]).tolist()
        return result

    def push_forward(self, z: Vector, dz: Vector) -> tuple[Vector, Vector]:
        """Return h(z) and J_h(z) dz."""
        d, bound, out, d_out = self._n_dims, self._bound, self._out, self._d_out
        turned, tangent = self._turned, self._tangent
        d_state = turned[:d]
        self._start[:] = (*z, 1.0)
        tangent[:] = dz
        for (first, before, after, _, _), third, d_after, stages in self._tangents:
            first(before, after)
            third(tangent, d_after)
            for (
                i, argue, state, units, shown, second, argue_tangent, d_units, d_shown, d_second,
                slopes,
            ) in stages:  # fmt: skip
                if argue is not None and argue_tangent is not None:
                    argue(state, units)
                    argue_tangent(d_state, d_units)
                np.tanh(units, units)
                second(shown, out)
                np.multiply(units, units, slopes)
                np.subtract(1.0, slopes, slopes)
                np.multiply(slopes, d_units, d_units)
                d_second(d_shown, d_out)
                (log_scale, shift), (d_log_scale, d_shift) = out.tolist(), d_out.tolist()
                squashed, place = tanh(log_scale), after.item(i)
                scale = exp(bound * squashed)
                growth = bound * (1 - squashed * squashed) * d_log_scale
                turned[i] = scale * (turned.item(i) + place * growth) + d_shift
                after[i] = place * scale + shift
            tangent[:] = d_state
        return after[:d].tolist(), tangent.tolist()


def _weights(field: AutoregressiveField) -> _Weights:
    rotation, weight, bias, out_weight, out_bias = field.arrays.values()
    padded = np.concatenate([weight, np.zeros((*bias.shape, 1))], axis=2)
    bounds = np.array([field.bound, 1.0])
    out_weight, out_bias = out_weight / bounds[:, None], out_bias / bounds
    scale = np.exp(field.bound * np.tanh(out_bias[:, 0, 0]))
    return _Weights(
        rotation, padded, bias[..., None], out_weight[:, 1:], out_bias[:, 1:, :, None], scale,
        out_bias[:, 0, 1],
    )  # fmt: skip
