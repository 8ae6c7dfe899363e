"""Affine coupling layers on NumPy arrays: the twin of `CouplingFlow` with one model.

    u = R z,    y_a = u_a,    y_b = u_b exp(s) + t,    (s^, t) = V tanh(W u_a + w) + v,
    s = b tanh(s^ / b).

A layer is two matrix products, and the time goes into its tanh. So states are columns, (d, n),
which makes every product and every function run along long rows; what a product can take over, it
does: the first one gives the rotated state, a row of ones and the units' arguments at once,

    [u; 1; 2 (W u_a + w)] = P [z; 1],    [2 s^ / b; t] = Q [1; units],

with the biases as weights of the row of ones. Each tanh here is a sigmoid, which is the same but
for factors and a constant, and torch's: in float64 it takes a third of the time of NumPy's tanh
where a processor has no AVX-512. `push_forward` carries the tangent in the same pass. From
`TABULATED` states on, `forward` and `inverse` look the functions of a layer up: `coupling_table`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from iflow_gym.baselines.imitation_flow.fields.base import (
    FlowConfig,
    FlowField,
    as_float,
    check_orthogonal,
    check_shapes,
)
from iflow_gym.baselines.imitation_flow.fields.coupling_table import BLOCK, CouplingTable, table_of
from iflow_gym.demonstrations import FloatArray

TABULATED = 128
"""States from which on tables are faster than units; they take the time of 100 000 states to make.

