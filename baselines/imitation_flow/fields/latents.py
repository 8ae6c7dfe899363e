"""One fitted latent system as plain NumPy, in float64: the twins of `latent` and `limit_cycle`.

Both have the same methods. Their mean dynamics, `rate` and `propagate`, are those that the metrics
see; `diffusion`, `ito_drift`, `sample` and the densities are those of the stochastic system with
additive noise (`noise` has the other kind). States are (n, d); time is in durations.

The numbers may come from a file: the constructors check what stability needs of them.
"""

from __future__ import annotations

import math
import warnings
from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from iflow_gym.baselines.ornstein_uhlenbeck import transition
from iflow_gym.demonstrations import FloatArray

N_WINDINGS, N_WAVES, WIDE = 2, 4, 2.0
"""How a wrapped normal is summed: see `limit_cycle`."""


class LatentField(ABC):
    """What both latent systems do; `n_dims` is d, `min_decay` the slowest decay of `lyapunov`."""

    n_dims: int
    min_decay: float
    noise_power: float
    """What additive noise adds to `lyapunov_rate`: LU = lyapunov_rate + noise_power."""

    @abstractmethod
    def rate(self, z: FloatArray) -> FloatArray:
        """Return the mean dynamics dz/dt, (n, d)."""

    @abstractmethod
    def propagate(self, z: FloatArray, times: FloatArray) -> FloatArray:
        """Return where the mean dynamics lead from z (n, d) in times (n,) >= 0, (n, d)."""

    @abstractmethod
    def path(self, z: FloatArray, times: FloatArray) -> FloatArray:
        """Return where they lead from each of z (n, d) at each of times (t,), (n, t, d)."""

    @abstractmethod
    def lyapunov(self, z: FloatArray) -> FloatArray:
        """Return U(z), (n,), which decreases along the mean dynamics."""

    @abstractmethod
    def lyapunov_rate(self, z: FloatArray) -> FloatArray:
        """Return dU/dt along the mean dynamics, (n,)."""

    @abstractmethod
    def diffusion(self, z: FloatArray) -> FloatArray:
        """Return K(z), (n, d, d)."""

    @abstractmethod
    def ito_drift(self, z: FloatArray) -> FloatArray:
        """Return the drift of the Ito equation in the coordinates z, (n, d)."""

    @abstractmethod
    def log_prob(self, z0: FloatArray, z1: FloatArray, t: float) -> FloatArray:
        """Return log p(z_t = z1 | z_0 = z0), both (..., d), for t > 0."""

    @abstractmethod
    def stationary_log_prob(self, z: FloatArray) -> FloatArray:
        """Return the log density in the limit t -> infinity at z (..., d)."""

    @abstractmethod
    def sample(self, z: FloatArray, t: float, rng: np.random.Generator) -> FloatArray:
        """Draw from the exact transition over t > 0 from each of z (n, d), (n, d)."""


