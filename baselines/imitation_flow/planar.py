"""The linear latent system in the plane: closed forms whose gradients are written out.

A step of training asks for a few hundred small numbers of it. As separate operations they cost
autograd a hundred nodes and more time than the flow; here each closed form is one node. The
functions are the same for NumPy, which runs on a CPU, and for torch, which runs on a GPU; `xp` is
the library. Arrays are (m, 2, q, p) with times (m, q): m models, q horizons of p points each.

With k = tr A / 2, C = A - k I and s = -det C,

    exp(A t) = e I + o C,    e = exp(k t) cosh(sqrt(s) t),    o = exp(k t) sinh(sqrt(s) t) / sqrt(s),

cosine and sine for s < 0. The stationary covariance P is a sum of two positive terms (Gardiner,
"Handbook of Stochastic Methods", on the multivariate Ornstein-Uhlenbeck process),

    P = (det(A) D + B D B^T) / (-2 tr(A) det(A)),    B = A - tr(A) I,    D = K K^T,

and that of z_t is P - F P F^T = (1 - e^2) P - e o (C P + P C^T) - o^2 C P C^T.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

SMALL_ROOT = 0.03
"""Below it sinh(q) / q is taken from its series, whose next term is 1e-12."""

Array = Any
"""A NumPy array or a torch tensor."""


def arrays_of(*tensors: Tensor) -> tuple[Any, list[Array]]:
    """Return the library that a node runs in, and what it takes: NumPy's views on a CPU."""
    if tensors[0].device.type != "cpu":
        return torch, [t.detach() for t in tensors]
    return np, [t.detach().numpy() for t in tensors]


def tensors_of(*arrays: Array) -> tuple[Tensor, ...]:
    """Return a node's arrays as tensors."""
    return tuple(a if isinstance(a, Tensor) else torch.from_numpy(a) for a in arrays)


# The exponential ----------------------------------------------------------------------------


def cosh_sinh(xp: Any, rate: Array, square: Array) -> tuple[Array, Array]:
    """Return exp(r) cosh(sqrt s) and exp(r) sinh(sqrt s) / sqrt s, for s of either sign.

    The exponents r + q and r - q are those of A's eigenvalues, so that nothing overflows.
    """
    root = xp.sqrt(xp.abs(square))
    positive, small = square > 0, root < SMALL_ROOT
    if xp is np and positive.all():  # the usual branches, alone
        even, odd = _growing(xp, rate, root)
    elif xp is np and not positive.any():
        even, odd = _turning(xp, rate, root)
    else:
        zero = root * 0
        pairs = zip(
            _growing(xp, rate, xp.where(positive, root, zero)),
            _turning(xp, rate, xp.where(positive, zero, root)),
            strict=True,
        )
        even, odd = (xp.where(positive, grown, turned) for grown, turned in pairs)
    if xp is np and not small.any():
        return even, odd / root
    series = xp.exp(rate) * (1 + square / 6 + square * square / 120)
    return even, xp.where(small, series, odd / xp.where(small, 1.0 + 0 * root, root))


def cosh_sinh_gradient(
    xp: Any, g: tuple[Array, Array], made: tuple[Array, Array], rate: Array, square: Array
) -> tuple[Array, Array]:
    """Return the gradients of r and s: the derivatives by s are o / 2 and (e - o) / (2 s)."""
    (g_even, g_odd), (even, odd) = g, made
    small = xp.abs(square) < SMALL_ROOT**2
    if xp is np and not small.any():
        slope = (even - odd) / (2 * square)
    else:
        by_series = xp.exp(rate) * (1 / 6 + square / 60)
        slope = xp.where(
            small, by_series, (even - odd) / (2 * xp.where(small, 1.0 + 0 * square, square))
        )
    return g_even * even + g_odd * odd, g_even * odd / 2 + g_odd * slope


def _growing(xp: Any, rate: Array, root: Array) -> tuple[Array, Array]:
    decay, less = xp.exp(rate + root), xp.expm1(-2 * root) / 2
    return decay * (1 + less), -decay * less


