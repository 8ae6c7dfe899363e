"""The latent system dz = A z dt + K dB, stable for every value of its parameters.

A = -(L L^T + eps I) + (S - S^T), so that d|z|^2/dt = -2 z^T (L L^T + eps I) z < 0 and U(z) = |z|^2
is a Lyapunov function of the mean. Transitions over any horizon t are closed forms (paper, sec.
III-B, which has their Euler steps):

    z_t | z_0 ~ N(F z_0, P - F P F^T),    F = exp(A t),    A P + P A^T + K K^T = 0,

where P is the stationary covariance. K is diagonal and at least `MIN_NOISE`.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

MIN_NOISE = 1e-4
"""Least diffusion per square root of the duration: keeps covariances invertible."""

INITIAL_DECAY = 3.0
"""The latent state falls to exp(-3) = 5 % within a demonstration's duration at the start."""

INITIAL_NOISE = 0.3


class LinearLatent(nn.Module):
    """`n_models` stable linear stochastic systems of dimension d; time in durations."""

    def __init__(self, n_models: int, n_dims: int, *, min_decay: float) -> None:
        super().__init__()
        self.min_decay = min_decay
        start = math.sqrt(INITIAL_DECAY - min(min_decay, 0.9 * INITIAL_DECAY))
        self.factor = nn.Parameter(start * torch.eye(n_dims).repeat(n_models, 1, 1))
        self.skew = nn.Parameter(torch.zeros(n_models, n_dims, n_dims))
        self.log_noise = nn.Parameter(torch.full((n_models, n_dims), math.log(INITIAL_NOISE)))

    def drift(self) -> Tensor:
        """Return A, shape (m, d, d)."""
        lower = torch.tril(self.factor)
        eye = torch.eye(lower.shape[-1], dtype=lower.dtype, device=lower.device)
        return self.skew - self.skew.mT - lower @ lower.mT - self.min_decay * eye

    def diffusion(self) -> Tensor:
        """Return K K^T, shape (m, d, d)."""
        return torch.diag_embed((MIN_NOISE + torch.exp(self.log_noise)) ** 2)


def propagator(drift: Tensor, times: Tensor) -> Tensor:
    """exp(A t) for A (m, d, d) and times (m, ...): shape (m, ..., d, d)."""
    flat = times.flatten(1)
    if drift.shape[-1] == 2:
        result = _propagator_2d(drift, flat)
    else:
        result = torch.linalg.matrix_exp(drift[:, None] * flat[..., None, None])
    return result.unflatten(1, times.shape[1:])


def _propagator_2d(drift: Tensor, times: Tensor) -> Tensor:
    """exp(A t) = exp(m t) (cosh(q t) I + sinh(q t) / q (A - m I)), m = tr A / 2, q^2 = m^2 - det A.

    With q^2 < 0 these are cosine and sine; near q = 0 sinh(q t) / q is taken from its series.
    """
    mean = drift.diagonal(dim1=-2, dim2=-1).mean(-1)
    eye = torch.eye(2, dtype=drift.dtype, device=drift.device)
    centred = drift - mean[:, None, None] * eye
    q2 = -torch.linalg.det(centred)[:, None]
    square = q2 * times**2
    small = square.abs() < 1e-4
    root = torch.where(small, torch.ones_like(square), square.abs()).sqrt()
    positive = square > 0
    # The branch not taken must stay finite, or its gradient is NaN.
    grown = torch.where(positive, root, torch.ones_like(root))
    turned = torch.where(positive, torch.ones_like(root), root)
    even = torch.where(positive, torch.cosh(grown), torch.cos(turned))
    odd = torch.where(positive, torch.sinh(grown) / grown, torch.sin(turned) / turned)
    even = torch.where(small, 1 + square / 2, even)
    odd = torch.where(small, 1 + square / 6, odd)
    decay = torch.exp(mean[:, None] * times)
    return (decay * even)[..., None, None] * eye + (decay * odd * times)[..., None, None] * centred[
        :, None
    ]


def stationary_covariance(drift: Tensor, diffusion: Tensor) -> Tensor:
    """P with A P + P A^T + K K^T = 0, all (m, d, d), by the vectorised linear system."""
    d = drift.shape[-1]
    eye = torch.eye(d, dtype=drift.dtype, device=drift.device)
    left = torch.einsum("mij,kl->mikjl", drift, eye).reshape(-1, d * d, d * d)
    right = torch.einsum("ij,mkl->mikjl", eye, drift).reshape(-1, d * d, d * d)
    solved = torch.linalg.solve(left + right, -diffusion.reshape(-1, d * d, 1))
    covariance = solved.reshape(-1, d, d)
    return (covariance + covariance.mT) / 2


def transition(drift: Tensor, diffusion: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
    """Propagator and covariance of z_t | z_0 for times (m, n): two tensors (m, n, d, d)."""
    forward = propagator(drift, times)
    stationary = stationary_covariance(drift, diffusion)[:, None]
    covariance = stationary - forward @ stationary @ forward.mT
    # For short horizons the difference cancels to rounding errors, which may be negative.
    floor = torch.finfo(drift.dtype).eps * stationary.diagonal(dim1=-2, dim2=-1).amax(-1)
    eye = torch.eye(drift.shape[-1], dtype=drift.dtype, device=drift.device)
    return forward, (covariance + covariance.mT) / 2 + 8 * floor[..., None, None] * eye


def gaussian_log_prob(residual: Tensor, covariance: Tensor) -> Tensor:
    """Log density of N(0, covariance) at residual (..., d): shape (...)."""
    d = residual.shape[-1]
    if d == 2:
        a, b, c = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
        det = a * c - b * b
        x, y = residual[..., 0], residual[..., 1]
        square = (c * x * x - 2 * b * x * y + a * y * y) / det
        log_det = torch.log(det)
    else:
        lower = torch.linalg.cholesky(covariance)
        white = torch.linalg.solve_triangular(lower, residual[..., None], upper=False)
        square = white.square().sum((-1, -2))
        log_det = 2 * lower.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return -0.5 * (square + log_det + d * math.log(2 * math.pi))