class LinearField(LatentField):
    """dz = A z dt + K dB with U(z) = |z|^2.

    Parameters
    ----------
    drift : array, shape (d, d)
        A, whose symmetric part is negative definite.
    diffusion : array, shape (d, d)
        K K^T, symmetric and positive definite.
    """

    def __init__(self, drift: NDArray[Any], diffusion: NDArray[Any]) -> None:
        self.drift, self.covariance_rate = _finite("drift", drift), _finite("diffusion", diffusion)
        self.n_dims = d = len(self.drift) if self.drift.ndim else 0
        for name, matrix in (("drift", self.drift), ("diffusion", self.covariance_rate)):
            if d < 1 or matrix.shape != (d, d):
                raise ValueError(f"expected {name} of shape {(d, d)}, got {matrix.shape}")
        self.min_decay = -float(np.linalg.eigvalsh(self.drift + self.drift.T).max()) / 2
        if not self.min_decay > 0:
            raise ValueError(
                "expected a drift whose symmetric part is negative definite, got the eigenvalue "
                f"{-self.min_decay:.3g}"
            )
        noise = self.covariance_rate
        if not np.allclose(noise, noise.T, rtol=0, atol=1e-9 * np.abs(noise).max()):
            raise ValueError(f"expected a symmetric diffusion, got {noise}")
        if not (least := np.linalg.eigvalsh(noise).min()) > 0:
            raise ValueError(f"expected a positive definite diffusion, got eigenvalue {least:.3g}")
        self.noise_power = float(np.trace(noise))
        self._root = np.linalg.cholesky(noise)
        self._symmetric = (self.drift + self.drift.T) / 2
        self._stationary = _stationary(self.drift, noise)
        self._mean = np.trace(self.drift) / d
        self._centred = self.drift - self._mean * np.eye(d)

    def rate(self, z: FloatArray) -> FloatArray:
        """Return A z, (n, d)."""
        return z @ self.drift.T

    def propagate(self, z: FloatArray, times: FloatArray) -> FloatArray:
        """Return exp(A t) z, (n, d). In the plane no matrix is built for a state."""
        if self.n_dims == 2:
            even, odd = self._coefficients(times)
            return even[:, None] * z + odd[:, None] * (z @ self._centred.T)
        unique, index = np.unique(times, return_inverse=True)
        if len(unique) == 1:
            return z @ scipy.linalg.expm(self.drift * unique[0]).T
        matrices = scipy.linalg.expm(self.drift * unique[:, None, None])[index.reshape(-1)]
        return (matrices @ z[..., None])[..., 0]

    def path(self, z: FloatArray, times: FloatArray) -> FloatArray:
        """Return exp(A t) z for every z and t, (n, t, d).

        Evenly spaced times are reached by doubling: k steps give the next k by one matrix.
        """
        if self.n_dims == 2:
            even, odd = self._coefficients(times)
            turned = (z @ self._centred.T)[:, None]
            return even[:, None] * z[:, None] + odd[:, None] * turned
        n_times = len(times)
        result = np.empty((len(z), n_times, self.n_dims))
        step = times[1] - times[0] if n_times > 1 else 0.0
        even_steps = times[:1] + step * np.arange(n_times)
        if n_times < 3 or not np.allclose(times, even_steps, rtol=0, atol=1e-14 * abs(times[-1])):
            matrices = scipy.linalg.expm(self.drift * times[:, None, None])
            return np.einsum("tij,nj->nti", matrices, z)
        result[:, 0] = z @ scipy.linalg.expm(self.drift * times[0]).T
        done = 1
        while done < n_times:
            forward = scipy.linalg.expm(self.drift * (done * step))
            n_more = min(done, n_times - done)
            result[:, done : done + n_more] = result[:, :n_more] @ forward.T
            done += n_more
        return result

    def _coefficients(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return e, o with exp(A t) = e I + o (A - tr A / 2 I), in the plane: see `latent`."""
        c = self._centred
        square = (c[0, 0] ** 2 + c[0, 1] * c[1, 0]) * times**2
        rate = self._mean * times
        root = np.sqrt(np.abs(square))
        small = root < 1e-2
        safe = np.where(small, 1.0, root)
        if c[0, 0] ** 2 + c[0, 1] * c[1, 0] > 0:
            slow, less = np.exp(rate + root), np.expm1(-2 * root)
            even, odd = slow * (1 + less / 2), slow * less / (-2 * safe)
        else:
            decay = np.exp(rate)
            even, odd = decay * np.cos(root), decay * np.sin(root) / safe
        series = np.exp(rate) * (1 + square / 6 + square**2 / 120)
        return even, np.where(small, series, odd) * times

    def lyapunov(self, z: FloatArray) -> FloatArray:
        """Return |z|^2, (n,)."""
        return np.sum(z * z, axis=1)

    def lyapunov_rate(self, z: FloatArray) -> FloatArray:
        """Return 2 z^T A z <= -2 min_decay |z|^2, (n,)."""
        return 2 * np.sum(z * (z @ self._symmetric), axis=1)

    def diffusion(self, z: FloatArray) -> FloatArray:
        """Return K, the Cholesky factor of K K^T, at every state: (n, d, d)."""
        return np.broadcast_to(self._root, (len(z), self.n_dims, self.n_dims))

    def ito_drift(self, z: FloatArray) -> FloatArray:
        """Return A z, (n, d)."""
        return self.rate(z)

    def log_prob(self, z0: FloatArray, z1: FloatArray, t: float) -> FloatArray:
        """Return the normal log density of z1 - exp(A t) z0, (...)."""
        forward, covariance = transition(self.drift, self.covariance_rate, t)
        return _normal_density(z1 - z0 @ forward.T, covariance)

    def stationary_log_prob(self, z: FloatArray) -> FloatArray:
        """Return the log density of N(0, P), A P + P A^T + K K^T = 0, (...)."""
        return _normal_density(z, self._stationary)

    def sample(self, z: FloatArray, t: float, rng: np.random.Generator) -> FloatArray:
        """Draw exp(A t) z and its noise, (n, d)."""
        forward, covariance = transition(self.drift, self.covariance_rate, t)
        noise = rng.standard_normal(z.shape) @ np.linalg.cholesky(covariance).T
        return z @ forward.T + noise


class CycleField(LatentField):
    """d rho = -a (rho - rho*) dt + s1 dB, d psi = b dt + s2 dB, d z_j = -a_j z_j dt + k_j dB.

    U(z) = (rho - rho*)^2 + sum z_j^2 is the squared distance to the cycle, and dU/dt <= -2
    min_decay U: from every state but rho = 0 the mean dynamics approach the cycle exponentially.
    It says nothing of the phase, which turns at b everywhere. At rho = 0 the field jumps and U has
    a kink (no field on the plane that is continuous has a cycle and no rest point inside); psi is
    taken as 0 there, so that the mean leaves along the first axis.

    Parameters
    ----------
    decay : array, shape (d - 1,)
        a > 0 of the radius, then a_j > 0.
    rate, radius : arrays of one number
        b in rad per duration, and rho* > 0.
    noise : array, shape (d,)
        s1, s2, k_j > 0.
    """

    def __init__(
        self, decay: NDArray[Any], rate: NDArray[Any], radius: NDArray[Any], noise: NDArray[Any]
    ) -> None:
        self.decay, self.noise = _finite("decay", decay), _finite("noise", noise)
        turn, size = _finite("rate", rate), _finite("radius", radius)
        if self.decay.ndim != 1 or len(self.decay) < 1:
            raise ValueError(f"expected decay of shape (d - 1,), d >= 2, got {self.decay.shape}")
        self.n_dims = len(self.decay) + 1
        if self.noise.shape != (self.n_dims,):
            raise ValueError(f"expected noise of shape ({self.n_dims},), got {self.noise.shape}")
        if turn.size != 1 or size.size != 1:
            raise ValueError(f"expected one rate and one radius, got {turn} and {size}")
        self.turn, self.radius = turn.item(), size.item()
        for name, values in (("decay", self.decay), ("radius", size), ("noise", self.noise)):
            if not (values > 0).all():
                raise ValueError(f"expected {name} > 0, got {values}")
        self.min_decay = float(self.decay.min())
        self.normal_noise = np.delete(self.noise, 1)
        self.noise_power = float(np.sum(self.normal_noise**2))

    def rate(self, z: FloatArray) -> FloatArray:
        """Return the polar field in the plane's coordinates, (n, d)."""
        rho, unit = polar(z)
        inward = self.decay[0] * (self.radius - rho)[:, None] * unit
        around = (self.turn * rho)[:, None] * _quarter(unit)
        return np.concatenate([inward + around, -self.decay[1:] * z[:, 2:]], axis=1)

    def propagate(self, z: FloatArray, times: FloatArray) -> FloatArray:
        """Return the polar mean in the plane's coordinates, (n, d)."""
        return self._reach(z, times)

    def path(self, z: FloatArray, times: FloatArray) -> FloatArray:
        """Return the polar mean in the plane's coordinates for every z and t, (n, t, d)."""
        return self._reach(z[:, None], times)

    def _reach(self, z: FloatArray, times: FloatArray) -> FloatArray:
        across, angle = self.to_polar(z)
        return self.from_polar(
            across * np.exp(-self.decay * times[:, None]), angle + self.turn * times
        )

    def to_polar(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (rho - rho*, z_j), shape (..., d - 1), and psi, shape (...)."""
        rho = np.hypot(z[..., 0], z[..., 1])
        across = np.concatenate([(rho - self.radius)[..., None], z[..., 2:]], axis=-1)
        return across, np.arctan2(z[..., 1], z[..., 0])

    def from_polar(self, across: FloatArray, angle: FloatArray) -> FloatArray:
        """Undo `to_polar`; a negative radius is the point opposite."""
        rho = across[..., 0] + self.radius
        plane = np.stack([rho * np.cos(angle), rho * np.sin(angle)], axis=-1)
        return np.concatenate([plane, across[..., 1:]], axis=-1)

    def lyapunov(self, z: FloatArray) -> FloatArray:
        """Return the squared distance to the cycle, (n,)."""
        return np.sum(self.to_polar(z)[0] ** 2, axis=-1)

    def lyapunov_rate(self, z: FloatArray) -> FloatArray:
        """Return -2 a (rho - rho*)^2 - 2 sum a_j z_j^2, (n,)."""
        return -2 * np.sum(self.decay * self.to_polar(z)[0] ** 2, axis=-1)

    def diffusion(self, z: FloatArray) -> FloatArray:
        """Return K(z) = (e_rho s1, rho e_psi s2, e_j k_j) as columns, (n, d, d)."""
        return self.columns(z, np.broadcast_to(self.noise, z.shape))

    def columns(self, z: FloatArray, noise: FloatArray) -> FloatArray:
        """Turn noises (n, d) of rho, psi and z_j into the plane's coordinates, (n, d, d)."""
        rho, unit = polar(z)
        result = noise[:, None, :] * np.eye(self.n_dims)
        result[:, :2, 0] = noise[:, :1] * unit
        result[:, :2, 1] = (noise[:, 1] * rho)[:, None] * _quarter(unit)
        return result

    def ito_drift(self, z: FloatArray) -> FloatArray:
        """Return `rate` and Ito's term -s2^2 / 2 (x, y) of the phase noise, (n, d)."""
        drift = self.rate(z)
        drift[:, :2] -= 0.5 * self.noise[1] ** 2 * z[:, :2]
        return drift

    def log_prob(self, z0: FloatArray, z1: FloatArray, t: float) -> FloatArray:
        """Return the log density in the plane's coordinates, (...), summed over rho's sign."""
        before, angle0 = self.to_polar(z0)
        after, angle1 = self.to_polar(z1)
        variance = -(self.normal_noise**2) * np.expm1(-2 * self.decay * t) / (2 * self.decay)
        turned = angle1 - angle0 - self.turn * t
        mean = np.exp(-self.decay * t) * before
        return self.either_sign(after, mean, variance, turned, self.noise[1] ** 2 * t)

    def stationary_log_prob(self, z: FloatArray) -> FloatArray:
        """Return the log density of a normal radius, a uniform phase and normal z_j, (...)."""
        across, angle = self.to_polar(z)
        variance = self.normal_noise**2 / (2 * self.decay)
        return self.either_sign(across, np.zeros_like(across), variance, angle, np.inf)

    def either_sign(
        self,
        across: FloatArray,
        mean: FloatArray,
        variance: FloatArray,
        turned: FloatArray,
        phase_variance: float,
    ) -> FloatArray:
        """Log density in the plane's coordinates of normal (rho - rho*, z_j) and a phase."""
        opposite = across.copy()
        opposite[..., 0] = -across[..., 0] - 2 * self.radius
        log_density = np.logaddexp(
            _normal(across - mean, variance) + wrapped_normal(turned, phase_variance),
            _normal(opposite - mean, variance) + wrapped_normal(turned + np.pi, phase_variance),
        )
        with np.errstate(divide="ignore"):
            return log_density - np.log(across[..., 0] + self.radius)

    def sample(self, z: FloatArray, t: float, rng: np.random.Generator) -> FloatArray:
        """Draw radius, phase and the other coordinates, (n, d)."""
        across, angle = self.to_polar(z)
        spread = np.sqrt(-np.expm1(-2 * self.decay * t) / (2 * self.decay)) * self.normal_noise
        noise = rng.standard_normal(z.shape)
        across = np.exp(-self.decay * t) * across + spread * noise[:, 1:]
        return self.from_polar(
            across, angle + self.turn * t + self.noise[1] * math.sqrt(t) * noise[:, 0]
        )


def _stationary(drift: FloatArray, noise: FloatArray) -> FloatArray:
    """Return P with A P + P A^T + K K^T = 0, (d, d)."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            covariance = scipy.linalg.solve_continuous_lyapunov(drift, -noise)
        except (RuntimeWarning, scipy.linalg.LinAlgWarning) as error:
            raise ValueError(f"expected a drift of moderate numbers, got {drift}") from error
    return np.asarray(covariance, dtype=np.float64)


def polar(z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the radius (n,) and the direction (n, 2), that of the first axis at the origin."""
    angle = np.arctan2(z[:, 1], z[:, 0])
    return np.hypot(z[:, 0], z[:, 1]), np.stack([np.cos(angle), np.sin(angle)], axis=1)


def wrapped_normal(angle: FloatArray, variance: float) -> FloatArray:
    """Log density of a normal wrapped round the circle: see `limit_cycle.wrapped_normal`."""
    if variance > WIDE**2:
        waves = np.arange(1, N_WAVES + 1)
        weights = np.exp(-0.5 * variance * waves**2)
        series = np.cos(angle[..., None] * waves) @ weights
        return np.log1p(2 * series) - math.log(2 * math.pi)
    angle = np.remainder(angle + np.pi, 2 * np.pi) - np.pi
    shifts = 2 * np.pi * np.arange(-N_WINDINGS, N_WINDINGS + 1)
    windings = -0.5 * (angle[..., None] + shifts) ** 2 / variance
    return np.logaddexp.reduce(windings, axis=-1) - 0.5 * math.log(2 * math.pi * variance)


def _quarter(unit: FloatArray) -> FloatArray:
    return np.stack([-unit[:, 1], unit[:, 0]], axis=1)


def _normal(residual: FloatArray, variance: FloatArray) -> FloatArray:
    return -0.5 * np.sum(residual**2 / variance + np.log(2 * np.pi * variance), axis=-1)


def _normal_density(residual: FloatArray, covariance: FloatArray) -> FloatArray:
    lower = np.linalg.cholesky(covariance)
    white = residual @ np.linalg.inv(lower).T
    log_det = np.log(np.diag(lower)).sum() + 0.5 * len(lower) * math.log(2 * math.pi)
    return -0.5 * np.sum(white**2, axis=-1) - log_det


def _finite(name: str, values: NDArray[Any]) -> FloatArray:
    values = np.asarray(values)
    if values.dtype.kind != "f" or not np.isfinite(values).all():
        raise ValueError(f"expected finite floating numbers in {name}, got {values}")
    return values.astype(np.float64)
