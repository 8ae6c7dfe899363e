"""Coupling layers that look their coefficients up: the twin of `CouplingField` for many states.

Where a layer keeps one coordinate, in two and three dimensions, the scale exp(s) and the shift t
that it gives the others are functions of one number u, and a layer is a table. Between its knots
each function is the quintic that has its value and its first two derivatives at both of them
(Hermite interpolation, e.g. de Boor, A Practical Guide to Splines, 2001, chapter I), with as many
cells as bring it within `TOLERANCE` of the functions, and no unit's tanh is taken.

Such layers are a diffeomorphism of their own: their scales are positive, and what divides on the
way back is what multiplied. A translation, of the size of the error, lets it have 0 where the
layers have it, so that a goal there is one of the tabulated flow as well. A state that leaves the
tables is none of theirs; where the layers answer for it, the two meet in a step of the size of the
error.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
import torch

from iflow_gym.demonstrations import FloatArray

REACH = 8.0
"""The table holds u from -REACH to REACH; the demonstrations lie within 1 or so."""

N_CELLS = (4096, 8192)
"""Sizes of a table, tried in turn: the smaller one stays in the processor's cache."""

TOLERANCE = 1e-10
"""How far a table may be from its functions where it is about worst, near the middle of a cell."""

TRANSLATION = 1e-8
"""How far tables may take the origin from where the layers take it to."""

GREATEST_LOG = 300.0
"""Of the logarithm of a product of all layers' scales, which is taken once."""

BLOCK = 1024
"""Points that go through the layers together: what is computed of them stays in the cache."""

_QUINTIC = np.array(
    [
        [-6, 6, -3, -3, -0.5, 0.5],
        [15, -15, 8, 7, 1.5, -1],
        [-10, 10, -6, -4, -1.5, 0.5],
        [0, 0, 0, 0, 0.5, 0],
        [0, 0, 1, 0, 0, 0],
        [1, 0, 0, 0, 0, 0],
    ]
)
"""Coefficients of x^5 to 1 from f(0), f(1), f'(0), f'(1), f''(0), f''(1)."""

_INSIDE = 0.4
"""Where in a cell the error is taken: beside the middle, where a symmetric function has none."""


def table_of(
    arrays: Mapping[str, FloatArray], bound: float, origin: FloatArray
) -> CouplingTable | None:
    """Return the smallest table that is as exact as it has to be, None where there is none."""
    if len(arrays["rotation"]) * bound > GREATEST_LOG:
        return None
    tables = (CouplingTable(arrays, bound, origin, n_cells) for n_cells in N_CELLS)
    return next((table for table in tables if table.is_exact), None)


class _Weights(NamedTuple):
    """Of one layer, as `CouplingField` has them."""

    hidden_weight: FloatArray
    hidden_bias: FloatArray
    out_weight: FloatArray
    out_bias: FloatArray


class _Layer(NamedTuple):
    rotation: FloatArray
    """(d + 1, d + 1): of [state; 1] it gives the place in the table and the rotated state."""
    back: FloatArray
    """Its twin for the rotation's transpose: the place is the one of the layer before."""
    table: FloatArray
    """(6 * 2 moved, n_cells + 2): of scales and then shifts, by powers; NaN in the end cells."""