With 64 they are as fast. A batch and its states one by one then differ by the tables' error."""


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
        second[:, :moved] *= 2 / self.bound
        conditioner = np.zeros((n_layers, n_hidden, d + 1))
        conditioner[:, :, :kept], conditioner[:, :, d] = 2 * hidden_weight, 2 * hidden_bias
        turns = np.zeros((n_layers, d + 1, d + 1))
        turns[:, :d, :d], turns[:, d, d] = rotation, 1
        # On the way back, a layer's units see what the layer after it has turned back.
        back = np.concatenate([np.swapaxes(turns[1:], 1, 2), np.eye(d + 1)[None]])
        self.arrays = dict(zip(self.NAMES, values, strict=True))
        self._rotation = rotation[0]
        self._forward_stages = _stages(turns, conditioner, second.copy())
        second[:, :moved] *= -1  # the way back shrinks by s
        self._inverse_stages = _stages(back, conditioner, second)[::-1]

    def forward(self, z: FloatArray) -> FloatArray:
        """Return y = h(z), both (n, d)."""
        if len(z) >= TABULATED and (table := self._table) is not None:
            y = table.forward(z)
            if len(outside := _outside(y)):
                y[outside] = self._by_units(z[outside])
            return y
        return self._by_units(z)

    def inverse(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return z = h^-1(y), (n, d), and log |det dz/dy|, (n,)."""
        if len(y) >= TABULATED and (table := self._table) is not None:
            z, log_det = table.inverse(y)
            if len(outside := _outside(z)):
                z[outside], log_det[outside] = self._back_by_units(y[outside])
            return z, log_det
        return self._back_by_units(y)

    @cached_property
    def _table(self) -> CouplingTable | None:
        """The layers by a table, where they can be: one kept coordinate, smooth functions."""
        if self.n_kept != 1:
            return None
        origin, _ = self._back_by_units(np.zeros((1, self.n_dims)))
        return table_of(self.arrays, self.bound, origin[0])

    def __getstate__(self) -> dict[str, Any]:
        """Leave the tables out of copies: they are megabytes, and made anew."""
        return {name: value for name, value in vars(self).items() if name != "_table"}

    def _by_units(self, z: FloatArray) -> FloatArray:
        y = np.empty(z.shape)
        for rows, work in self._blocks(len(z)):
            y[rows] = self._forward(z[rows], work).T
        return y

    def _back_by_units(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        z, log_det = np.empty(y.shape), np.empty(len(y))
        for rows, work in self._blocks(len(y)):
            turned, log_det[rows] = self._inverse(y[rows], work)
            np.dot(turned, self._rotation, out=z[rows])
        return z, log_det

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
        before, after = work.start(z)
        for stage in self._forward_stages:
            work.coefficients(stage, before, after)
            moved = after.moved
            moved *= work.scale()
            moved += work.shift
            before, after = after, before
        return before.state

    def _inverse(self, y: FloatArray, work: _Work) -> tuple[FloatArray, FloatArray]:
        """Return R z of the first layer, (n, d), and log |det dz/dy|, (n,)."""
        before, after = work.start(y)
        total = np.zeros(work.log_scale.shape)
        for stage in self._inverse_stages:
            work.coefficients(stage, before, after)
            total += work.log_scale
            moved = after.moved
            moved -= work.shift
            moved *= work.scale()
            before, after = after, before
        return before.state.T, total.sum(axis=0)

    def _push_forward(
        self, z: FloatArray, dz: FloatArray, work: _Work
    ) -> tuple[FloatArray, FloatArray]:
        d, k = self.n_dims, self.n_kept
        before, after = work.start(z)
        log_scale, tangent = work.log_scale, np.ascontiguousarray(dz.T)
        for stage in self._forward_stages:
            work.coefficients(stage, before, after)
            turned = stage.first[:, :d] @ tangent
            units, d_units = after.activated[1:], turned[d + 1 :]
            d_units *= units * (1 - units)
            d_out = stage.second[:, 1:] @ d_units
            # of b tanh(s^ / b), twice whose argument is the product's
            d_log_scale = (self.bound - log_scale * log_scale / self.bound) / 2 * d_out[: d - k]
            scale = np.exp(log_scale)
            moved, tangent = after.moved, turned[:d]
            tangent[k:] += d_log_scale * moved
            tangent[k:] *= scale
            tangent[k:] += d_out[d - k :]
            moved *= scale
            moved += work.shift
            before, after = after, before
        return before.state, tangent


def _outside(points: FloatArray) -> NDArray[np.intp]:
    """Return the rows, of points (n, d), that a table has no answer for."""
    return np.flatnonzero(np.isnan(points[:, -1]))


def _stages(turns: FloatArray, conditioner: FloatArray, second: FloatArray) -> list[Stage]:
    first = np.concatenate([turns, conditioner @ turns], axis=1)
    return [Stage(*products) for products in zip(first, second, strict=True)]


class _State(NamedTuple):
    """A buffer [state; 1; units], (d + 1 + h, n), and its parts, which are views of it."""

    whole: FloatArray
    state: FloatArray
    """(d, n)."""
    moved: FloatArray
    """(d - d // 2, n), the state's last."""
    seen: FloatArray
    """[state; 1], (d + 1, n)."""
    activated: FloatArray
    """[1; units], (1 + h, n)."""
    units: torch.Tensor
    """(h, n)."""


class _Work:
    """Buffers for n points: two of states, one of what Q gives. Their views are made once."""

    def __init__(self, field: CouplingField, n: int) -> None:
        self.n, self.bound = n, field.bound
        d, k = field.n_dims, field.n_kept
        self.states = []
        for _ in range(2):
            whole = np.empty((d + 1 + field.n_hidden, n))
            parts = whole[:d], whole[k:d], whole[: d + 1], whole[d:]
            self.states.append(_State(whole, *parts, torch.from_numpy(whole[d + 1 :])))
        self.out = np.empty((2 * (d - k), n))
        self.log_scale, self.shift = self.out[: d - k], self.out[d - k :]
        self._log_scale = torch.from_numpy(self.log_scale)

    def start(self, points: FloatArray) -> list[_State]:
        """Return the two buffers, the first one filled with points (n, d)."""
        before = self.states[0]
        before.state[...], before.activated[0] = points.T, 1
        return self.states

    def coefficients(self, stage: Stage, before: _State, after: _State) -> None:
        """Fill `after` from the state in `before`, and log-scale and shift, (moved, n)."""
        np.dot(stage.first, before.seen, after.whole)
        after.units.sigmoid_()
        for weights, out in zip(stage.second, self.out, strict=True):  # one by one is faster
            np.dot(weights, after.activated, out)
        self._log_scale.sigmoid_()
        self.log_scale *= 2 * self.bound
        self.log_scale -= self.bound

    def scale(self) -> FloatArray:
        """Return the scale in place of its logarithm."""
        self._log_scale.exp_()
        return self.log_scale
