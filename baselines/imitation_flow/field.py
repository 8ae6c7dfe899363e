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

from iflow_gym.demonstrations import FloatArray


class Layer(NamedTuple):
    """Parameters of a coupling layer: R (d, d), hidden (kept, h), out (h, 2 moved)."""

    rotation: FloatArray
    hidden_weight: FloatArray
    hidden_bias: FloatArray
    log_scale_weight: FloatArray
    log_scale_bias: FloatArray
    shift_weight: FloatArray
    shift_bias: FloatArray


class Flow:
    """h and its inverse for states of shape (n, d)."""

    def __init__(self, arrays: Mapping[str, NDArray[Any]], log_scale_bound: float) -> None:
        self.bound = log_scale_bound
        names = ("rotation", "hidden_weight", "hidden_bias", "out_weight", "out_bias")
        values = [np.asarray(arrays[name], dtype=np.float64) for name in names]
        n_layers, d, _ = values[0].shape
        self.n_dims, self.n_kept = d, d // 2
        moved, hidden = d - d // 2, values[1].shape[-1]
        expected = [
            (n_layers, d, d),
            (n_layers, self.n_kept, hidden),
            (n_layers, 1, hidden),
            (n_layers, hidden, 2 * moved),
            (n_layers, 1, 2 * moved),
        ]
        if (shapes := [v.shape for v in values]) != expected:
            raise ValueError(f"expected arrays {names} of shapes {expected}, got {shapes}")
        self.layers = [
            Layer(r, w, b, wo[:, :moved], bo[:, :moved], wo[:, moved:], bo[:, moved:])
            for r, w, b, wo, bo in zip(*values, strict=True)
        ]

    def _log_scale(self, layer: Layer, hidden: FloatArray) -> FloatArray:
        raw = hidden @ layer.log_scale_weight + layer.log_scale_bias
        return self.bound * np.tanh(raw / self.bound)

    def forward(self, z: FloatArray) -> FloatArray:
        """Return y = h(z), (n, d)."""
        k = self.n_kept
        for layer in self.layers:
            z = z @ layer.rotation
            hidden = np.tanh(z[:, :k] @ layer.hidden_weight + layer.hidden_bias)
            z[:, k:] *= np.exp(self._log_scale(layer, hidden))
            z[:, k:] += hidden @ layer.shift_weight + layer.shift_bias
        return z

    def inverse(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return z = h^-1(y), (n, d), and log |det dz/dy|, (n,)."""
        k = self.n_kept
        z, log_det = y.copy(), np.zeros(len(y))
        for layer in reversed(self.layers):
            hidden = np.tanh(z[:, :k] @ layer.hidden_weight + layer.hidden_bias)
            log_scale = self._log_scale(layer, hidden)
            z[:, k:] -= hidden @ layer.shift_weight + layer.shift_bias
            z[:, k:] *= np.exp(-log_scale)
            log_det -= log_scale.sum(axis=1)
            z = z @ layer.rotation.T
        return z, log_det

    def push_forward(self, z: FloatArray, dz: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return h(z) and the Jacobian-vector product J_h(z) dz, both (n, d)."""
        k = self.n_kept
        for layer in self.layers:
            z, dz = z @ layer.rotation, dz @ layer.rotation
            hidden = np.tanh(z[:, :k] @ layer.hidden_weight + layer.hidden_bias)
            d_hidden = (1 - hidden**2) * (dz[:, :k] @ layer.hidden_weight)
            log_scale = self._log_scale(layer, hidden)
            d_log_scale = 1 - (log_scale / self.bound) ** 2
            d_log_scale *= d_hidden @ layer.log_scale_weight
            scale = np.exp(log_scale)
            dz[:, k:] = scale * (dz[:, k:] + d_log_scale * z[:, k:])
            dz[:, k:] += d_hidden @ layer.shift_weight
            z[:, k:] = scale * z[:, k:] + hidden @ layer.shift_weight + layer.shift_bias
        return z, dz


class Latent:
    """exp(A t), the transition's covariance and its noise, for one stable A (d, d)."""

    def __init__(self, drift: FloatArray, diffusion: FloatArray) -> None:
        self.drift, self.diffusion = drift, diffusion
        self.symmetric = (drift + drift.T) / 2
        self.stationary = scipy.linalg.solve_continuous_lyapunov(drift, -diffusion)

    def propagators(self, times: FloatArray) -> FloatArray:
        """exp(A t) for times of shape (n,): shape (n, d, d)."""
        unique, index = np.unique(times, return_inverse=True)
        if len(unique) == 1:
            return np.broadcast_to(
                scipy.linalg.expm(self.drift * unique[0]), (len(times), *self.drift.shape)
            )
        return scipy.linalg.expm(self.drift * unique[:, None, None])[index.reshape(-1)]

    def transition(self, time: float) -> tuple[FloatArray, FloatArray]:
        """Propagator and covariance (d, d) of z_t | z_0, by Van Loan's block exponential."""
        d = len(self.drift)
        block = np.zeros((2 * d, 2 * d))
        block[:d, :d], block[:d, d:], block[d:, d:] = -self.drift, self.diffusion, self.drift.T
        exponential = scipy.linalg.expm(block * time)
        forward = exponential[d:, d:].T
        covariance = forward @ exponential[:d, d:]
        return forward, (covariance + covariance.T) / 2
