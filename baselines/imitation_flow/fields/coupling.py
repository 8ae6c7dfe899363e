"""Affine coupling layers as plain NumPy: the twin of `CouplingFlow` with one model.

    u = R z,    y_a = u_a,    y_b = u_b exp(s) + t,    (s^, t) = V tanh(W u_a + w) + v,
    s = b tanh(s^ / b).

A layer is two matrix products, and the time goes into its tanh. So states are columns, (d, n),
which makes every product and every function run along long rows; what a product can take over, it
does: the first one gives the rotated state, a row of ones and the units' arguments at once,

    [u; 1; -2 (W u_a + w)] = P [z; 1],    [s^ / b; t] = Q [1; units],

with the biases as weights of the row of ones. Units here are tanh units as 1 / (1 + exp(.)), which
is tanh but for factors and a constant, and faster. `push_forward` carries the tangent in the same
pass.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iflow_gym.baselines.imitation_flow.fields.base import (
    FlowConfig,
    FlowField,
    as_float,
    check_orthogonal,
    check_shapes,
)
from iflow_gym.demonstrations import FloatArray

BLOCK = 1024
"""Points that go through the layers together: their units then stay in the processor's cache."""


class Stage(NamedTuple):
    """A layer as the two products of the module: P (d + 1 + h, d + 1) and Q (2 moved, 1 + h)."""

    first: FloatArray
    second: FloatArray


