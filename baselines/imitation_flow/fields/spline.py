"""Rational-quadratic spline couplings in plain NumPy: the twin of `SplineFlow` for one model.

float64 and without autograd; the Jacobian-vector product that the velocity needs is carried through
the layers in the same pass. Points are columns inside, so that a coordinate is one row of memory.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from iflow_gym.baselines.imitation_flow.fields.base import FlowField
from iflow_gym.demonstrations import FloatArray

LOG_WIDTH_BOUND = 1.0
"""Bound of a bin's log-width before widths are scaled to fill the interval: no bin is narrower than
exp(-2) times the mean."""


class Config(Protocol):
    """What the layers need of a configuration."""

    @property
    def log_scale_bound(self) -> float:
        """The bound b of the log-slopes of bins and knots."""

    @property
    def spline_bound(self) -> float:
        """B: outside [-B, B] a spline is the identity."""


def row_bounds(n_bins: int, log_scale_bound: float) -> FloatArray:
    """Return the bound of each row of the conditioner's output, shape (3 n_bins - 1,).

    The rows are the bins' log-widths, the bins' log-slopes before they are scaled to a mean slope
    of 1, which at most doubles them, and the inner knots' log-slopes.
    """
    bounds = (LOG_WIDTH_BOUND, log_scale_bound / 2, log_scale_bound)
    return np.repeat(bounds, (n_bins, n_bins, n_bins - 1))


class _Layer(NamedTuple):
    """One layer: R (d, d), hidden (h, kept) and (h, 1), out (moved rows, h) and (moved rows, 1)."""

    rotation: FloatArray
    hidden_weight: FloatArray
    hidden_bias: FloatArray
    out_weight: FloatArray
    out_bias: FloatArray


class _Bins(NamedTuple):
    """Widths w and heights v of the bins (moved, K, n), inner knots' slopes (moved, K - 1, n)."""

    widths: FloatArray
    heights: FloatArray
    slopes: FloatArray


class _Piece(NamedTuple):
    """The bin that a coordinate is in, each (moved, n): left ends, sizes, slopes, mean slope."""

    x: FloatArray
    y: FloatArray
    width: FloatArray
    height: FloatArray
    left: FloatArray
    right: FloatArray


