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

from iflow_gym.baselines.imitation_flow.planar import Propagate, TransitionLogProb

MIN_NOISE = 1e-4
"""Least diffusion per square root of the duration: keeps covariances invertible."""

INITIAL_DECAY = 3.0
"""The latent state falls to exp(-3) = 5 % within a demonstration's duration at the start."""

INITIAL_NOISE = 0.3


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
        drift: Tensor = _Drift.apply(self.factor, self.skew, self.min_decay)
        return drift

    def diffusion(self) -> Tensor:
        """Return K K^T, shape (m, d, d)."""
        return torch.diag_embed((MIN_NOISE + torch.exp(self.log_noise)) ** 2)

    def propagate(self, z: Tensor, times: Tensor) -> Tensor:
        """Return exp(A t) z. In the plane no matrix is built for a point."""
        drift = self.drift()
        if z.shape[1] == 2:
            return Propagate.apply(drift, _by_horizon(z, times), times).view(z.shape)
        return _apply(propagator(drift, times), z)

    def transition_log_prob(self, z0: Tensor, z1: Tensor, times: Tensor) -> Tensor:
        """Return log N(z1 | F z0, P - F P F^T), (m, n) or (m, q, p)."""
        drift, noise = self.drift(), self.diffusion()
        if z0.shape[1] == 2:
            before, after = _by_horizon(z0, times), _by_horizon(z1, times)
            found = TransitionLogProb.apply(drift, noise, before, after, times)
            return found.view(z0[:, 0].shape)
        residual = z1 - _apply(propagator(drift, times), z0)
        precise = drift.double(), noise.double(), times.double()
        return _white(residual, transition(*precise)[1])

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


class _Drift(torch.autograd.Function):
    """A = -(L L^T + eps I) + S - S^T, as one node."""

    @staticmethod
    def forward(ctx: Any, factor: Tensor, skew: Tensor, min_decay: float) -> Tensor:
        lower = torch.tril(factor)
        ctx.save_for_backward(lower)
        drift = skew - skew.mT - torch.bmm(lower, lower.mT)
        drift.diagonal(dim1=-2, dim2=-1).sub_(min_decay)
        return drift

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor | None, ...]:
        (lower,) = ctx.saved_tensors
        return -torch.tril(torch.bmm(g + g.mT, lower)), g - g.mT, None


def propagator(drift: Tensor, times: Tensor) -> Tensor:
    """exp(A t) for A (m, d, d) and times (m, ...): shape (m, ..., d, d)."""
    flat, d = times.flatten(1), drift.shape[-1]
    if d == 2:
        eye = torch.eye(d, dtype=drift.dtype, device=drift.device)
        columns = eye[:, None].expand(*flat.shape[:1], d, flat.shape[1], d)
        result = Propagate.apply(drift, columns, flat).transpose(1, 2)
    else:
        result = torch.linalg.matrix_exp(drift[:, None] * flat[..., None, None])
    return result.unflatten(1, times.shape[1:])


def stationary_covariance(drift: Tensor, diffusion: Tensor) -> Tensor:
    """P with A P + P A^T + K K^T = 0, all (m, d, d), by the vectorised linear system.

    In the plane by its solution, a sum of two positive terms (see `planar`).
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


def _by_horizon(z: Tensor, times: Tensor) -> Tensor:
    """Return states as (m, d, q, p) for times (m, q)."""
    return z if z.dim() > times.dim() + 1 else z[..., None]


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