def _turning(xp: Any, rate: Array, root: Array) -> tuple[Array, Array]:
    decay = xp.exp(rate)
    return decay * xp.cos(root), decay * xp.sin(root)


class Exponential(NamedTuple):
    """exp(A t) = e I + o C, and what its gradient needs."""

    even: Array
    """(m, q)."""
    odd: Array
    """(m, q)."""
    centred: Array
    """C, (m, 2, 2)."""
    drift: Array
    times: Array
    rate: Array
    square: Array
    sinhc: Array
    """o / t."""


def exponential(xp: Any, drift: Array, times: Array) -> Exponential:
    """Return exp(A t) for A (m, 2, 2) and times (m, q)."""
    first, last = drift[:, 0, 0], drift[:, 1, 1]
    half = (first - last) / 2
    root = half * half + drift[:, 0, 1] * drift[:, 1, 0]
    rate = ((first + last) / 2)[:, None] * times
    square = root[:, None] * (times * times)
    even, sinhc = cosh_sinh(xp, rate, square)
    centred = 1 * drift
    centred[:, 0, 0] = half
    centred[:, 1, 1] = -half
    return Exponential(even, sinhc * times, centred, drift, times, rate, square, sinhc)


def exponential_gradient(
    xp: Any, e: Exponential, g_even: Array, g_odd: Array, g_centred: Array
) -> Array:
    """Return the gradient of A, (m, 2, 2), from those of e, o (m, q) and C (m, 2, 2)."""
    g_rate, g_square = cosh_sinh_gradient(
        xp, (g_even, g_odd * e.times), (e.even, e.sinhc), e.rate, e.square
    )
    g_trace = (g_rate * e.times).sum(-1) / 2
    g_root = (g_square * e.times * e.times).sum(-1)
    half = e.centred[:, 0, 0]
    g_half = (g_centred[:, 0, 0] - g_centred[:, 1, 1]) / 2 + half * g_root
    g_drift = 1 * g_centred
    g_drift[:, 0, 0] = g_trace + g_half
    g_drift[:, 1, 1] = g_trace - g_half
    g_drift[:, 0, 1] += e.drift[:, 1, 0] * g_root
    g_drift[:, 1, 0] += e.drift[:, 0, 1] * g_root
    return g_drift


def apply_exponential(e: Exponential, z: Array) -> tuple[Array, Array]:
    """Return exp(A t) z and C z, both (m, 2, q, p)."""
    turned = (e.centred @ z.reshape(*z.shape[:2], -1)).reshape(z.shape)
    return e.even[:, None, :, None] * z + e.odd[:, None, :, None] * turned, turned


def apply_gradient(
    e: Exponential, g: Array, z: Array, turned: Array
) -> tuple[Array, Array, Array, Array]:
    """Return the gradients of z, e, o and C from that of exp(A t) z."""
    scaled = (e.odd[:, None, :, None] * g).reshape(*g.shape[:2], -1)
    flat = z.reshape(*z.shape[:2], -1)
    back = (e.centred.swapaxes(-1, -2) @ scaled).reshape(g.shape)
    g_even, g_odd = ((g * x).sum(-1).sum(1) for x in (z, turned))
    g_z = e.even[:, None, :, None] * g + back
    return g_z, g_even, g_odd, scaled @ flat.swapaxes(-1, -2)