class SplineField(FlowField):
    """h and its inverse for states of shape (n, d).

    Parameters
    ----------
    arrays : mapping
        `rotation` (layers, d, d), `hidden_weight` (layers, h, kept), `hidden_bias` (layers, h),
        `out_weight` (layers, moved, 3 K - 1, h) and `out_bias` (layers, moved, 3 K - 1), with
        kept = d // 2 and moved = d - kept; the rows are those of `row_bounds`.
    config : Config
        Anything with a `log_scale_bound` and a `spline_bound`.

    Raises
    ------
    ValueError
        If shapes do not fit or values are not finite. Finite values give increasing splines,
        whatever they are.
    """

    NAMES: ClassVar[tuple[str, ...]] = (
        "rotation", "hidden_weight", "hidden_bias", "out_weight", "out_bias",
    )  # fmt: skip

    def __init__(self, arrays: Mapping[str, NDArray[Any]], config: Config) -> None:
        self.bound = config.spline_bound
        missing = [name for name in self.NAMES if name not in arrays]
        if missing:
            raise ValueError(f"expected arrays {', '.join(self.NAMES)}, got none of {missing}")
        values = [np.asarray(arrays[name], dtype=np.float64) for name in self.NAMES]
        shapes = [v.shape for v in values]
        if [v.ndim for v in values] != [3, 3, 2, 4, 3]:
            raise ValueError(
                f"expected {', '.join(self.NAMES)} with 3, 3, 2, 4 and 3 axes, got {shapes}"
            )
        n_layers, d, _ = shapes[0]
        h, rows, kept = shapes[1][1], shapes[3][2], d // 2
        expected = [(n_layers, d, d), (n_layers, h, kept), (n_layers, h),
                    (n_layers, d - kept, rows, h), (n_layers, d - kept, rows)]  # fmt: skip
        if n_layers < 1 or d < 2 or rows < 2 or rows % 3 != 2 or shapes != expected:
            raise ValueError(
                f"expected {', '.join(self.NAMES)} of at least one layer and two dimensions, with "
                f"3 K - 1 rows for K bins, and of shapes {expected}, got {shapes}"
            )
        for name, value in zip(self.NAMES, values, strict=True):
            if not np.isfinite(value).all():
                raise ValueError(f"expected finite {name}, got nan or inf")
        self.n_dims, self.n_kept, self.n_bins = d, kept, (rows + 1) // 3
        self.arrays = dict(zip(self.NAMES, values, strict=True))
        self.row_bounds = row_bounds(self.n_bins, config.log_scale_bound)
        self._row_bounds = self.row_bounds[:, None]
        values[2], values[4] = values[2][..., None], values[4].reshape(n_layers, -1, 1)
        values[3] = values[3].reshape(n_layers, -1, h)
        self._layers = [_Layer(*layer) for layer in zip(*values, strict=True)]

    def forward(self, z: FloatArray) -> FloatArray:
        """Return y = h(z), (n, d)."""
        y, k = z.T, self.n_kept
        for layer in self._layers:
            y = layer.rotation @ y
            bins = self._bins(np.exp(self._squashed(layer, self._units(layer, y[:k]))))
            inside = np.clip(y[k:], -self.bound, self.bound)
            index = self._index(inside, bins.widths)
            piece = self._piece(bins, index)
            xi = (inside - piece.x) / piece.width
            s, _, mixed = self._terms(piece, xi)
            numerator = xi * (s * xi + piece.left * (1 - xi))
            y[k:] += piece.y + piece.height * (numerator / mixed) - inside
        return np.ascontiguousarray(y.T)

    def inverse(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return z = h^-1(y), (n, d), and log |det dz/dy|, (n,)."""
        z, k, log_det = y.T.copy(), self.n_kept, np.zeros(len(y))
        for layer in reversed(self._layers):
            bins = self._bins(np.exp(self._squashed(layer, self._units(layer, z[:k]))))
            inside = np.clip(z[k:], -self.bound, self.bound)
            piece = self._piece(bins, self._index(inside, bins.heights))
            s = piece.height / piece.width
            eta = (inside - piece.y) / piece.height
            excess = eta * (piece.left + piece.right - 2 * s)
            b, c = piece.left - excess, eta * s
            xi = 2 * c / (b + np.sqrt(b * b + 4 * (s - b) * c))
            log_det -= np.log(self._slope(piece, xi)).sum(axis=0)
            z[k:] += piece.x + piece.width * xi - inside
            z = layer.rotation.T @ z
        return np.ascontiguousarray(z.T), log_det

    def push_forward(self, z: FloatArray, dz: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return h(z) and the Jacobian-vector product J_h(z) dz, both (n, d)."""
        y, dy, k = z.T, dz.T, self.n_kept
        for layer in self._layers:
            y, dy = layer.rotation @ y, layer.rotation @ dy
            hidden = self._units(layer, y[:k])
            d_hidden = (1 - hidden * hidden) * (layer.hidden_weight @ dy[:k])
            squashed = self._squashed(layer, hidden)
            d_squashed = (layer.out_weight @ d_hidden).reshape(squashed.shape)
            d_squashed *= 1 - (squashed / self._row_bounds) ** 2
            exp = np.exp(squashed)
            bins, d_bins = self._bins(exp), self._d_bins(exp, d_squashed)
            inside = np.clip(y[k:], -self.bound, self.bound)
            index = self._index(inside, bins.widths)
            piece, d_piece = self._piece(bins, index), self._piece(d_bins, index, tangent=True)
            xi = (inside - piece.x) / piece.width
            d_xi = np.where(inside == y[k:], dy[k:], 0) - d_piece.x - xi * d_piece.width
            d_xi /= piece.width
            s, product, mixed = self._terms(piece, xi)
            d_s = (d_piece.height - s * d_piece.width) / piece.width
            d_product = (1 - 2 * xi) * d_xi
            numerator = s * xi * xi + piece.left * product
            d_numerator = d_s * xi * xi + 2 * s * xi * d_xi
            d_numerator += d_piece.left * product + piece.left * d_product
            d_mixed = d_s + (d_piece.left + d_piece.right - 2 * d_s) * product
            d_mixed += (piece.left + piece.right - 2 * s) * d_product
            ratio = numerator / mixed
            d_ratio = (d_numerator - ratio * d_mixed) / mixed
            moved = d_piece.y + d_piece.height * ratio + piece.height * d_ratio
            dy[k:] = np.where(inside == y[k:], moved, dy[k:])
            y[k:] += piece.y + piece.height * ratio - inside
        return np.ascontiguousarray(y.T), np.ascontiguousarray(dy.T)

    def _units(self, layer: _Layer, kept: FloatArray) -> FloatArray:
        hidden = layer.hidden_weight @ kept
        hidden += layer.hidden_bias
        return np.tanh(hidden, out=hidden)

    def _squashed(self, layer: _Layer, hidden: FloatArray) -> FloatArray:
        """Return the logarithms of widths and slopes, (moved, 3 K - 1, n)."""
        out = layer.out_weight @ hidden
        out += layer.out_bias
        bounds = self._row_bounds
        out = out.reshape(-1, len(bounds), out.shape[1])
        return bounds * np.tanh(out / bounds)

    def _bins(self, exp: FloatArray) -> _Bins:
        widths = exp[:, : self.n_bins]
        heights = widths * exp[:, self.n_bins : 2 * self.n_bins]
        length = 2 * self.bound
        return _Bins(
            widths * (length / widths.sum(axis=1, keepdims=True)),
            heights * (length / heights.sum(axis=1, keepdims=True)),
            exp[:, 2 * self.n_bins :],
        )

    def _d_bins(self, exp: FloatArray, d_squashed: FloatArray) -> _Bins:
        """Return the derivative of `_bins` in the direction of the logarithms' `d_squashed`."""
        bins, k, length = self._bins(exp), self.n_bins, 2 * self.bound
        d_log_widths = d_squashed[:, :k]
        d_log_heights = d_log_widths + d_squashed[:, k : 2 * k]
        d_widths, d_heights = bins.widths * d_log_widths, bins.heights * d_log_heights
        return _Bins(
            d_widths - bins.widths * (d_widths.sum(axis=1, keepdims=True) / length),
            d_heights - bins.heights * (d_heights.sum(axis=1, keepdims=True) / length),
            bins.slopes * d_squashed[:, 2 * k :],
        )

    def _index(self, inside: FloatArray, sizes: FloatArray) -> NDArray[np.intp]:
        """Return the bin that each value is in, (moved, 1, n)."""
        knots = np.cumsum(sizes[:, :-1], axis=1) - self.bound
        return (inside[:, None] >= knots).sum(axis=1, keepdims=True)

    def _piece(self, bins: _Bins, index: NDArray[np.intp], *, tangent: bool = False) -> _Piece:
        """Return the bins' entries at the index; the outermost knots are fixed, with slope 1."""

        def at(values: FloatArray) -> FloatArray:
            return np.take_along_axis(values, index, axis=1)[:, 0]

        start = 0.0 if tangent else -self.bound
        edge = np.full_like(bins.widths[:, :1], 0.0 if tangent else 1.0)
        width, height = at(bins.widths), at(bins.heights)
        return _Piece(
            at(np.cumsum(bins.widths, axis=1)) - width + start,
            at(np.cumsum(bins.heights, axis=1)) - height + start,
            width,
            height,
            at(np.concatenate([edge, bins.slopes], axis=1)),
            at(np.concatenate([bins.slopes, edge], axis=1)),
        )

    @staticmethod
    def _terms(piece: _Piece, xi: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the bin's mean slope s, xi (1 - xi) and the denominator of eq. 4."""
        s, product = piece.height / piece.width, xi * (1 - xi)
        return s, product, s + (piece.left + piece.right - 2 * s) * product

    def _slope(self, piece: _Piece, xi: FloatArray) -> FloatArray:
        """Return the spline's derivative, eq. 5 of Durkan et al."""
        s, product, mixed = self._terms(piece, xi)
        ratio = s / mixed
        steep = piece.right * xi * xi + 2 * s * product + piece.left * (1 - xi) ** 2
        return ratio * ratio * steep
