"""Layers for one state, for `realtime`: what the flows of every kind have in common.

A bound method of an array with an output given is NumPy's shortest call. In the plane a layer moves
one coordinate by one that is seen, and all but the units is floats; in space the rotation is part
of the first product. Nothing is allocated but Python floats. The work vectors belong to the point,
so it is not for several threads at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import exp, tanh
from typing import NamedTuple

import numpy as np

from iflow_gym.demonstrations import FloatArray

Vector = list[float]
Product = Callable[..., FloatArray]


class PlanePoint:
    """Layers that move one coordinate by the other in the plane, for a state of two floats.

    A layer is a turn of the plane, an offset of the first coordinate, which the units then see, and
    an affine map of the second: y_1 = u_1 exp(b tanh s^) + t.

    Parameters
    ----------
    turns, backs : arrays, shape (layers, 2, 2)
        The matrices before a layer, and their inverses.
    offsets : array, shape (layers,)
        Added to the first coordinate.
    weight, bias : arrays, shape (layers, h, 1)
        Of the units.
    out_weight, out_bias : arrays, shape (layers, 2, h) and (layers, 2, 1)
        Of the outputs s^ and t.
    bound : float
        The bound b of a log-scale.
    """

    def __init__(
        self,
        turns: FloatArray,
        backs: FloatArray,
        offsets: FloatArray,
        weight: FloatArray,
        bias: FloatArray,
        out_weight: FloatArray,
        out_bias: FloatArray,
        bound: float,
    ) -> None:
        n_hidden = weight.shape[1]
        self._bound = bound
        # Inputs and outputs of the products; a constant 1 carries the biases.
        self._seen, self._work = np.ones(2), np.ones(n_hidden + 1)
        self._units, self._slopes = self._work[:n_hidden], np.empty(n_hidden)
        self._out, self._d_out = np.empty(2), np.empty(2)
        first = products(np.concatenate([weight, bias], axis=2))
        second = products(np.concatenate([out_weight, out_bias], axis=2))
        added = offsets.tolist()
        self._layers = list(zip(turns.tolist(), added, first, second, strict=True))
        self._back = list(zip(backs.tolist(), added, first, second, strict=True))[::-1]
        # One coordinate is seen, so its slope goes into the product of the tangent.
        third = products(out_weight * np.swapaxes(weight, 1, 2))
        self._tangents = list(zip(self._layers, third, strict=True))

    def forward(self, z: Vector) -> Vector:
        """Return h(z)."""
        a, b = z
        seen, units, work, out, bound = self._seen, self._units, self._work, self._out, self._bound
        activate = np.tanh
        for ((r00, r01), (r10, r11)), offset, first, second in self._layers:
            a, b = r00 * a + r01 * b + offset, r10 * a + r11 * b
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
        for ((r00, r01), (r10, r11)), offset, first, second in self._back:
            seen[0] = a
            first(seen, units)
            activate(units, units)
            second(work, out)
            log_scale, shift = out.tolist()
            a, b = a - offset, (b - shift) * exp(-bound * tanh(log_scale))
            a, b = r00 * a + r01 * b, r10 * a + r11 * b
        return [a, b]

    def push_forward(self, z: Vector, dz: Vector) -> tuple[Vector, Vector]:
        """Return h(z) and J_h(z) dz."""
        (a, b), (da, db) = z, dz
        seen, units, work, out, bound = self._seen, self._units, self._work, self._out, self._bound
        slopes, d_out, activate = self._slopes, self._d_out, np.tanh
        for (((r00, r01), (r10, r11)), offset, first, second), third in self._tangents:
            a, b = r00 * a + r01 * b + offset, r10 * a + r11 * b
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


class Step(NamedTuple):
    """A layer's first product and the views that it and the next ones work on, see `chain`."""

    first: Product
    before: FloatArray  # [state; 1]
    after: FloatArray  # [u; 1; arguments of the units]
    units: FloatArray
    shown: FloatArray  # [1; units]


def chain(
    states: FloatArray,
    turns: FloatArray,
    seen: FloatArray,
    bias: FloatArray,
    offsets: FloatArray | None = None,
) -> list[Step]:
    """Return the first products of layers in the order in which they are run, in d dimensions.

    A product takes [x; 1] to [u; 1; w u + bias] with u = turn x + offset. Layers take turns in
    reading from one work vector and writing to the other.

    Parameters
    ----------
    states : array, shape (2, d + 1 + h)
        The work vectors; the units of a layer may be fewer. Every run begins with a state and a 1
        at d of the first one: the 1 is a product like the others, so that a NaN takes it along.
    turns : array, shape (layers, d, d)
    seen, bias : arrays, shape (layers, h, d) and (layers, h, 1)
        Of the units, by u.
    offsets : array, shape (layers, d, 1), optional
    """
    n_layers, d = turns.shape[:2]
    first = np.zeros((n_layers, d + 1 + seen.shape[1], d + 1))
    first[:, :d, :d], first[:, d, d] = turns, 1
    first[:, d + 1 :, :d], first[:, d + 1 :, d:] = seen @ turns, bias
    if offsets is not None:
        first[:, :d, d:] = offsets
        first[:, d + 1 :, d:] += seen @ offsets
    steps = []
    for i, product in enumerate(products(first)):
        before, after = states[i % 2], states[(i + 1) % 2, : d + 1 + seen.shape[1]]
        steps.append(Step(product, before[: d + 1], after, after[d + 1 :], after[d:]))
    return steps


def turned_back(rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the turns of the inverse's chain, first the last layer's, and the one that is left.

    The inverse begins with a layer, and ends with a rotation.
    """
    back = np.swapaxes(rotation, 1, 2)
    turns = np.concatenate([back[1:], np.eye(rotation.shape[1])[None]])
    return turns[::-1], np.ascontiguousarray(back[0])


def products(matrices: FloatArray | Sequence[FloatArray]) -> list[Product]:
    """Return the bound `dot` of each matrix (rows, columns) of a stack."""
    return [np.ascontiguousarray(matrix).dot for matrix in matrices]