class CouplingField(FlowField):
    """h of coupling layers and its inverse, for states of shape (n, d), d >= 2.

    Work buffers belong to the call, so calls from several threads do not meet.

    Parameters
    ----------
    arrays : mapping of str to array
        ``rotation`` (layers, d, d), ``hidden_weight`` (layers, h, d // 2), ``hidden_bias``
        (layers, h), ``out_weight`` (layers, 2 moved, h) and ``out_bias`` (layers, 2 moved), where
        moved = d - d // 2 and log-scales come before shifts.
    config : FlowConfig
        Its ``log_scale_bound`` is b.
    """

    NAMES = ("rotation", "hidden_weight", "hidden_bias", "out_weight", "out_bias")

    def __init__(self, arrays: Mapping[str, NDArray[Any]], config: FlowConfig) -> None:
        values = as_float(arrays, self.NAMES, (3, 3, 2, 3, 2))
        rotation, hidden_weight, hidden_bias, out_weight, out_bias = values
        n_layers, d = rotation.shape[:2]
        if d < 2:
            raise ValueError(f"expected rotations of at least 2 dimensions, got {d}")
        n_hidden, kept, moved = hidden_weight.shape[1], d // 2, d - d // 2
        expected = [
            (n_layers, d, d),
            (n_layers, n_hidden, kept),
            (n_layers, n_hidden),
            (n_layers, 2 * moved, n_hidden),
            (n_layers, 2 * moved),
        ]
        check_shapes(self.NAMES, values, expected)
        check_orthogonal(rotation)
        self.bound = float(config.log_scale_bound)
        if not 0 < self.bound < np.inf:
            raise ValueError(f"expected log_scale_bound > 0, got {self.bound}")
        self.n_dims, self.n_kept, self.n_hidden = d, kept, n_hidden
        second = np.concatenate([(out_bias - out_weight.sum(2))[..., None], 2 * out_weight], axis=2)
        second[:, :moved] /= self.bound
        conditioner = np.zeros((n_layers, n_hidden, d + 1))
        conditioner[:, :, :kept], conditioner[:, :, d] = -2 * hidden_weight, -2 * hidden_bias
        turns = np.zeros((n_layers, d + 1, d + 1))
        turns[:, :d, :d], turns[:, d, d] = rotation, 1
        # On the way back, a layer's units see what the layer after it has turned back.
        back = np.concatenate([np.swapaxes(turns[1:], 1, 2), np.eye(d + 1)[None]])
        self.arrays = dict(zip(self.NAMES, values, strict=True))
        self._rotation = rotation[0]
        self._forward_stages = _stages(turns, conditioner, second.copy())
        second[:, :moved] *= -1  # the way back shrinks by s
        self._inverse_stages = _stages(back, conditioner, second)[::-1]

    @np.errstate(over="ignore")  # 1 / inf is what a saturated unit is
    def forward(self, z: FloatArray) -> FloatArray:
        """Return y = h(z), both (n, d)."""
        y = np.empty(z.shape)
        for rows, work in self._blocks(len(z)):
            y[rows] = self._forward(z[rows], work).T
        return y

    @np.errstate(over="ignore")
    def inverse(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return z = h^-1(y), (n, d), and log |det dz/dy|, (n,)."""
        z, log_det = np.empty(y.shape), np.empty(len(y))
        for rows, work in self._blocks(len(y)):
            turned, log_det[rows] = self._inverse(y[rows], work)
            np.dot(turned, self._rotation, out=z[rows])
        return z, log_det

    @np.errstate(over="ignore")
    def push_forward(self, z: FloatArray, dz: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return h(z) and the Jacobian-vector product J_h(z) dz, both (n, d)."""
        y, dy = np.empty(z.shape), np.empty(z.shape)
        for rows, work in self._blocks(len(z)):
            state, tangent = self._push_forward(z[rows], dz[rows], work)
            y[rows], dy[rows] = state.T, tangent.T
        return y, dy

    def _blocks(self, n: int) -> Iterator[tuple[slice, _Work]]:
        work: _Work | None = None
        for start in range(0, n, BLOCK):
            rows = slice(start, min(start + BLOCK, n))
            if work is None or work.n != rows.stop - start:
                work = _Work(self, rows.stop - start)
            yield rows, work

    def _forward(self, z: FloatArray, work: _Work) -> FloatArray:
        d, k = self.n_dims, self.n_kept
        before, after = work.states
        before[:d], before[d] = z.T, 1
        for stage in self._forward_stages:
            scale, shift = work.coefficients(stage, before, after)
            np.exp(scale, out=scale)
            moved = after[k:d]
            moved *= scale
            moved += shift
            before, after = after, before
        return before[:d]

    def _inverse(self, y: FloatArray, work: _Work) -> tuple[FloatArray, FloatArray]:
        """Return R z of the first layer, (n, d), and log |det dz/dy|, (n,)."""
        d, k = self.n_dims, self.n_kept
        before, after = work.states
        before[:d], before[d] = y.T, 1
        total = np.zeros((d - k, len(y)))
        for stage in self._inverse_stages:
            log_shrink, shift = work.coefficients(stage, before, after)
            total += log_shrink
            np.exp(log_shrink, out=log_shrink)
            moved = after[k:d]
            moved -= shift
            moved *= log_shrink
            before, after = after, before
        return before[:d].T, total.sum(axis=0)

    def _push_forward(
        self, z: FloatArray, dz: FloatArray, work: _Work
    ) -> tuple[FloatArray, FloatArray]:
        d, k = self.n_dims, self.n_kept
        before, after = work.states
        before[:d], before[d] = z.T, 1
        tangent = np.ascontiguousarray(dz.T)
        for first, second in self._forward_stages:
            log_scale, shift = work.coefficients(Stage(first, second), before, after)
            turned = first[:, :d] @ tangent
            units, d_units = after[d + 1 :], turned[d + 1 :]
            d_units *= units * (units - 1)
            d_out = second[:, 1:] @ d_units
            # of b tanh(s^ / b), whose argument is the product's
            d_log_scale = (self.bound - log_scale * log_scale / self.bound) * d_out[: d - k]
            scale = np.exp(log_scale)
            moved, tangent = after[k:d], turned[:d]
            tangent[k:] += d_log_scale * moved
            tangent[k:] *= scale
            tangent[k:] += d_out[d - k :]
            moved *= scale
            moved += shift
            before, after = after, before
        return before[:d], tangent


def _stages(turns: FloatArray, conditioner: FloatArray, second: FloatArray) -> list[Stage]:
    first = np.concatenate([turns, conditioner @ turns], axis=1)
    return [Stage(*products) for products in zip(first, second, strict=True)]


class _Work:
    """Buffers for n points: two of [state; 1; units] (d + 1 + h, n), one of what Q gives."""

    def __init__(self, field: CouplingField, n: int) -> None:
        d, kept = field.n_dims, field.n_kept
        self.n, self.n_dims, self.n_moved, self.bound = n, d, d - kept, field.bound
        self.states = np.empty((2, d + 1 + field.n_hidden, n))
        self.out = np.empty((2 * self.n_moved, n))

    def coefficients(
        self, stage: Stage, before: FloatArray, after: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Fill `after` from the state in `before`; return log-scale and shift, (moved, n)."""
        d = self.n_dims
        np.dot(stage.first, before[: d + 1], out=after)
        units = after[d + 1 :]
        np.exp(units, out=units)
        units += 1
        np.divide(1, units, out=units)
        np.dot(stage.second, after[d:], out=self.out)
        log_scale, shift = self.out[: self.n_moved], self.out[self.n_moved :]
        np.tanh(log_scale, out=log_scale)
        log_scale *= self.bound
        return log_scale, shift