class CouplingTable:
    """h of coupling layers and its inverse, for states of shape (n, d), d = 2 or 3.

    Rows whose u leaves the table in any layer come back as NaN. Work buffers belong to the call.

    Parameters
    ----------
    arrays : mapping of str to array
        `CouplingField.arrays`.
    bound : float
        Of the log-scales.
    origin : array, shape (d,)
        What the layers take to 0.
    n_cells : int
        Of the table.
    """

    def __init__(
        self, arrays: Mapping[str, FloatArray], bound: float, origin: FloatArray, n_cells: int
    ) -> None:
        rotation = arrays["rotation"]
        self.n_dims = rotation.shape[1]
        self._enter = _with_place(np.eye(self.n_dims), n_cells)
        self._layers: list[_Layer] = []
        self.error = 0.0
        """The greatest one of a layer, relative for the scales."""
        weights = (arrays[name] for name in _Weights._fields)
        for turn, *values in zip(rotation, *weights, strict=True):
            table, error = _table(_Weights(*values), bound, n_cells)
            there, back = _with_place(turn, n_cells), _with_place(turn.T, n_cells)
            self._layers.append(_Layer(there, back, table))
            self.error = max(self.error, error)
        self._translation = np.zeros(self.n_dims)
        self._translation = self.forward(origin[None])[0]

    @property
    def is_exact(self) -> bool:
        """Whether the table may stand for the layers."""
        translation = np.abs(self._translation).max()  # NaN where the origin is outside
        return bool(self.error <= TOLERANCE and translation <= TRANSLATION)

    @np.errstate(invalid="ignore")  # the cell of NaN
    def forward(self, z: FloatArray) -> FloatArray:
        """Return y = h(z), both (n, d)."""
        y = np.empty(z.shape)
        for rows, work in self._blocks(len(z)):
            before, after = work.start(z[rows])
            for layer in self._layers:
                np.dot(layer.rotation, before.seen, after.turned)
                work.look_up(layer.table, after.place)
                moved = after.moved
                moved *= work.scale
                moved += work.shift
                before, after = after, before
            y[rows] = before.state.T
        y -= self._translation
        return y

    @np.errstate(invalid="ignore")
    def inverse(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return z = h^-1(y), (n, d), and log |det dz/dy|, (n,)."""
        z, log_det = np.empty(y.shape), np.empty(len(y))
        for rows, work in self._blocks(len(y)):
            after, before = work.start(y[rows] + self._translation)
            np.dot(self._enter, after.seen, before.turned)
            total = np.ones(work.scale.shape)
            for layer in reversed(self._layers):
                work.look_up(layer.table, before.place)
                total *= work.scale
                moved = before.moved
                moved -= work.shift
                moved /= work.scale
                np.dot(layer.back, before.seen, after.turned)
                before, after = after, before
            z[rows], log_det[rows] = before.state.T, -np.log(total).sum(axis=0)
        return z, log_det

    def _blocks(self, n: int) -> Iterator[tuple[slice, _Work]]:
        for start in range(0, n, BLOCK):
            rows = slice(start, min(start + BLOCK, n))
            yield rows, _Work(self.n_dims, rows.stop - start)


class _State(NamedTuple):
    """Parts of a buffer [place; state; 1], (d + 2, n), which are views of it."""

    place: FloatArray
    """(n,): the cell, and how far into it."""
    state: FloatArray
    """(d, n)."""
    moved: FloatArray
    """(d - 1, n), the state's last."""
    seen: FloatArray
    """[state; 1]."""
    turned: FloatArray
    """[place; state]."""


class _Work:
    """Buffers for n points, and the views of them."""

    def __init__(self, n_dims: int, n: int) -> None:
        buffers, n_out = np.ones((2, n_dims + 2, n)), 2 * (n_dims - 1)
        self.states = [_State(b[0], b[1:-1], b[2:-1], b[1:], b[:-1]) for b in buffers]
        self.whole, self.cell = np.empty(n), np.empty(n, dtype=np.intp)
        self.found = np.empty((6 * n_out, n))
        self.highest, *self.lower, self.constant = self.found.reshape(6, n_out, n)
        self.out = np.empty((n_out, n))
        self.scale, self.shift = self.out[: n_dims - 1], self.out[n_dims - 1 :]

    def start(self, points: FloatArray) -> list[_State]:
        """Return the two buffers, the first one filled with points (n, d)."""
        self.states[0].state[...] = points.T
        return self.states

    def look_up(self, table: FloatArray, place: FloatArray) -> None:
        """Fill scale and shift, (moved, n), for places (n,), whose fractions stay."""
        cell, out = self.cell, self.out
        np.copyto(cell, place, casting="unsafe")
        np.copyto(self.whole, cell)
        place -= self.whole
        table.take(cell, 1, self.found, "clip")
        np.multiply(self.highest, place, out)
        for coefficient in self.lower:
            np.add(out, coefficient, out)
            np.multiply(out, place, out)
        np.add(out, self.constant, out)


def _with_place(rotation: FloatArray, n_cells: int) -> FloatArray:
    """Return (d + 1, d + 1), which of [state; 1] gives [place; rotated state]."""
    d = len(rotation)
    both = np.zeros((d + 1, d + 1))
    both[0, :d], both[0, d] = rotation[0] * (n_cells / (2 * REACH)), n_cells / 2 + 1
    both[1:, :d] = rotation
    return both


def _table(weights: _Weights, bound: float, n_cells: int) -> tuple[FloatArray, float]:
    """Return a layer's table and its greatest error, of scales a relative one."""
    step = 2 * REACH / n_cells
    knots = np.linspace(-REACH, REACH, n_cells + 1)
    ends = [f * step**k for k, f in enumerate(_functions(knots, weights, bound))]
    left_right = np.stack([f[:, cells] for f in ends for cells in (slice(-1), slice(1, None))])
    coefficients = np.tensordot(_QUINTIC, left_right, 1)
    exact, _, _ = _functions(knots[:-1] + _INSIDE * step, weights, bound)
    found = np.tensordot(_INSIDE ** np.arange(5, -1, -1), coefficients, 1)
    error = np.abs(found - exact)
    n_moved = len(exact) // 2
    error[:n_moved] /= exact[:n_moved]
    table = np.full((6, len(exact), n_cells + 2), np.nan)
    table[..., 1:-1] = coefficients
    return table.reshape(-1, n_cells + 2), float(error.max())


def _functions(
    u: FloatArray, weights: _Weights, bound: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return scales and shifts, their first and their second derivative at u, (2 moved, n)."""
    rates, out_weight = weights.hidden_weight.T, weights.out_weight
    arguments = weights.hidden_weight * u + weights.hidden_bias[:, None]
    units = torch.from_numpy(arguments).tanh_().numpy()
    slope = 1 - units * units
    value = out_weight @ units + weights.out_bias[:, None]
    first = (out_weight * rates) @ slope
    second = (out_weight * (-2 * rates**2)) @ (units * slope)
    scales = slice(len(value) // 2)
    # s = b tanh(s^ / b), and then exp(s), by the chain rule
    s = bound * np.tanh(value[scales] / bound)
    inner = 1 - (s / bound) ** 2
    second[scales] = inner * (second[scales] - 2 * s / bound**2 * first[scales] ** 2)
    first[scales] *= inner
    value[scales] = scale = np.exp(s)
    second[scales] = scale * (second[scales] + first[scales] ** 2)
    first[scales] *= scale
    return value, first, second
