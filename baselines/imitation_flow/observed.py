"""The observed system: the latent equation dz = f dt + g dB seen through y = h(z).

By Ito's formula, with J = J_h(z) at z = h^-1(y),

    dy = (J f + 1/2 sum_ij (g g^T)_ij d^2 h / dz_i dz_j) dt + J g dB.

The paper's eq. (5) leaves the second term out. As an Ito equation it is then not the law of h(z);
as a Stratonovich equation it is, where g is constant in z, since there the ordinary chain rule
holds. `drift` is Ito's and `printed_drift` the paper's.

No equation in y is needed for trajectories and densities: they are those of z carried through h,
which is exact, and so what `sample` and `density` do.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from iflow_gym.baselines.imitation_flow.noise import LatentSDE
from iflow_gym.demonstrations import FloatArray

SECOND_STEP = 2e-4
"""Step in z, along a column of g of length 1, of the second derivatives of h."""


class FlowField(Protocol):
    """A fitted flow h in NumPy, for states (n, d)."""

    def forward(self, z: FloatArray) -> FloatArray:
        """Return h(z)."""

    def inverse(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return h^-1(y) and log |det dz/dy|, (n,)."""

    def push_forward(self, z: FloatArray, dz: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return h(z) and J_h(z) dz."""


class ObservedSDE:
    """y = h(z + z*) of a latent equation, with its equation in y; time in durations.

    Parameters
    ----------
    flow : FlowField
    latent : LatentSDE
        In coordinates whose attractor is the origin, or the cycle around it.
    origin : array, shape (d,), optional
        z*, where the flow has the latent origin: h^-1(goal). None is zero.
    """

    def __init__(
        self, flow: FlowField, latent: LatentSDE, origin: FloatArray | None = None
    ) -> None:
        self.flow, self.latent = flow, latent
        self.origin = np.zeros(latent.field.n_dims) if origin is None else origin

    def encode(self, y: FloatArray) -> FloatArray:
        """Return z = h^-1(y) - z*, (n, d)."""
        return self.flow.inverse(y.copy())[0] - self.origin

    def decode(self, z: FloatArray) -> FloatArray:
        """Return y = h(z + z*), (n, d)."""
        return self.flow.forward(z + self.origin)

    def printed_drift(self, y: FloatArray) -> FloatArray:
        """Return the drift of the paper's eq. (5), J f, (n, d)."""
        z = self.encode(y)
        return self._push(z, self.latent.drift(z))

    def drift(self, y: FloatArray) -> FloatArray:
        """Return the Ito drift J f + 1/2 sum_k D^2 h [g_k, g_k], (n, d).

        The second derivative along a column g_k is a difference of Jacobian-vector products of
        fourth order, within about 1e-8 of it where h is smooth (one spline knot between the
        points makes that 1e-3).
        """
        z = self.encode(y)
        g = self.latent.diffusion(z)
        total = self._push(z, self.latent.drift(z))
        for k in range(g.shape[2]):
            total += 0.5 * self._second(z, g[:, :, k])
        return total

    def diffusion(self, y: FloatArray) -> FloatArray:
        """Return J g, (n, d, d)."""
        z = self.encode(y)
        g = self.latent.diffusion(z)
        columns = [self._push(z, g[:, :, k]) for k in range(g.shape[2])]
        return np.stack(columns, axis=2)

    def lyapunov(self, y: FloatArray) -> FloatArray:
        """Return V(y) = U(h^-1(y)), (n,)."""
        return self.latent.field.lyapunov(self.encode(y))

    def generator(self, y: FloatArray) -> FloatArray:
        """Return LV(y) = LU(h^-1(y)), (n,): Lemma 1."""
        return self.latent.generator(self.encode(y))

    def sample(self, y0: FloatArray, times: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Draw trajectories from y0 (n, d) at increasing times (t,) > 0, (n, t, d)."""
        z = self.encode(y0)
        path = np.empty((len(z), len(times), z.shape[1]))
        for k, step in enumerate(np.diff(times, prepend=0.0)):
            z = self.latent.sample(z, float(step), rng)
            path[:, k] = z
        return self.decode(path.reshape(-1, z.shape[1])).reshape(path.shape)

    def log_prob(self, y0: FloatArray, y1: FloatArray, t: float) -> FloatArray:
        """Return log p(y_t = y1 | y_0 = y0) for y0, y1 (n, d), (n,): the paper's eq. (7)."""
        z1, log_det = self.flow.inverse(y1.copy())
        return self.latent.log_prob(self.encode(y0), z1 - self.origin, t) + log_det

    def density(self, y: FloatArray, y0: FloatArray, t: float) -> FloatArray:
        """Return the density at y (k, d) of a cloud that was at y0 (n, d) or (d,) t before, (k,).

        The latent transition density carried through h, mean over the starts: as exact as the
        latent `log_prob` is. A start at a time, so memory is that of one grid.
        """
        z, log_det = self.flow.inverse(y.copy())
        z -= self.origin
        starts = self.encode(np.atleast_2d(y0))
        total = np.zeros(len(y))
        for start in starts:
            before = np.broadcast_to(start, z.shape)
            total += np.exp(self.latent.log_prob(before, z, t) + log_det)
        return total / len(starts)

    def _push(self, z: FloatArray, dz: FloatArray) -> FloatArray:
        return self.flow.push_forward(z + self.origin, dz.copy())[1]

    def _second(self, z: FloatArray, direction: FloatArray) -> FloatArray:
        """D^2 h [v, v], of v's own length."""
        length = np.linalg.norm(direction, axis=1, keepdims=True)
        unit = direction / np.where(length > 0, length, 1.0)
        near, far = (
            self._push(z + k * SECOND_STEP * unit, unit)
            - self._push(z - k * SECOND_STEP * unit, unit)
            for k in (1, 2)
        )
        return length**2 * (8 * near - far) / (12 * SECOND_STEP)
