"""SEDS: the stable estimator of dynamical systems.

Khansari-Zadeh & Billard, "Learning stable non-linear dynamical systems with Gaussian mixture
models", IEEE T-RO 27(5), 2011. The estimator is eq. (8) with the constraints of eq. (16),

    f(x) = sum_k h_k(x) A_k (x - x*),   A_k + A_kᵀ < 0,   h_k(x) ~ pi_k N(x; mu_k, Sigma_k),

which make V(x) = ‖x - x*‖² / 2 decrease everywhere (theorem 2). Deviations from the paper:

- The solver is scipy's SLSQP, from the best of short trials by L-BFGS over gains that are stable by
  construction (`parameters`). Gains that it leaves short of the constraint are moved to the nearest
  ones that keep it.
- Beside the paper's start the solver has one that keeps each Gaussian's own regression (`solver`).
- Samples are scaled to a mean square of 1, thinned evenly, and taken to be uncertain by a small
  variance, which bounds the likelihood.
- `step` integrates with the linearly implicit midpoint rule, so that V falls at every step of any
  dt. Explicit Euler, the authors' choice, agrees with it as dt goes to 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from iflow_gym.baselines.gmr import MixtureField, check_priors
from iflow_gym.baselines.seds.config import SEDSConfig
from iflow_gym.baselines.seds.solver import fit_stable_mixture
from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.system import DynamicalSystem, Guarantee, check_positive_definite

NAMES = ("priors", "centres", "spreads", "gains", "covariances")


class SEDS(DynamicalSystem):
    """A Gaussian mixture regression whose every Gaussian contracts towards the goal.

    `log_prob` is the model's own implication for one explicit Euler step over dt, as `GMR`'s is.

    Attributes
    ----------
    priors_ : array, shape (K,)
    centres_ : array, shape (K, d)
        Means of offsets from the goal, in length.
    spreads_ : array, shape (K, d, d)
        Covariances of the offsets, in length².
    gains_ : array, shape (K, d, d)
        A_k, in 1/s.
    covariances_ : array, shape (K, d, d)
        Cov(v | x, k), in length²/s².
    eigenvalues_ : array, shape (K, d)
        Of A_k + A_kᵀ, ascending, in 1/s: all negative, which is what the proof rests on.
    field_ : MixtureField
        Works on offsets from the goal.

    References
    ----------
    Khansari-Zadeh & Billard, IEEE T-RO 27(5), 2011.

    Examples
    --------
    >>> from iflow_gym import load_lasa
    >>> from iflow_gym.baselines.seds import SEDS
    >>> system = SEDS(n_components=3).fit(load_lasa("Angle"), seed=0)
    >>> bool((system.eigenvalues_ < 0).all())
    True
    """

    name: ClassVar[str] = "seds"
    title: ClassVar[str] = "SEDS"
    Config: ClassVar[type] = SEDSConfig
    integrator: ClassVar[str] = "linearly implicit midpoint"

    def _fit(self, demonstrations: Demonstrations, rng: np.random.Generator) -> None:
        goal = demonstrations.attractor
        x = np.concatenate(demonstrations.positions) - goal
        v = np.concatenate(demonstrations.velocities)
        self._adopt(*fit_stable_mixture(x, v, self.config, rng), goal=goal)

    def _adopt(
        self,
        priors: FloatArray,
        centres: FloatArray,
        spreads: FloatArray,
        gains: FloatArray,
        covariances: FloatArray,
        *,
        goal: FloatArray,
    ) -> None:
        """Take the mixture over and check what the proof rests on."""
        self.eigenvalues_ = contraction(gains)
        self.priors_, self.centres_, self.spreads_ = priors, centres, spreads
        self.gains_, self.covariances_ = gains, covariances
        self.field_ = MixtureField(
            priors, centres, spreads, (gains, np.zeros_like(centres), covariances)
        )
        self._goal = goal
        self._eye = np.eye(len(goal))

    def _velocity(self, x: FloatArray) -> FloatArray:
        return self.field_.velocity(x - self._goal)

    def _step(self, x: FloatArray, dt: FloatArray) -> FloatArray:
        # x' = x + dt A(x) (x + x') / 2 with A(x) = sum_k h_k(x) A_k, so that
        # ‖x'‖² - ‖x‖² = dt mᵀ (A + Aᵀ) m < 0 with m = (x + x') / 2.
        offset = x - self._goal
        half = 0.5 * dt[:, None, None] * self.field_.gain(offset)
        pull = 2.0 * (half.T * offset.T[:, None]).sum(axis=0).T
        return np.asarray(x + np.linalg.solve(self._eye - half, pull[:, :, None])[:, :, 0])

    def _lyapunov(self, x: FloatArray) -> FloatArray:
        return np.asarray(0.5 * ((x - self._goal) ** 2).sum(axis=1))

    def _lyapunov_rate(self, x: FloatArray) -> FloatArray:
        return np.asarray(((x - self._goal) * self._velocity(x)).sum(axis=1))

    def _log_prob(self, x: FloatArray, x_next: FloatArray, dt: float) -> FloatArray:
        return self.field_.transition_log_prob(x - self._goal, x_next - self._goal, dt)

    @property
    def guarantee(self) -> Guarantee:
        """Global asymptotic stability: A_k + A_kᵀ is negative definite for every Gaussian."""
        self._require_fit()
        return Guarantee(
            "proved",
            "V = |x - x*|² / 2 decreases everywhere: every Gaussian's A + Aᵀ has eigenvalues <= "
            f"{self.eigenvalues_.max():.3g} 1/s, checked; the steps decrease it for any dt",
        )

    def _arrays(self) -> dict[str, np.ndarray[Any, Any]]:
        arrays = {name: getattr(self, f"{name}_") for name in NAMES}
        return {**arrays, "eigenvalues": self.eigenvalues_}

    def _restore(self, arrays: Mapping[str, np.ndarray[Any, Any]]) -> None:
        values = [np.asarray(arrays[name], dtype=np.float64) for name in NAMES]
        priors, _, spreads, gains, covariances = values
        stated = np.asarray(arrays["eigenvalues"], dtype=np.float64)
        n, d = priors.size, self.n_dims_
        expected = [(n,), (n, d), (n, d, d), (n, d, d), (n, d, d), (n, d)]
        came = [a.shape for a in (*values, stated)]
        if n < 1 or came != expected:
            raise ValueError(
                f"expected {', '.join(NAMES)} and eigenvalues of shapes {expected} with n >= 1, "
                f"got {came}"
            )
        check_priors(priors)
        check_positive_definite(spreads, "spread")
        check_positive_definite(covariances, "covariance")
        found = contraction(gains)
        if not np.allclose(stated, found, rtol=1e-6, atol=0.0):
            raise ValueError(
                f"expected the eigenvalues of A + Aᵀ to be those of the gains, up to "
                f"{found.max():.6g}, got up to {stated.max():.6g}"
            )
        self._adopt(*values, goal=self.goal_)


def contraction(gains: FloatArray) -> FloatArray:
    """Return the eigenvalues of A + Aᵀ, shape (K, d), of gains of shape (K, d, d), ascending.

    Raises
    ------
    ValueError
        If one is not negative beyond the rounding of its matrix.
    """
    values = np.linalg.eigvalsh(gains + np.swapaxes(gains, 1, 2))
    rounding = 8 * np.finfo(np.float64).eps * np.abs(gains).max(axis=(1, 2), initial=0.0)
    if not (values < -rounding[:, None]).all():
        raise ValueError(
            "expected A + Aᵀ to be negative definite for every Gaussian, got the eigenvalue "
            f"{values.max():.3g} 1/s"
        )
    return np.asarray(values)
