"""Noise over a latent field: additive, or vanishing at the attractor.

With dz = f dt + g(z) dB (Ito) and a Lyapunov function U, the paper's eq. (3) is

    LU = U_z f + 1/2 tr(g^T U_zz g),

the expected rate of U. Lemma 1 carries LU < 0 over to the observed system. What holds:

Additive noise
    LU = dU/dt + c with c > 0 constant, which is positive close to the attractor. The mean of the
    latent coordinates converges (of rho, psi and z_j for the cycle), E[U] falls to at most
    c / (2 min_decay), and the state has a stationary density around the attractor: it is bounded
    in distribution and does not come to rest. The conditions of the paper's eq. (4) do not hold.

Vanishing noise
    g is proportional to the distance to the attractor, so that LU <= -margin U with
    margin = 2 min_decay - c kappa^2, c = d for the linear latent and 1 for the cycle; with equality
    in the slowest direction, so LU < 0 everywhere if and only if the margin is positive. Then
    E[U] <= U_0 exp(-margin t): the attractor is asymptotically stable in probability and in mean
    square. With a margin <= 0 this U proves nothing, though paths may still converge: kappa |z| I
    has L log|z| <= -min_decay + (d - 2) kappa^2 / 2, which in the plane is negative for any kappa.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Self

import numpy as np
import scipy.linalg

from iflow_gym.baselines.imitation_flow.fields.latents import (
    CycleField,
    LatentField,
    LinearField,
    wrapped_normal,
)
from iflow_gym.baselines.imitation_flow.sde import euler_maruyama
from iflow_gym.demonstrations import FloatArray

N_NODES = 48
"""Gauss-Legendre nodes of the covariance along a mean path."""


class LatentSDE(ABC):
    """dz = drift(z) dt + diffusion(z) dB over a latent field; states (n, d), t > 0 in durations."""

    field: LatentField

    @abstractmethod
    def drift(self, z: FloatArray) -> FloatArray:
        """Return the Ito drift f(z), (n, d)."""

    @abstractmethod
    def diffusion(self, z: FloatArray) -> FloatArray:
        """Return g(z), (n, d, d)."""

    @abstractmethod
    def generator(self, z: FloatArray) -> FloatArray:
        """Return LU(z), (n,), in closed form."""

    @abstractmethod
    def sample(self, z: FloatArray, t: float, rng: np.random.Generator) -> FloatArray:
        """Draw a state after t from each of z (n, d), (n, d)."""

    @abstractmethod
    def log_prob(self, z0: FloatArray, z1: FloatArray, t: float) -> FloatArray:
        """Return log p(z_t = z1 | z_0 = z0), both (n, d), (n,)."""

    @property
    @abstractmethod
    def margin(self) -> float:
        """The largest m with LU <= -m U everywhere, per duration; -inf where there is none."""


class AdditiveNoise(LatentSDE):
    """The field's own noise. Transitions are exact."""

    def __init__(self, field: LatentField) -> None:
        self.field = field

    def drift(self, z: FloatArray) -> FloatArray:
        """Return the Ito drift f(z), (n, d)."""
        return self.field.ito_drift(z)

    def diffusion(self, z: FloatArray) -> FloatArray:
        """Return K(z), (n, d, d)."""
        return self.field.diffusion(z)

    def generator(self, z: FloatArray) -> FloatArray:
        """Return dU/dt + c, (n,): 2 z^T A z + tr(K K^T), or the cycle's with s1^2 + sum k_j^2."""
        return self.field.lyapunov_rate(z) + self.field.noise_power

    def sample(self, z: FloatArray, t: float, rng: np.random.Generator) -> FloatArray:
        """Draw from the exact transition, (n, d)."""
        return self.field.sample(z, t, rng)

    def log_prob(self, z0: FloatArray, z1: FloatArray, t: float) -> FloatArray:
        """Return the exact transition's log density, (n,)."""
        return self.field.log_prob(z0, z1, t)

    @property
    def margin(self) -> float:
        """-inf: LU > 0 at the attractor, where U = 0."""
        return -math.inf

    @property
    def ultimate_bound(self) -> float:
        """What E[U] does not exceed in the limit t -> infinity: c / (2 min_decay)."""
        return self.field.noise_power / (2 * self.field.min_decay)


