"""Gaussian process regression of the velocity on the position, with a sparse posterior.

Each component of the velocity is a Gaussian process of zero mean over positions, all with one
kernel: squared exponential with a length scale an axis, and white noise (Rasmussen & Williams,
"Gaussian Processes for Machine Learning", MIT Press 2006, eq. (5.1), (2.25)). scikit-learn
maximises the marginal likelihood, eq. (5.8), on an even subset of the samples. The posterior mean
is then that of the subset of regressors on all samples (ibid., eq. (8.14)): with m inducing
positions Z among the samples X,

    f(x) = k(x, Z) alpha,   alpha = (sigma^2 K_ZZ + K_ZX K_XZ)^-1 K_ZX V,

which for Z = X is the exact posterior mean. The cost is n m^2 in place of n^3.

Deviation: the predictive variance that `log_prob` uses,

    sigma^2 + k(x, x) - k(x, Z) K_ZZ^-1 k(Z, x),

is that of the projected process (ibid., eq. (8.27)) without its last term, the uncertainty of the
weights: where there are samples it is a small part of the noise, and without it a model is its
inducing positions and `alpha` alone.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import cho_solve, cholesky, solve_triangular
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from iflow_gym.baselines.elementwise import exp2_, exp_
from iflow_gym.baselines.kernels import SquaredExponentials
from iflow_gym.baselines.subsets import evenly
from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.system import DynamicalSystem, Guarantee

JITTER = 1e-10
"""Added to the diagonal of K_ZZ, in units of the signal variance."""

SIGNAL_BOUNDS, LENGTH_BOUNDS, NOISE_BOUNDS = (1e-3, 1e3), (1e-2, 1e2), (1e-6, 1e1)
"""Of the signal variance, the length scales and the noise variance, with positions and velocities
scaled to a mean square of 1."""


@dataclass(frozen=True)
class GPRConfig:
    """Settings of `GPR`."""

    n_inducing: int = 200
    """Inducing positions, taken evenly from the samples; all samples where there are fewer."""
    likelihood_samples: int = 400
    """Samples, evenly taken, on which the marginal likelihood is maximised."""

    def __post_init__(self) -> None:
        for field in ("n_inducing", "likelihood_samples"):
            if getattr(self, field) < 2:
                raise ValueError(f"Expected {field} >= 2, got {getattr(self, field)}.")


class GPR(DynamicalSystem):
    """Gaussian process regression: the mean velocity given the position.

    Far from the demonstrations the field falls back to the prior's mean, which is zero: a motion
    that leaves them comes to rest wherever it is.

    Attributes
    ----------
    inducing_ : array, shape (m, d)
        Inducing positions, as offsets from the centre in length.
    alpha_ : array, shape (m, d)
        Weights of the kernels at the inducing positions, in length/s.
    length_scales_ : array, shape (d,)
        In length.
    signal_variance_, noise_variance_ : float
        Of a component of the velocity, in (length/s)^2.

    References
    ----------
    Rasmussen & Williams, "Gaussian Processes for Machine Learning", MIT Press, 2006.

    Examples
    --------
    >>> from iflow_gym import load_lasa
    >>> system = GPR(n_inducing=50, likelihood_samples=100).fit(load_lasa("Angle"), seed=0)
    >>> system.guarantee.kind
    'none'
    """

    name: ClassVar[str] = "gpr"
    title: ClassVar[str] = "GPR"
    Config: ClassVar[type] = GPRConfig
    stochastic_fit: ClassVar[bool] = False
    learns_cycles: ClassVar[bool] = True

    def _fit(self, demonstrations: Demonstrations, rng: np.random.Generator) -> None:
        centre = demonstrations.centre
        x = np.concatenate(demonstrations.positions) - centre
        v = np.concatenate(demonstrations.velocities)
        length, speed = np.sqrt(np.mean(x**2)), np.sqrt(np.mean(v**2))
        signal, scales, noise = maximise_likelihood(
            evenly(x / length, self.config.likelihood_samples),
            evenly(v / speed, self.config.likelihood_samples),
        )
        self._adopt(
            evenly(x, self.config.n_inducing),
            np.empty(0),
            length * scales,
            speed**2 * signal,
            speed**2 * noise,
            centre,
        )
        self.alpha_ = self._weights(x, v)

    def _weights(self, x: FloatArray, v: FloatArray) -> FloatArray:
        """Return alpha, shape (m, d), by least squares on the whole of x and v, shape (n, d)."""
        # In the coordinates of a Cholesky factor of K_ZZ, and with the noise as rows of the
        # problem, the normal equations and their squared condition number are never formed.
        k, m = self._kernel(x), len(self.inducing_)
        features = solve_triangular(self._root, k.T, lower=True).T
        matrix = np.vstack([features, np.sqrt(self.noise_variance_) * np.eye(m)])
        q, r = np.linalg.qr(matrix)
        whitened = np.linalg.solve(r, q[: len(x)].T @ v)
        return np.asarray(solve_triangular(self._root, whitened, lower=True, trans="T"))

    def _adopt(
        self,
        inducing: FloatArray,
        alpha: FloatArray,
        length_scales: FloatArray,
        signal_variance: float,
        noise_variance: float,
        centre: FloatArray,
    ) -> None:
        self.inducing_, self.alpha_, self.length_scales_ = inducing, alpha, length_scales
        self.signal_variance_, self.noise_variance_ = float(signal_variance), float(noise_variance)
        self._centre = centre
        self._scaled = inducing / length_scales
        self._squares = 0.5 * (self._scaled**2).sum(axis=1)
        self._fast = SquaredExponentials(inducing, length_scales, self.signal_variance_)
        gram = self._kernel(inducing)
        gram[np.diag_indices(len(gram))] += JITTER * self.signal_variance_
        self._root = cholesky(gram, lower=True)

    def _kernel(self, x: FloatArray) -> FloatArray:
        """Return k(x, Z), shape (n, m), for offsets from the centre x, shape (n, d)."""
        scaled = x / self.length_scales_
        # -‖x - z‖² / 2, at most 0: rounding far away must not make a kernel above its peak.
        exponent = scaled @ self._scaled.T
        exponent -= self._squares
        exponent -= 0.5 * (scaled**2).sum(axis=1, keepdims=True)
        np.minimum(exponent, 0.0, out=exponent)
        exp_(exponent)
        exponent *= self.signal_variance_
        return exponent

    def _velocity(self, x: FloatArray) -> FloatArray:
        # `_kernel` in fewer passes, with other rounding, to which the fit's alpha is sensitive.
        return exp2_(self._fast.exponents(x - self._centre)) @ self.alpha_

    def variance(self, x: ArrayLike) -> FloatArray:
        """Return the predictive variance of each component, shape (...), noise included.

        For positions x, shape (..., d), in (length/s)^2; see the module's deviation.
        """
        states, shape = self._states(x)
        return self._variance(states).reshape(shape[:-1])

    def _variance(self, x: FloatArray) -> FloatArray:
        k = self._kernel(x - self._centre)
        explained = (k * cho_solve((self._root, True), k.T).T).sum(axis=1)
        return np.asarray(
            self.noise_variance_ + np.clip(self.signal_variance_ - explained, 0.0, None)
        )

    def _log_prob(self, x: FloatArray, x_next: FloatArray, dt: float) -> FloatArray:
        residual, variance = (x_next - x) / dt - self._velocity(x), self._variance(x)
        d = x.shape[1]
        squares = (residual**2).sum(axis=1) / variance
        return np.asarray(-0.5 * (squares + d * np.log(2 * np.pi * variance)) - d * np.log(dt))

    @property
    def guarantee(self) -> Guarantee:
        """None: the regression knows nothing of the goal."""
        return Guarantee(
            "none",
            "a regression of velocities: nothing in it keeps the goal an equilibrium or attracts "
            "to it, and away from the demonstrations it falls back to the velocity zero",
        )

    def _arrays(self) -> dict[str, np.ndarray[Any, Any]]:
        return {
            "inducing": self.inducing_,
            "alpha": self.alpha_,
            "length_scales": self.length_scales_,
            "variances": np.array([self.signal_variance_, self.noise_variance_]),
        }

    def _restore(self, arrays: Mapping[str, np.ndarray[Any, Any]]) -> None:
        names = ("inducing", "alpha", "length_scales", "variances")
        inducing, alpha, scales, variances = (
            np.asarray(arrays[k], dtype=np.float64) for k in names
        )
        m, d = len(np.atleast_1d(inducing)), self.n_dims_
        expected = [(m, d), (m, d), (d,), (2,)]
        came = [a.shape for a in (inducing, alpha, scales, variances)]
        if m < 1 or came != expected:
            raise ValueError(
                f"expected {', '.join(names)} of shapes {expected} with m >= 1, got {came}"
            )
        if not ((scales > 0).all() and (variances > 0).all()):
            raise ValueError(f"expected scales and variances > 0, got {scales} and {variances}")
        signal, noise = variances.tolist()
        self._adopt(inducing, alpha, scales, signal, noise, self.goal_)


def maximise_likelihood(x: FloatArray, v: FloatArray) -> tuple[float, FloatArray, float]:
    """Return the hyperparameters of greatest marginal likelihood.

    Parameters
    ----------
    x, v : arrays, shape (n, d)
        Positions and velocities, scaled to a mean square of about 1.

    Returns
    -------
    signal_variance : float
    length_scales : array, shape (d,)
    noise_variance : float
    """
    kernel = ConstantKernel(1.0, SIGNAL_BOUNDS) * RBF(
        np.ones(x.shape[1]), LENGTH_BOUNDS
    ) + WhiteKernel(0.1, NOISE_BOUNDS)
    with warnings.catch_warnings():
        # A straight line along an axis says nothing of the other axis' scale, and recordings that
        # are all the same nothing of noise: the bounds are then the answer.
        warnings.simplefilter("ignore", ConvergenceWarning)
        process = GaussianProcessRegressor(kernel).fit(x, v)
    found = process.kernel_
    return (
        float(found.k1.k1.constant_value),
        np.atleast_1d(found.k1.k2.length_scale),
        float(found.k2.noise_level),
    )
