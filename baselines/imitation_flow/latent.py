"""The latent system dz = A z dt + K dB, stable for every value of its parameters.

A = -(L L^T + eps I) + (S - S^T), so that d|z|^2/dt = -2 z^T (L L^T + eps I) z < 0 and U(z) = |z|^2
is a Lyapunov function of the mean. Transitions over any horizon t are closed forms (paper, sec.
III-B, which has their Euler steps):

    z_t | z_0 ~ N(F z_0, P - F P F^T),    F = exp(A t),    A P + P A^T + K K^T = 0,

where P is the stationary covariance: vec(P) = -(A (x) I + I (x) A)^-1 vec(K K^T), the limit for
short steps of vec(P) = (I - F (x) F)^-1 vec(Sigma), whose inverse the paper's print has lost.
K is diagonal and at least `MIN_NOISE`.

States are (m, d, n): models, coordinates, points. Covariances are computed in float64 whatever the
states are: over a short horizon P - F P F^T is a small difference of large numbers.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

MIN_NOISE = 1e-4
"""Least diffusion per square root of the duration: keeps covariances invertible."""

INITIAL_DECAY = 3.0
"""The latent state falls to exp(-3) = 5 % within a demonstration's duration at the start."""

INITIAL_NOISE = 0.3

SMALL_ROOT = 0.03
"""Below it sinh(q) / q is taken from its series, whose next term is 1e-12."""


class Latent(nn.Module, ABC):
    """`n_models` stable stochastic systems of dimension d; time in durations.

    States z are (m, d, n) with times (m, n), or (m, d, q, p) with times (m, q): q horizons with p
    points each, which is cheaper. Times are > 0 where a density is asked for.
    """

    log_noise: nn.Parameter
    """What the noise alone depends on."""

    @abstractmethod
    def propagate(self, z: Tensor, times: Tensor) -> Tensor:
        """Return the states that the mean dynamics reach from z, of z's shape."""

    @abstractmethod
    def transition_log_prob(self, z0: Tensor, z1: Tensor, times: Tensor) -> Tensor:
        """Return log p(z_t = z1 | z_0 = z0), (m, n) or (m, q, p)."""

    @abstractmethod
    def backward_log_prob(self, z0: Tensor, z1: Tensor, times: Tensor) -> Tensor:
        """Return the paper's log p(z_0 = z0 | z_t = z1), (m, n) or (m, q, p).

        The reverse under a flat prior on z_0 (sec. III-B), not under the stationary density.
        """

    @abstractmethod
    def stationary_log_prob(self, z: Tensor) -> Tensor:
        """Return the log density in the limit t -> infinity, (m, n)."""

    @abstractmethod
    def arrays(self, model: int) -> dict[str, NDArray[np.float64]]:
        """Return one model's numbers: the arguments of its twin in `fields.latents`."""


class LinearLatent(Latent):
    """Stable linear systems with additive noise (see the module).

    Parameters
    ----------
    n_models, n_dims : int
    min_decay : float
        eps, the slowest decay of |z|, per duration.
    """

    def __init__(self, n_models: int, n_dims: int, *, min_decay: float) -> None:
        super().__init__()
        self.min_decay = min_decay
        start = math.sqrt(INITIAL_DECAY - min(min_decay, 0.9 * INITIAL_DECAY))
        eye = torch.eye(n_dims, dtype=torch.float32)  # whatever the process's default is
        self.factor = nn.Parameter(start * eye.repeat(n_models, 1, 1))
        self.skew = nn.Parameter(eye.new_zeros(n_models, n_dims, n_dims))
        self.log_noise = nn.Parameter(eye.new_full((n_models, n_dims), math.log(INITIAL_NOISE)))

    def drift(self) -> Tensor:
        """Return A, shape (m, d, d)."""
        lower = torch.tril(self.factor)
        eye = torch.eye(lower.shape[-1], dtype=lower.dtype, device=lower.device)
        return self.skew - self.skew.mT - lower @ lower.mT - self.min_decay * eye

    def diffusion(self) -> Tensor:
        """Return K K^T, shape (m, d, d)."""
        return torch.diag_embed((MIN_NOISE + torch.exp(self.log_noise)) ** 2)

    def propagate(self, z: Tensor, times: Tensor) -> Tensor:
        """Return exp(A t) z. In the plane no matrix is built for a point."""
        drift = self.drift()
        if z.shape[1] == 2:
            even, odd, centred = _exponential_2d(drift, times)
            shape = (len(z), 1, *times.shape[1:], *[1] * (z.dim() - times.dim() - 1))
            turned = torch.bmm(centred, z.flatten(2)).view(z.shape)
            return torch.addcmul(even.view(shape) * z, odd.view(shape), turned)
        return _apply(propagator(drift, times), z)

    def transition_log_prob(self, z0: Tensor, z1: Tensor, times: Tensor) -> Tensor:
        """Return log N(z1 | F z0, P - F P F^T), (m, n) or (m, q, p)."""
        residual = z1 - self.propagate(z0, times)
        drift, noise = self.drift().double(), self.diffusion().double()
        times = times.double()
        if z0.shape[1] == 2:
            return _white_2d(residual, *_covariance_2d(drift, noise, times))
        return _white(residual, transition(drift, noise, times)[1])

    def backward_log_prob(self, z0: Tensor, z1: Tensor, times: Tensor) -> Tensor:
        """Return log N(z0 | F^-1 z1, F^-1 Sigma F^-T) = log N(z1 | F z0, Sigma) + log |det F|."""
        log_det = self.drift().diagonal(dim1=-2, dim2=-1).sum(-1)[:, None] * times
        forward = self.transition_log_prob(z0, z1, times)
        return forward + log_det.view(*times.shape, *[1] * (forward.dim() - times.dim()))

    def stationary_log_prob(self, z: Tensor) -> Tensor:
        """Return log N(z | 0, P), (m, n)."""
        stationary = stationary_covariance(self.drift().double(), self.diffusion().double())
        return _white(z[:, :, None], stationary[:, None])[:, 0]

    def arrays(self, model: int) -> dict[str, NDArray[np.float64]]:
        """Return the drift A and the diffusion K K^T, both (d, d)."""
        with torch.no_grad():
            pair = {"drift": self.drift()[model], "diffusion": self.diffusion()[model]}
            return {name: value.double().cpu().numpy() for name, value in pair.items()}