class VanishingLinearNoise(LatentSDE):
    """dz = A z dt + kappa |z| dB, all d components of dB alike; the field's own K is not used.

    Parameters
    ----------
    field : LinearField
    kappa : float
        >= 0, per square root of the duration.
    n_substeps : int
        Euler-Maruyama steps of a draw.
    """

    def __init__(self, field: LinearField, kappa: float, *, n_substeps: int = 100) -> None:
        self.field: LinearField = field
        self.kappa, self.n_substeps = _kappa(kappa), n_substeps

    def drift(self, z: FloatArray) -> FloatArray:
        """Return A z, (n, d)."""
        return self.field.rate(z)

    def diffusion(self, z: FloatArray) -> FloatArray:
        """Return kappa |z| I, (n, d, d)."""
        size = self.kappa * np.linalg.norm(z, axis=1)
        return size[:, None, None] * np.eye(self.field.n_dims)

    def generator(self, z: FloatArray) -> FloatArray:
        """Return 2 z^T A z + d kappa^2 |z|^2, (n,)."""
        power = self.field.n_dims * self.kappa**2
        return self.field.lyapunov_rate(z) + power * self.field.lyapunov(z)

    @classmethod
    def fit(cls, field: LinearField, z0: FloatArray, z1: FloatArray, t: FloatArray) -> Self:
        """Return the noise under which transitions from z0 to z1 (n, d) over t (n,) are likeliest.

        By `log_prob`, whose covariance is kappa^2 times one that kappa does not enter: the mean of
        the squares that are white by that one.
        """
        unit = cls(field, 1.0)
        squares = np.empty(len(t))
        for time in np.unique(t):
            at = t == time
            residual = z1[at] - field.propagate(z0[at], t[at])
            lower = np.linalg.cholesky(unit.linearised_covariance(z0[at], float(time)))
            squares[at] = np.sum(np.linalg.solve(lower, residual[..., None])[..., 0] ** 2, axis=1)
        return cls(field, math.sqrt(float(squares.mean()) / field.n_dims))

    @property
    def margin(self) -> float:
        """2 min_decay - d kappa^2, per duration."""
        return 2 * self.field.min_decay - self.field.n_dims * self.kappa**2

    def sample(self, z: FloatArray, t: float, rng: np.random.Generator) -> FloatArray:
        """Draw by Euler-Maruyama, (n, d)."""
        return euler_maruyama(self.drift, self.diffusion, z, t, self.n_substeps, rng)

    def moments(self, z0: FloatArray, t: float) -> tuple[FloatArray, FloatArray]:
        """Return the exact mean (n, d) and covariance (n, d, d) of z_t | z_0.

        S = E[z z^T] follows dS/dt = A S + S A^T + kappa^2 tr(S) I, which is linear.
        """
        d = self.field.n_dims
        eye = np.eye(d)
        system = np.kron(self.field.drift, eye) + np.kron(eye, self.field.drift)
        system += self.kappa**2 * np.outer(eye.ravel(), eye.ravel())
        second = (z0[:, :, None] * z0[:, None, :]).reshape(-1, d * d)
        second = second @ scipy.linalg.expm(system * t).T
        mean = self.field.propagate(z0, np.full(len(z0), t))
        return mean, second.reshape(-1, d, d) - mean[:, :, None] * mean[:, None, :]

    def linearised_covariance(self, z0: FloatArray, t: float) -> FloatArray:
        """Return int_0^t exp(A(t-s)) g(z_s) g(z_s)^T exp(A(t-s))^T ds along the mean, (n, d, d).

        The linear noise approximation: z_s is the mean path, which leaves out that noise feeds on
        itself. It is too small, by a relative error of about d kappa^2 t / 2.
        """
        nodes, weights = np.polynomial.legendre.leggauss(N_NODES)
        times, weights = (nodes + 1) * t / 2, weights * t / 2
        size = np.sum(self.field.path(z0, times) ** 2, axis=-1) * weights
        left = scipy.linalg.expm(self.field.drift * (t - times)[:, None, None])
        return self.kappa**2 * np.einsum("nt,tij,tkj->nik", size, left, left)

    def log_prob(self, z0: FloatArray, z1: FloatArray, t: float) -> FloatArray:
        """Return the log density of a normal with the covariance along the mean path, (n,).

        An approximation: the exact density is not normal, it has heavier tails. -inf from the
        attractor itself, which is not left and has no density.
        """
        residual = z1 - self.field.propagate(z0, np.full(len(z0), t))
        covariance = self.linearised_covariance(z0, t)
        moving = np.linalg.det(covariance) > 0
        covariance = np.where(moving[:, None, None], covariance, np.eye(z0.shape[1]))
        lower = np.linalg.cholesky(covariance)
        white = np.linalg.solve(lower, residual[..., None])[..., 0]
        log_det = np.log(np.diagonal(lower, axis1=1, axis2=2)).sum(1)
        total = -0.5 * np.sum(white**2, axis=1) - log_det
        total -= 0.5 * z0.shape[1] * math.log(2 * math.pi)
        return np.where(moving, total, -np.inf)


