"""Masked autoregressive layers in plain NumPy: the twin of `AutoregressiveFlow` for one model.

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


class Config(Protocol):
    """What the layers need of a configuration."""

    @property
    def log_scale_bound(self) -> float:
        """The bound b of a layer's log-scale."""


def unit_degrees(n_hidden: int, n_dims: int) -> NDArray[np.int64]:
    """Return how many coordinates each hidden unit sees, shape (n_hidden,): 1 to d - 1, sorted.

    The degrees of MADE (Germain et al. 2015), sec. 3: a unit of degree k sees the first k
    coordinates, and is seen by the outputs of those that follow.
    """
    if n_hidden < n_dims - 1:
        raise ValueError(
            f"expected n_hidden >= {n_dims - 1}, a unit for each coordinate but the last, got "
            f"{n_hidden}"
        )
    return 1 + np.arange(n_hidden) * (n_dims - 1) // n_hidden


class _Layer(NamedTuple):
    """One layer: R (d, d), hidden (h, d - 1) and (h, 1), out (d, 2, h) and (d, 2, 1)."""

    rotation: FloatArray
    hidden_weight: FloatArray
    hidden_bias: FloatArray
    out_weight: FloatArray
    out_bias: FloatArray


class AutoregressiveField(FlowField):
    """h and its inverse for states of shape (n, d).

    Parameters
    ----------
    arrays : mapping
        `rotation` (layers, d, d), `hidden_weight` (layers, h, d - 1), `hidden_bias` (layers, h),
        `out_weight` (layers, d, 2, h) and `out_bias` (layers, d, 2), whose pairs are a coordinate's
        log-scale and shift.
    config : Config
        Anything with a `log_scale_bound`.

    Raises
    ------
    ValueError
        If shapes do not fit, values are not finite, or a coordinate depends on one that does not
        precede it: then h would not be the map that `inverse` inverts.
    """

    NAMES: ClassVar[tuple[str, ...]] = (
        "rotation", "hidden_weight", "hidden_bias", "out_weight", "out_bias",
    )  # fmt: skip

    def __init__(self, arrays: Mapping[str, NDArray[Any]], config: Config) -> None:
        self.bound = config.log_scale_bound
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
        h = shapes[1][1]
        expected = [(n_layers, d, d), (n_layers, h, d - 1), (n_layers, h), (n_layers, d, 2, h),
                    (n_layers, d, 2)]  # fmt: skip
        if n_layers < 1 or d < 2 or shapes != expected:
            raise ValueError(
                f"expected {', '.join(self.NAMES)} of at least one layer and two dimensions and of "
                f"shapes {expected}, got {shapes}"
            )
        for name, value in zip(self.NAMES, values, strict=True):
            if not np.isfinite(value).all():
                raise ValueError(f"expected finite {name}, got nan or inf")
        self.n_dims = d
        self.arrays = dict(zip(self.NAMES, values, strict=True))
        degrees = unit_degrees(h, d)
        _, hidden_weight, _, out_weight, _ = values
        if hidden_weight[:, degrees[:, None] <= np.arange(d - 1)].any():
            raise ValueError("expected hidden_weight 0 where a unit may not see, got others")
        if out_weight.transpose(0, 1, 3, 2)[:, np.arange(d)[:, None] < degrees].any():
            raise ValueError("expected out_weight 0 where an output may not see, got others")
        # Units of degree k are ends[k - 1] to ends[k]: contiguous, since degrees are sorted.
        self.ends: list[int] = np.searchsorted(degrees, np.arange(d), side="right").tolist()
        values[2], values[4] = values[2][..., None], values[4][..., None]
        self._layers = [_Layer(*layer) for layer in zip(*values, strict=True)]

    def forward(self, z: FloatArray) -> FloatArray:
        """Return y = h(z), (n, d)."""
        y = z.T
        for layer in self._layers:
            u = layer.rotation @ y
            y, hidden = np.empty_like(u), np.empty((len(layer.hidden_bias), u.shape[1]))
            for i, (start, end) in enumerate(zip([0, *self.ends], self.ends, strict=False)):
                if end > start:
                    hidden[start:end] = self._units(layer, slice(start, end), y[:i])
                log_scale, shift = self._coefficients(layer, i, hidden[:end])
                y[i] = u[i] * np.exp(log_scale) + shift
        return np.ascontiguousarray(y.T)

    def inverse(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return z = h^-1(y), (n, d), and log |det dz/dy|, (n,)."""
        z, log_det = y.T, np.zeros(len(y))
        d = self.n_dims
        for layer in reversed(self._layers):
            hidden = self._units(layer, slice(None), z[:-1])
            out = (layer.out_weight.reshape(2 * d, -1) @ hidden).reshape(d, 2, -1)
            out += layer.out_bias
            log_scale = self.bound * np.tanh(out[:, 0] / self.bound)
            z = layer.rotation.T @ ((z - out[:, 1]) * np.exp(-log_scale))
            log_det -= log_scale.sum(axis=0)
        return np.ascontiguousarray(z.T), log_det

    def push_forward(self, z: FloatArray, dz: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return h(z) and the Jacobian-vector product J_h(z) dz, both (n, d)."""
        y, dy = z.T, dz.T
        for layer in self._layers:
            u, du = layer.rotation @ y, layer.rotation @ dy
            y, dy = np.empty_like(u), np.empty_like(u)
            hidden = np.empty((len(layer.hidden_bias), u.shape[1]))
            d_hidden = np.empty_like(hidden)
            for i, (start, end) in enumerate(zip([0, *self.ends], self.ends, strict=False)):
                if end > start:
                    units = slice(start, end)
                    hidden[units] = self._units(layer, units, y[:i])
                    d_hidden[units] = layer.hidden_weight[units, :i] @ dy[:i]
                    d_hidden[units] *= 1 - hidden[units] ** 2
                log_scale, shift = self._coefficients(layer, i, hidden[:end])
                d_log_scale, d_shift = layer.out_weight[i, :, :end] @ d_hidden[:end]
                d_log_scale *= 1 - (log_scale / self.bound) ** 2
                scale = np.exp(log_scale)
                y[i] = u[i] * scale + shift
                dy[i] = scale * (du[i] + d_log_scale * u[i]) + d_shift
        return np.ascontiguousarray(y.T), np.ascontiguousarray(dy.T)

    def _units(self, layer: _Layer, units: slice, seen: FloatArray) -> FloatArray:
        """Return the units, (.., n), from the coordinates that they see."""
        hidden = layer.hidden_weight[units, : len(seen)] @ seen
        hidden += layer.hidden_bias[units]
        return np.tanh(hidden, out=hidden)

    def _coefficients(
        self, layer: _Layer, i: int, hidden: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the log-scale and shift of coordinate i, each (n,), from the units before it."""
        raw, shift = layer.out_weight[i, :, : len(hidden)] @ hidden + layer.out_bias[i]
        return self.bound * np.tanh(raw / self.bound), shift