class Propagate(torch.autograd.Function):
    """exp(A t) z for A (m, 2, 2), z (m, 2, q, p) and times (m, q), as one node."""

    @staticmethod
    def forward(ctx: Any, drift: Tensor, z: Tensor, times: Tensor) -> Tensor:
        """Return what is reached from z."""
        xp, (drift_, z_, times_) = arrays_of(drift, z, times)
        e = exponential(xp, drift_, times_)
        reached, turned = apply_exponential(e, z_)
        ctx.kept = xp, e, z_, turned
        return tensors_of(reached)[0]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradients of A and z."""
        xp, e, z, turned = ctx.kept
        _, (g_,) = arrays_of(g)
        g_z, *rest = apply_gradient(e, g_, z, turned)
        return (*tensors_of(exponential_gradient(xp, e, *rest), g_z), None)


# Transition densities -----------------------------------------------------------------------


class Covariance(NamedTuple):
    """Of z_t, by entries (m, q), and what its gradient needs."""

    first: Array
    """(0, 0)."""
    cross: Array
    """(0, 1)."""
    last: Array
    """(1, 1)."""
    stationary: Array
    """P, (m, 2, 2)."""
    mixed: Array
    """C P, (m, 2, 2)."""


def stationary_covariance(drift: Array, noise: Array) -> Array:
    """Return P, (m, 2, 2), for A and K K^T, both (m, 2, 2)."""
    trace, det, other = _invariants(drift)
    spread = other @ noise @ other.swapaxes(-1, -2) + det[:, None, None] * noise
    return spread / (-2 * trace * det)[:, None, None]


def stationary_gradient(g: Array, p: Array, drift: Array, noise: Array) -> tuple[Array, Array]:
    """Return the gradients of A and K K^T, both (m, 2, 2), from that of P; all but A symmetric."""
    trace, det, other = _invariants(drift)
    scale = -2 * trace * det
    g_scale = -(g * p).sum(-1).sum(-1) / scale
    g_spread = g / scale[:, None, None]
    half = g_spread @ other
    g_noise = det[:, None, None] * g_spread + other.swapaxes(-1, -2) @ half
    g_det = (g_spread * noise).sum(-1).sum(-1) - 2 * trace * g_scale
    g_drift = 2 * half @ noise
    g_trace = -2 * det * g_scale - g_drift[:, 0, 0] - g_drift[:, 1, 1]
    g_drift[:, 0, 0] += g_trace + g_det * drift[:, 1, 1]
    g_drift[:, 1, 1] += g_trace + g_det * drift[:, 0, 0]
    g_drift[:, 0, 1] -= g_det * drift[:, 1, 0]
    g_drift[:, 1, 0] -= g_det * drift[:, 0, 1]
    return g_drift, g_noise


def _invariants(drift: Array) -> tuple[Array, Array, Array]:
    """Return tr A, det A (m,) and A - tr(A) I."""
    first, last = drift[:, 0, 0], drift[:, 1, 1]
    other = 1 * drift
    other[:, 0, 0] = -last
    other[:, 1, 1] = -first
    return first + last, first * last - drift[:, 0, 1] * drift[:, 1, 0], other


def covariance(xp: Any, e: Exponential, noise: Array) -> Covariance:
    """Return the covariance of z_t | z_0; over short horizons at least its own rounding."""
    p = stationary_covariance(e.drift, noise)
    mixed = e.centred @ p
    one, two, three = _powers(e)
    both, twice = mixed + mixed.swapaxes(-1, -2), mixed @ e.centred.swapaxes(-1, -2)
    floor = 8 * np.finfo(np.float64).eps * xp.maximum(p[:, 0, 0], p[:, 1, 1])

    def entry(i: int, j: int) -> Array:
        return one * p[:, i, j, None] - two * both[:, i, j, None] - three * twice[:, i, j, None]

    return Covariance(
        entry(0, 0) + floor[:, None], entry(0, 1), entry(1, 1) + floor[:, None], p, mixed
    )


def covariance_gradient(
    xp: Any, e: Exponential, c: Covariance, noise: Array, g: tuple[Array, Array, Array]
) -> tuple[Array, Array, Array, Array, Array]:
    """Return the gradients of A and K K^T through P, and of e, o and C, from those of entries."""
    first, cross, last = g
    p, turn = c.stationary, e.centred.swapaxes(-1, -2)
    both, twice = c.mixed + c.mixed.swapaxes(-1, -2), c.mixed @ turn

    def onto(x: Array) -> Array:
        """<g, x> at each horizon, (m, q)."""
        a, b, d = (x[:, i, j, None] for i, j in ((0, 0), (0, 1), (1, 1)))
        return first * a + cross * b + last * d

    def summed(power: Array) -> Array:
        """Sum over horizons of g times a power, a symmetric matrix (m, 2, 2)."""
        a, b, d = ((x * power).sum(-1) for x in (first, cross / 2, last))
        return xp.stack([a, b, b, d], -1).reshape(-1, 2, 2)

    none, one, two = (summed(power) for power in _powers(e))
    g_p = none - turn @ one - one @ e.centred - turn @ two @ e.centred
    g_centred = -2 * (one @ p) - 2 * (two @ c.mixed)
    on_both = onto(both)
    g_even = -2 * e.even * onto(p) - e.odd * on_both
    g_odd = -e.even * on_both - 2 * e.odd * onto(twice)
    return (*stationary_gradient(g_p, p, e.drift, noise), g_even, g_odd, g_centred)


def _powers(e: Exponential) -> tuple[Array, Array, Array]:
    return 1 - e.even * e.even, e.even * e.odd, e.odd * e.odd


class TransitionLogProb(torch.autograd.Function):
    """log N(z1 | F z0, P - F P F^T), (m, q, p), as one node.

    Takes A and K K^T (m, 2, 2), z0, z1 (m, 2, q, p) and times (m, q). The
    covariance is computed in float64: it is a small difference of large numbers.
    """

    @staticmethod
    def forward(
        ctx: Any, drift: Tensor, noise: Tensor, z0: Tensor, z1: Tensor, times: Tensor
    ) -> Tensor:
        """Return the log density."""
        precise = (drift.double(), noise.double(), times.double())
        xp, (drift_, noise_, times_, before, after) = arrays_of(*precise, z0, z1)
        e = exponential(xp, drift_, times_)
        c = covariance(xp, e, noise_)
        # The Cholesky factor's inverse W: the squares cannot become negative by rounding.
        slope = c.cross / c.first
        rest = c.last - c.cross * slope
        whiten = 1 / xp.sqrt(c.first), slope, 1 / xp.sqrt(rest)
        constant = xp.log(c.first * rest) / 2 + math.log(2 * math.pi)
        e_ = _like(before, e)
        reached, turned = apply_exponential(e_, before)
        first, along, last, shift = (_as(before, v)[:, :, None] for v in (*whiten, constant))
        residual = after - reached
        x, y = residual[:, 0] * first, (residual[:, 1] - along * residual[:, 0]) * last
        u = residual  # becomes S^-1 r = W^T W r
        u[:, 1] = last * y
        u[:, 0] = first * x - along * u[:, 1]
        ctx.kept = xp, e, e_, c, noise_, before, turned, whiten, u
        ctx.precision = drift.dtype, noise.dtype
        return tensors_of((x * x + y * y) * -0.5 - shift)[0]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradients of A, K K^T, z0 and z1."""
        xp, e, e_, c, noise, z0, turned, (first, slope, last), u = ctx.kept
        _, (g_,) = arrays_of(g)
        g_mean = g_[:, None] * u
        g_z0, *rest = apply_gradient(e_, g_mean, z0, turned)
        total = _as(e.even, g_.sum(-1)) / 2
        squares = (
            _as(e.even, x.sum(-1)) / 2
            for x in (g_mean[:, 0] * u[:, 0], g_mean[:, 0] * u[:, 1], g_mean[:, 1] * u[:, 1])
        )
        precision = last * last
        inverse = first * first + precision * slope * slope, -precision * slope, precision
        own, cross, other = (s - total * i for s, i in zip(squares, inverse, strict=True))
        g_drift, g_noise, *parts = covariance_gradient(xp, e, c, noise, (own, 2 * cross, other))
        parts = [_as(e.even, a) + b for a, b in zip(rest, parts, strict=True)]
        g_drift = g_drift + exponential_gradient(xp, e, *parts)
        made = tensors_of(g_drift, g_noise, g_z0, -g_mean)
        return made[0].to(ctx.precision[0]), made[1].to(ctx.precision[1]), *made[2:], None


def _as(like: Array, x: Array) -> Array:
    """Return x in the precision of another array."""
    return x.to(like.dtype) if isinstance(x, Tensor) else x.astype(like.dtype, copy=False)


def _like(z: Array, e: Exponential) -> Exponential:
    """Return e, o and C in the precision of states."""
    return e._replace(even=_as(z, e.even), odd=_as(z, e.odd), centred=_as(z, e.centred))