class VanishingCycleNoise(LatentSDE):
    """Noises kappa |rho - rho*| of the radius and kappa |z_j| of the others; the phase keeps s2.

    The phase's noise moves the state along the cycle and does not enter U. Each coordinate across
    the cycle, x = rho - rho* or z_j, is a geometric Brownian motion dx = -a x dt + kappa x dB,

        x_t = x_0 exp(-(a + kappa^2 / 2) t + kappa B_t),

    so the transitions are exact: log-normal, of the sign of x_0. On the cycle there is no density.

    Parameters
    ----------
    field : CycleField
    kappa : float
        >= 0, per square root of the duration.
    """

    def __init__(self, field: CycleField, kappa: float) -> None:
        self.field: CycleField = field
        self.kappa = _kappa(kappa)

    def drift(self, z: FloatArray) -> FloatArray:
        """Return the Ito drift in the plane's coordinates, (n, d)."""
        return self.field.ito_drift(z)

    def diffusion(self, z: FloatArray) -> FloatArray:
        """Return g(z) in the plane's coordinates, (n, d, d)."""
        across = self.kappa * np.abs(self.field.to_polar(z)[0])
        return self.field.columns(z, np.insert(across, 1, self.field.noise[1], axis=1))

    def generator(self, z: FloatArray) -> FloatArray:
        """Return dU/dt + kappa^2 U, (n,)."""
        return self.field.lyapunov_rate(z) + self.kappa**2 * self.field.lyapunov(z)

    @property
    def margin(self) -> float:
        """2 min_decay - kappa^2, per duration."""
        return 2 * self.field.min_decay - self.kappa**2

    def sample(self, z: FloatArray, t: float, rng: np.random.Generator) -> FloatArray:
        """Draw from the exact transition, (n, d)."""
        across, angle = self.field.to_polar(z)
        noise = math.sqrt(t) * rng.standard_normal(z.shape)
        across = across * np.exp(-self._fall * t + self.kappa * noise[:, 1:])
        turned = angle + self.field.turn * t + self.field.noise[1] * noise[:, 0]
        return self.field.from_polar(across, turned)

    def log_prob(self, z0: FloatArray, z1: FloatArray, t: float) -> FloatArray:
        """Return the exact transition's log density, (n,); -inf where a sign is not z0's.

        For radii that stay positive: one beyond the origin is left out, as in the paper.
        """
        (before, angle0), (after, angle1) = self.field.to_polar(z0), self.field.to_polar(z1)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.log(after / before)
        variance = self.kappa**2 * t
        white = (ratio + self._fall * t) ** 2 / variance
        log_density = -0.5 * (white + math.log(2 * math.pi * variance)) - np.log(np.abs(after))
        total = log_density.sum(1) - np.log(np.hypot(z1[:, 0], z1[:, 1]))
        total += wrapped_normal(angle1 - angle0 - self.field.turn * t, self.field.noise[1] ** 2 * t)
        return np.where(np.isfinite(ratio).all(axis=1), total, -np.inf)

    @property
    def _fall(self) -> FloatArray:
        return self.field.decay + self.kappa**2 / 2


def _kappa(kappa: float) -> float:
    if not 0 <= kappa < math.inf:
        raise ValueError(f"expected a finite kappa >= 0, got {kappa}")
    return float(kappa)
