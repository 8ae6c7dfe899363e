"""The latent limit cycle: a stochastic circle in the plane and decay towards the plane.

Paper, sec. III-D, in polar coordinates of the first two coordinates, with the other ones beside:

    d rho = -a (rho - rho*) dt + s1 dB,    d psi = b dt + s2 dB,    d z_j = -a_j z_j dt + k_j dB,

with a, a_j, rho* > 0 for every value of the parameters (the paper writes +a and constrains it) and
b of either sign. Each line has a closed form over any horizon t: an Ornstein-Uhlenbeck process of
variance s^2 (1 - exp(-2 a t)) / (2 a), and a Brownian phase, on the circle a wrapped normal of
variance s2^2 t. A density in the plane is the polar one times |det d(rho, psi)/d(x, y)| = 1/rho;
the paper prints that Jacobian transposed, which leaves its determinant right.

The radius' normal is on the whole line. A negative radius is the point opposite, |rho| at psi + pi,
so the density of z_t is a sum over both signs, and integrates to one. In z_t the sign is lost: the
process is Markov in the plane up to the probability that the radius changes sign, which is
Phi(-rho* sqrt(2 a) / s1) in the stationary state: 1e-19 for a spread of rho* / 9.

At rho = 0 the direction is undefined and the field jumps; psi is taken as 0 there.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from iflow_gym.baselines.imitation_flow.latent import (
    INITIAL_DECAY,
    INITIAL_NOISE,
    MIN_NOISE,
    Latent,
)

N_WINDINGS = 2
"""Windings to either side of a narrow wrapped normal: those left out are below exp(-30)."""

N_WAVES = 4
"""Fourier terms of a wide one: those left out are below exp(-50)."""

WIDE = 2.0
"""Standard deviation in rad from which a wrapped normal is summed as a Fourier series."""


class LimitCycleLatent(Latent):
    """Stochastic limit cycles (see the module).

    Parameters
    ----------
    n_models, n_dims : int
        n_dims >= 2.
    min_decay : float
        The least a and a_j, per duration.
    """

    def __init__(self, n_models: int, n_dims: int, *, min_decay: float) -> None:
        super().__init__()
        if n_dims < 2:
            raise ValueError(f"expected n_dims >= 2 for a cycle in the plane, got {n_dims}")
        self.min_decay = min_decay
        zeros = torch.zeros(n_models, dtype=torch.float32)  # whatever the process's default is
        self.log_decay = nn.Parameter(zeros.new_zeros(n_models, n_dims - 1))
        self.rate = nn.Parameter(zeros.clone())
        self.log_radius = nn.Parameter(zeros.clone())
        self.log_noise = nn.Parameter(zeros.new_full((n_models, n_dims), math.log(INITIAL_NOISE)))
        self.initialise(2 * math.pi, max(INITIAL_DECAY, 2 * min_decay), 1.0)

    def initialise(
        self, rate: Tensor | float, decay: Tensor | float, radius: Tensor | float
    ) -> None:
        """Set b (rad per duration, of either sign), a = a_j > min_decay and rho* > 0, each (m,).

        Sec. IV-B takes b from the main frequency of the demonstrations' first principal axis.
        """
        rate, decay, radius = (
            torch.as_tensor(v, dtype=self.rate.dtype, device=self.rate.device).expand_as(self.rate)
            for v in (rate, decay, radius)
        )
        if not (rate.isfinite().all() and (decay > self.min_decay).all() and (radius > 0).all()):
            raise ValueError(
                f"expected a finite rate, decay > {self.min_decay} and radius > 0, got {rate}, "
                f"{decay}, {radius}"
            )
        with torch.no_grad():
            self.rate.copy_(rate)
            self.log_decay.copy_(torch.log(decay - self.min_decay)[:, None])
            self.log_radius.copy_(torch.log(radius))

    def decay(self) -> Tensor:
        """Return a of the radius, then a_j of the other coordinates, (m, d - 1)."""
        return self.min_decay + torch.exp(self.log_decay)

    def radius(self) -> Tensor:
        """Return rho*, (m,)."""
        return torch.exp(self.log_radius)

    def noise(self) -> Tensor:
        """Return s1, s2 and k_j, (m, d)."""
        return MIN_NOISE + torch.exp(self.log_noise)

    def propagate(self, z: Tensor, times: Tensor) -> Tensor:
        """Return the mean in polar coordinates, which is where the mean dynamics lead.

        The mean of the plane's coordinates is nearer to the origin, by exp(-s2^2 t / 2).
        """
        radius = _beside(self.radius()[:, None], z)[:, 0]
        times = _beside(times[:, None], z)
        kept = torch.exp(-_beside(self.decay(), z) * times)
        rho, unit = _polar(z)
        cos, sin = self._turn(z, times)
        turned = torch.stack(
            [cos * unit[:, 0] - sin * unit[:, 1], sin * unit[:, 0] + cos * unit[:, 1]], dim=1
        )
        plane = (radius + kept[:, 0] * (rho - radius))[:, None] * turned
        return torch.cat([plane, kept[:, 1:] * z[:, 2:]], dim=1)

    def transition_log_prob(self, z0: Tensor, z1: Tensor, times: Tensor) -> Tensor:
        """Return log p(z_t = z1 | z_0 = z0) in the plane's coordinates, (m, n) or (m, q, p)."""
        return self._conditional(z0, z1, times, backward=False)

    def backward_log_prob(self, z0: Tensor, z1: Tensor, times: Tensor) -> Tensor:
        """Return the reverse under a flat prior on (rho, psi, z_j), (m, n) or (m, q, p).

        rho_0 - rho* and z_j are normal around exp(a t) times those of z1, with exp(2 a t) times
        the variance; psi_0 is wrapped normal around psi_1 - b t.
        """
        return self._conditional(z0, z1, times, backward=True)

    def stationary_log_prob(self, z: Tensor) -> Tensor:
        """Return the log density of a normal radius, a uniform phase and normal z_j, (m, n)."""
        variance = _beside(self._normal_noise() ** 2 / (2 * self.decay()), z)
        rho, _ = _polar(z)
        radius = _beside(self.radius()[:, None], z)[:, 0]
        either = torch.logaddexp(
            _normal(rho - radius, variance[:, 0]), _normal(-rho - radius, variance[:, 0])
        )
        extras = _normal(z[:, 2:], variance[:, 1:]).sum(1)
        return either - math.log(2 * math.pi) + extras - torch.log(rho)

    def arrays(self, model: int) -> dict[str, NDArray[np.float64]]:
        """Return decay (d - 1,), rate (1,), radius (1,) and noise (d,)."""
        with torch.no_grad():
            values = {
                "decay": self.decay()[model],
                "rate": self.rate[model, None],
                "radius": self.radius()[model, None],
                "noise": self.noise()[model],
            }
            return {name: value.double().cpu().numpy() for name, value in values.items()}

    def _normal_noise(self) -> Tensor:
        """s1 and k_j, (m, d - 1): of the coordinates across the cycle."""
        noise = self.noise()
        return torch.cat([noise[:, :1], noise[:, 2:]], dim=1)

    def _turn(self, z: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
        angle = (_beside(self.rate[:, None], z) * times)[:, 0]
        return torch.cos(angle), torch.sin(angle)

    def _conditional(self, z0: Tensor, z1: Tensor, times: Tensor, *, backward: bool) -> Tensor:
        """Sum over both signs of the asked state's radius; the given state's is positive."""
        times = _beside(times[:, None], z0)
        decay = _beside(self.decay(), z0)
        spread = _beside(self._normal_noise(), z0) ** 2
        variance = -spread * torch.expm1(-2 * decay * times) / (2 * decay)
        kept = torch.exp(-decay * times)
        radius = _beside(self.radius()[:, None], z0)[:, 0]
        (rho0, unit0), (rho1, unit1) = _polar(z0), _polar(z1)
        cos, sin = self._turn(z0, times)
        # The phase that is left of unit1 after unit0 has turned by b t.
        along = (unit0 * unit1).sum(1)
        across = unit0[:, 0] * unit1[:, 1] - unit0[:, 1] * unit1[:, 0]
        angle = torch.atan2(across * cos - along * sin, along * cos + across * sin)
        phase_variance = (_beside(self.noise()[:, 1:2], z0) ** 2 * times)[:, 0]

        def sheet(sign: float) -> Tensor:
            before, after = (sign * rho0, rho1) if backward else (rho0, sign * rho1)
            residual = after - radius - kept[:, 0] * (before - radius)
            turned = angle if sign > 0 else angle - math.pi * torch.sign(angle.detach() + 1e-30)
            return _normal(residual, variance[:, 0]) + wrapped_normal(turned, phase_variance)

        extras = _normal(z1[:, 2:] - kept[:, 1:] * z0[:, 2:], variance[:, 1:]).sum(1)
        either = torch.logaddexp(sheet(1.0), sheet(-1.0)) + extras
        if backward:
            return either - (decay * times).sum(1) - torch.log(rho0)
        return either - torch.log(rho1)


def wrapped_normal(angle: Tensor, variance: Tensor) -> Tensor:
    """Log density of a normal wrapped round the circle, at an angle in [-pi, pi].

    Summed over windings where it is narrow and as its Fourier series where it is wide: both are
    exact to rounding where they are used, and neither takes the logarithm of a vanishing sum.
    """
    wide = variance > WIDE**2
    narrow = torch.where(wide, 1.0, variance)
    windings = [
        -(4 * math.pi * k * angle + (2 * math.pi * k) ** 2) / (2 * narrow)
        for k in range(-N_WINDINGS, N_WINDINGS + 1)
    ]
    direct = torch.logsumexp(torch.stack(windings), dim=0) + _normal(angle, narrow)
    broad = torch.where(wide, variance, WIDE**2)
    k = torch.arange(1, N_WAVES + 1, dtype=angle.dtype, device=angle.device)
    waves = torch.exp(-0.5 * k**2 * broad[..., None]) * torch.cos(k * angle[..., None])
    series = torch.log1p(2 * waves.sum(-1)) - math.log(2 * math.pi)
    return torch.where(wide, series, direct)


def _normal(residual: Tensor, variance: Tensor) -> Tensor:
    return -0.5 * (residual.square() / variance + torch.log(2 * math.pi * variance))


def _polar(z: Tensor) -> tuple[Tensor, Tensor]:
    """Return the radius (m, ...) and the direction (m, 2, ...), both finite with gradients.

    At the origin the radius is the square root of the least number, the direction the first axis.
    """
    square = z[:, 0].square() + z[:, 1].square()
    least = torch.finfo(z.dtype).tiny
    origin = (square <= least)[:, None]
    rho = torch.sqrt(square.clamp_min(least))
    axis = torch.zeros_like(z[:, :2])
    axis[:, 0] = 1.0
    return rho, torch.where(origin, axis, z[:, :2] / rho[:, None])


def _beside(values: Tensor, z: Tensor) -> Tensor:
    """Append axes to a parameter (m, k), or to times (m, 1, n), to go with z."""
    return values.view(*values.shape, *[1] * (z.dim() - values.dim()))
