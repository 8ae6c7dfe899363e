"""One trained flow and latent system as plain NumPy: the fast path of `ImitationFlow`.

The same map as `CouplingFlow` with a single model, in float64 and without autograd. Here the
inverse is exact to rounding, whatever precision training had, and the Jacobian-vector product
that the velocity needs is carried through the layers in one pass.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from iflow_gym.baselines.ornstein_uhlenbeck import transition
from iflow_gym.demonstrations import FloatArray

NAMES = ("rotation", "hidden_weight", "hidden_bias", "out_weight", "out_bias")
"""The flow's arrays, in the order of `Layer`."""


class Layer(NamedTuple):
    """Parameters of a coupling layer: R (d, d), hidden (kept, h), out (h, 2 moved)."""

    rotation: FloatArray
    hidden_weight: FloatArray
    hidden_bias: FloatArray
    out_weight: FloatArray
    out_bias: FloatArray


class Flow:
    """h and its inverse for states of shape (n, d)."""

    def __init__(self, arrays: Mapping[str, NDArray[Any]], log_scale_bound: float) -> None:
        self.bound = log_scale_bound
        values = [np.asarray(arrays[name], dtype=np.float64) for name in NAMES]
        shapes = [v.shape for v in values]
        if [len(s) for s in shapes] != [3] * 5:
            raise ValueError(f"expected {', '.join(NAMES)} with three axes each, got {shapes}")
        n_layers, d, _ = shapes[0]
        self.n_dims, self.n_kept = d, d // 2
        moved, hidden = d - d // 2, shapes[1][-1]
        expected = [
            (n_layers, d, d),
            (n_layers, self.n_kept, hidden),
            (n_layers, 1, hidden),
            (n_layers, hidden, 2 * moved),
            (n_layers, 1, 2 * moved),
        ]
        if n_layers < 1 or shapes != expected:
            raise ValueError(
                f"expected {', '.join(NAMES)} of at least one layer and of shapes {expected}, got "
                f"{shapes}"
            )
        self.layers = [Layer(*layer) for layer in zip(*values, strict=True)]

    def _hidden(self, layer: Layer, kept: FloatArray) -> FloatArray:
        hidden = kept @ layer.hidden_weight
        hidden += layer.hidden_bias
        return np.tanh(hidden, out=hidden)

    def _coefficients(self, layer: Layer, hidden: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Log-scale and shift, each (n, moved)."""
        out = hidden @ layer.out_weight
        out += layer.out_bias
        n_moved = self.n_dims - self.n_kept
        return self.bound * np.tanh(out[:, :n_moved] / self.bound), out[:, n_moved:]

    def forward(self, z: FloatArray) -> FloatArray:
        """Return y = h(z), (n, d)."""
        k = self.n_kept
        for layer in self.layers:
            z = z @ layer.rotation
            log_scale, shift = self._coefficients(layer, self._hidden(layer, z[:, :k]))
            z[:, k:] *= np.exp(log_scale)
            z[:, k:] += shift
        return z

    def inverse(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return z = h^-1(y), (n, d), and log |det dz/dy|, (n,)."""
        k = self.n_kept
        z, log_det = y.copy(), np.zeros(len(y))
        for layer in reversed(self.layers):
            log_scale, shift = self._coefficients(layer, self._hidden(layer, z[:, :k]))
            z[:, k:] -= shift
            z[:, k:] *= np.exp(-log_scale)
            log_det -= log_scale.sum(axis=1)
            z = z @ layer.rotation.T
        return z, log_det

    def push_forward(self, z: FloatArray, dz: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return h(z) and the Jacobian-vector product J_h(z) dz, both (n, d)."""
        k, n_moved = self.n_kept, self.n_dims - self.n_kept
        for layer in self.layers:
            z, dz = z @ layer.rotation, dz @ layer.rotation
            hidden = self._hidden(layer, z[:, :k])
            log_scale, shift = self._coefficients(layer, hidden)
            d_hidden = (1 - hidden * hidden) * (dz[:, :k] @ layer.hidden_weight)
            d_out = d_hidden @ layer.out_weight
            d_log_scale = (1 - (log_scale / self.bound) ** 2) * d_out[:, :n_moved]
            scale = np.exp(log_scale)
            dz[:, k:] = scale * (dz[:, k:] + d_log_scale * z[:, k:]) + d_out[:, n_moved:]
            z[:, k:] = scale * z[:, k:] + shift
        return z, dz


class Latent:
    """exp(A t), the transition's covariance and its noise, for one stable A (d, d)."""

    def __init__(self, drift: FloatArray, diffusion: FloatArray) -> None:
        self.drift, self.diffusion = drift, diffusion
        self.symmetric = (drift + drift.T) / 2

    def propagators(self, times: FloatArray) -> FloatArray:
        """exp(A t) for times of shape (n,): shape (n, d, d)."""
        unique, index = np.unique(times, return_inverse=True)
        if len(unique) == 1:
            return np.broadcast_to(
                scipy.linalg.expm(self.drift * unique[0]), (len(times), *self.drift.shape)
            )
        return scipy.linalg.expm(self.drift * unique[:, None, None])[index.reshape(-1)]

    def transition(self, time: float) -> tuple[FloatArray, FloatArray]:
        """Propagator and covariance (d, d) of z_t | z_0."""
        return transition(self.drift, self.diffusion, time)