def propagator(drift: Tensor, times: Tensor) -> Tensor:
    """exp(A t) for A (m, d, d) and times (m, ...): shape (m, ..., d, d)."""
    flat = times.flatten(1)
    if drift.shape[-1] == 2:
        even, odd, centred = _exponential_2d(drift, flat)
        eye = torch.eye(2, dtype=drift.dtype, device=drift.device)
        result = even[..., None, None] * eye + odd[..., None, None] * centred[:, None]
    else:
        result = torch.linalg.matrix_exp(drift[:, None] * flat[..., None, None])
    return result.unflatten(1, times.shape[1:])


def _exponential_2d(drift: Tensor, times: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return e, o of times' shape and C (m, 2, 2) with exp(A t) = e I + o C, C = A - (tr A / 2) I.

    e = exp(k t) cosh(q t), o = exp(k t) sinh(q t) / q, k = tr A / 2, q^2 = -det C. With q^2 < 0
    these are cosine and sine.
    """
    shape = (-1, *[1] * (times.dim() - 1))
    first, cross, back, last = drift.flatten(1).unbind(1)
    half = (first - last) / 2
    centred = torch.stack([half, cross, back, -half], dim=-1).unflatten(-1, (2, 2))
    rate = ((first + last) / 2).view(shape) * times
    square = (half * half + cross * back).view(shape) * times**2
    even, odd = _CoshSinh.apply(rate, square)
    return even, odd * times, centred


class _CoshSinh(torch.autograd.Function):
    """exp(r) cosh(sqrt s) and exp(r) sinh(sqrt s) / sqrt s, for s of either sign, as one node.

    Their derivatives by s are o / 2 and (e - o) / (2 s), which autograd would find as sums over the
    branches, in many times as many operations.
    """

    @staticmethod
    def forward(ctx: Any, rate: Tensor, square: Tensor) -> tuple[Tensor, Tensor]:
        root = square.abs().sqrt()
        positive, small = square > 0, root < SMALL_ROOT
        safe = torch.where(small, 1.0, root)
        # The exponents r + q and r - q are those of A's eigenvalues: nothing overflows.
        decay = torch.exp(rate + torch.where(positive, root, 0.0))
        less = torch.expm1(-2 * root)
        even = decay * torch.where(positive, 1 + less / 2, torch.cos(root))
        odd = decay * torch.where(positive, -less / 2, torch.sin(root)) / safe
        odd = torch.where(small, torch.exp(rate) * (1 + square / 6 + square**2 / 120), odd)
        ctx.save_for_backward(even, odd, square, rate, small)
        return even, odd

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_even: Tensor, g_odd: Tensor) -> tuple[Tensor, Tensor]:
        even, odd, square, rate, small = ctx.saved_tensors
        by_series = torch.exp(rate) * (1 / 6 + square / 60)
        slope = torch.where(small, by_series, (even - odd) / (2 * torch.where(small, 1.0, square)))
        return g_even * even + g_odd * odd, g_even * odd / 2 + g_odd * slope


def stationary_covariance(drift: Tensor, diffusion: Tensor) -> Tensor:
    """P with A P + P A^T + K K^T = 0, all (m, d, d), by the vectorised linear system.

    In the plane by its solution, a sum of two positive terms (Gardiner, "Handbook of Stochastic
    Methods", on the multivariate Ornstein-Uhlenbeck process),
    P = (det(A) K K^T + B K K^T B^T) / (-2 tr(A) det(A)) with B = A - tr(A) I.
    """
    d = drift.shape[-1]
    eye = torch.eye(d, dtype=drift.dtype, device=drift.device)
    if d == 2:
        first, cross, back, last = drift.flatten(1)[..., None, None].unbind(1)
        trace, det = first + last, first * last - cross * back
        other = drift - trace * eye
        return (det * diffusion + other @ diffusion @ other.mT) / (-2 * trace * det)
    left = torch.einsum("mij,kl->mikjl", drift, eye).reshape(-1, d * d, d * d)
    right = torch.einsum("ij,mkl->mikjl", eye, drift).reshape(-1, d * d, d * d)
    solved = torch.linalg.solve(left + right, -diffusion.reshape(-1, d * d, 1))
    covariance = solved.reshape(-1, d, d)
    return (covariance + covariance.mT) / 2


def _floor(stationary: Tensor) -> Tensor:
    """For short horizons P - F P F^T cancels to rounding errors, which may be negative: (m, 1)."""
    largest = stationary.diagonal(dim1=-2, dim2=-1).amax(-1, keepdim=True)
    return 8 * torch.finfo(stationary.dtype).eps * largest


def transition(drift: Tensor, diffusion: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
    """Propagator and covariance of z_t | z_0 for times (m, n): two tensors (m, n, d, d)."""
    forward = propagator(drift, times)
    stationary = stationary_covariance(drift, diffusion)
    covariance = stationary[:, None] - forward @ stationary[:, None] @ forward.mT
    eye = torch.eye(drift.shape[-1], dtype=drift.dtype, device=drift.device)
    floor = _floor(stationary)[..., None, None] * eye
    return forward, (covariance + covariance.mT) / 2 + floor


def _covariance_2d(
    drift: Tensor, diffusion: Tensor, times: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the entries (0, 0), (0, 1), (1, 1) of z_t's covariance, each of times' shape.

    With F = e I + o C, F P F^T = e^2 P + e o (C P + P C^T) + o^2 C P C^T.
    """
    even, odd, centred = _exponential_2d(drift, times)
    stationary = stationary_covariance(drift, diffusion)
    mixed = centred @ stationary
    parts = torch.stack([stationary, -(mixed + mixed.mT), -mixed @ centred.mT], dim=-1)
    powers = torch.stack([1 - even**2, even * odd, odd**2], dim=1)
    a, b, _, c = torch.bmm(parts.flatten(1, 2), powers).unbind(1)
    floor = _floor(stationary)
    return a + floor, b, c + floor


def _white_2d(residual: Tensor, a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Log density of N(0, [[a, b], [b, c]]), entries (m, n), at (m, 2, n) or (m, 2, n, p).

    By the Cholesky factor: the squares cannot become negative by rounding.
    """
    first = torch.sqrt(a)
    slope = b / a
    second = torch.sqrt(c - b * slope)
    log_det = torch.log(first * second)
    x, y = residual[:, 0], residual[:, 1]
    shape = (*a.shape, *[1] * (x.dim() - a.dim()))
    first, slope, second, log_det = (
        v.to(residual.dtype).view(shape) for v in (1 / first, slope, 1 / second, log_det)
    )
    square = (x * first).square() + ((y - slope * x) * second).square()
    return -0.5 * square - log_det - math.log(2 * math.pi)


def _apply(matrices: Tensor, z: Tensor) -> Tensor:
    """Matrices (m, n, d, d) times states (m, d, n) or (m, d, n, p)."""
    return torch.einsum("mnij,mjn...->min...", matrices, z)


def _white(residual: Tensor, covariance: Tensor) -> Tensor:
    """Log density of N(0, covariance (m, n, d, d)) at (m, d, n) or (m, d, n, p)."""
    d = covariance.shape[-1]
    lower = torch.linalg.cholesky(covariance)
    eye = torch.eye(d, dtype=lower.dtype, device=lower.device)
    inverse = torch.linalg.solve_triangular(lower, eye.expand_as(lower), upper=False)
    log_det = lower.diagonal(dim1=-2, dim2=-1).log().sum(-1) + d / 2 * math.log(2 * math.pi)
    square = _apply(inverse.to(residual.dtype), residual).square().sum(1)
    log_det = log_det.to(residual.dtype)
    return -0.5 * square - log_det.view(*log_det.shape, *[1] * (square.dim() - log_det.dim()))
