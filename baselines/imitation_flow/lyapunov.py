"""The Lyapunov function of a fitted ImitationFlow and its gradient, batched, on NumPy.

V(x) = U(h^-1(x)) (paper, Lemma 1). By the chain rule, and since the Jacobian of an inverse is the
inverse of the Jacobian,

    grad V(x) = J_h(z)^-T grad U(z),    z = h^-1(x),

with J_h column by column from the flow's own `push_forward`: exact, for any kind of layers.
"""

from __future__ import annotations

import numpy as np

from iflow_gym.baselines.imitation_flow.fields.latents import CycleField, LatentField, polar
from iflow_gym.baselines.imitation_flow.model import ImitationFlow
from iflow_gym.demonstrations import FloatArray

TUBE = 0.02
"""Round a cycle V may rise up to the level at this distance, in its latent radius."""


class FlowLyapunov:
    """V of a fitted system, and its gradient: a `iflow_gym.residual.LyapunovFunction`.

    Of a motion that ends V is the squared latent distance from the goal, of one that repeats that
    from the latent cycle.
    """

    def __init__(self, system: ImitationFlow) -> None:
        system._require_fit()
        dynamics = system._stepper.dynamics
        latent = dynamics.latent
        assert isinstance(latent, LatentField)
        self._system, self._flow, self._latent = system, dynamics.flow, latent
        self._attractor = dynamics.attractor
        self._frame = np.asarray(dynamics.frame, dtype=np.float64)
        self.decay = 2.0 * latent.min_decay / dynamics.time
        """dV/dt <= -decay V along the mean dynamics, in 1/s."""
        self.floor = 0.0
        """V at the border of the tube round a cycle; 0 for a motion that ends."""
        if isinstance(latent, CycleField):
            self.floor = (TUBE * latent.radius) ** 2

    def value(self, x: FloatArray) -> FloatArray:
        """Return V(x), shape (n,), of states x, shape (n, d)."""
        return self._latent.lyapunov(self._system._encode(x)[0])

    def value_and_gradient(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return V(x), shape (n,), and its gradient in 1/length, shape (n, d)."""
        n, d = x.shape
        z, _ = self._system._encode(x)
        places = np.repeat(z + self._attractor, d, axis=0)
        _, columns = self._flow.push_forward(places, np.tile(np.eye(d), (n, 1)))
        # Row j of what is reshaped is column j of J_h: it is the transpose already.
        transposed = columns.reshape(n, d, d) @ self._frame.T
        gradient = np.linalg.solve(transposed, self._latent_gradient(z)[:, :, None])[:, :, 0]
        return self._latent.lyapunov(z), np.asarray(gradient, dtype=np.float64)

    def _latent_gradient(self, z: FloatArray) -> FloatArray:
        if not isinstance(self._latent, CycleField):
            return 2.0 * z
        rho, unit = polar(z)
        inward = 2.0 * (rho - self._latent.radius)[:, None] * unit
        return np.concatenate([inward, 2.0 * z[:, 2:]], axis=1)
