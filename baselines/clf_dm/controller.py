"""The controller of CLF-DM: a regressor's velocities, corrected where V would not fall.

Everything here is in units: offsets from the goal in a length, times in a time, and V in its mean
over the demonstrations. Equations and deviations are those of `model`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iflow_gym.baselines.clf_dm.config import RhoForm
from iflow_gym.baselines.clf_dm.energy import Energy
from iflow_gym.baselines.clf_dm.regressors import Regressor
from iflow_gym.demonstrations import FloatArray


@dataclass(frozen=True, eq=False)
class Controller:
    """f = fhat + u, and a step of it that knows dt.

    Attributes
    ----------
    energy : Energy
        V of offsets in units.
    regressor : Regressor
        fhat, from offsets in the demonstrations' length to velocities in length/s.
    length, time : float
        The units.
    rho, rho0, kappa0
        As in `CLFDMConfig`.
    """

    energy: Energy
    regressor: Regressor
    length: float
    time: float
    rho: RhoForm
    rho0: float
    kappa0: float

    def corrected(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return f, shape (n, d), V and rho, shape (n,), and the gradient of V, shape (n, d)."""
        # Columns in memory order, as those of the gradient: operations on all rows run along them.
        raw = np.asfortranarray(self.regressor.velocity(x * self.length))
        raw = raw * (self.time / self.length)
        value, gradient = self.energy.value_and_gradient(x)
        square = np.einsum("ni,ni->n", gradient, gradient)
        distance = np.einsum("ni,ni->n", x, x)
        if self.rho == "paper":
            rho = -self.rho0 * np.expm1(-self.kappa0 * np.sqrt(distance))
        else:
            rho = -self.rho0 * np.expm1(-self.kappa0 * distance) * np.sqrt(square)
        excess = np.maximum(np.einsum("ni,ni->n", gradient, raw) + rho, 0.0)
        moving = square > 0
        pull = excess / np.where(moving, square, 1.0)
        velocity = np.where(moving[:, None], raw - pull[:, None] * gradient, 0.0)
        return velocity, value, rho, gradient

    def step(self, x: FloatArray, dt: FloatArray) -> FloatArray:
        """Return the offsets, shape (n, d), a time dt, shape (n,), after x: on a lower level of V.

        Explicit Euler, pulled back along the ray to the goal onto V(x) exp(-rho dt / V(x)) from
        above it.
        """
        velocity, value, rho, _ = self.corrected(x)
        safe = np.where(value > 0, value, 1.0)
        level = value * np.exp(-rho * dt / safe)
        return self.energy.lowered(x + dt[:, None] * velocity, level)
