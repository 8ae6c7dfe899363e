"""The stochastic system of a fitted ImitationFlow, in the motion's own units (paper, eq. 5).

`observed` has the mathematics, in the flow's frame and in durations; here lengths are the motion's
and times seconds: x = F y + x*, t = T tau, so that a drift is F / T times, and a diffusion
F / sqrt(T) times what it is there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from iflow_gym.baselines.imitation_flow.noise import LatentSDE
from iflow_gym.baselines.imitation_flow.observed import ObservedSDE
from iflow_gym.baselines.imitation_flow.realtime import MeanDynamics
from iflow_gym.demonstrations import FloatArray
from iflow_gym.system import seconds


class StochasticSystem:
    """dx = drift(x) dt + diffusion(x) dB, by Ito; `ImitationFlow.stochastic` makes it.

    Attributes
    ----------
    noise : LatentSDE
        The latent noise: its class says what holds of stability, `margin` how far.
    """

    def __init__(self, dynamics: MeanDynamics, noise: LatentSDE) -> None:
        self.noise, self._dynamics = noise, dynamics
        self._observed = ObservedSDE(dynamics.flow, noise, dynamics.attractor)
        self._inverse = np.linalg.inv(dynamics.frame)
        self._volume = abs(float(np.linalg.det(dynamics.frame)))

    def drift(self, x: ArrayLike) -> FloatArray:
        """Return the Ito drift, length/s: shape (..., d) for x of shape (..., d).

        The paper's eq. (5) has J f alone; Ito's formula adds half the second derivative of h along
        the noise, without which the equation is not that of h(z).
        """
        y, shape = self._scaled(x)
        return self._moved(self._observed.drift(y)).reshape(shape)

    def printed_drift(self, x: ArrayLike) -> FloatArray:
        """Return eq. (5)'s drift as it is printed, which is the Stratonovich equation's."""
        y, shape = self._scaled(x)
        return self._moved(self._observed.printed_drift(y)).reshape(shape)

    def diffusion(self, x: ArrayLike) -> FloatArray:
        """Return J g, length/sqrt(s): shape (..., d, d)."""
        y, shape = self._scaled(x)
        columns = self._dynamics.frame @ self._observed.diffusion(y)
        return (columns / np.sqrt(self._dynamics.time)).reshape(*shape, shape[-1])

    def generator(self, x: ArrayLike) -> FloatArray:
        """Return LV(x) = LU(h^-1(x)), 1/s, shape (...): the expected rate of V (Lemma 1)."""
        y, shape = self._scaled(x)
        return (self._observed.generator(y) / self._dynamics.time).reshape(shape[:-1])

    def density(self, x: ArrayLike, x0: ArrayLike, t: float) -> FloatArray:
        """Return the density at x, shape (...), of a cloud that was at x0 a time t (s) before.

        Parameters
        ----------
        x : array, shape (..., d)
            Where to look: a grid, say.
        x0 : array, shape (n, d) or (d,)
            Where the cloud began, its n states with one weight.
        t : float
            > 0.

        Returns
        -------
        array, shape (...)
            In 1/length^d. As exact as the latent transition's density is: exactly for additive
            noise.
        """
        y, shape = self._scaled(x)
        start, _ = self._scaled(np.atleast_2d(np.asarray(x0, dtype=np.float64)))
        value = self._observed.density(y, start, seconds(t) / self._dynamics.time)
        return (value / self._volume).reshape(shape[:-1])

    def _scaled(self, x: ArrayLike) -> tuple[FloatArray, tuple[int, ...]]:
        states, d = np.asarray(x, dtype=np.float64), len(self._inverse)
        if states.ndim == 0 or states.shape[-1] != d:
            raise ValueError(f"Expected states of shape (..., {d}), got {states.shape}.")
        flat = states.reshape(-1, d) - self._dynamics.origin
        return flat @ self._inverse.T, states.shape

    def _moved(self, rate: FloatArray) -> FloatArray:
        return rate @ self._dynamics.frame.T / self._dynamics.time
