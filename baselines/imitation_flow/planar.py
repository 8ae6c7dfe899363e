"""The linear latent system in the plane: closed forms whose gradients are written out.

A step of training asks for a few hundred small numbers of it. As separate operations they cost
autograd a hundred nodes and more time than the flow; here each closed form is one node. The
functions are the same for NumPy, which runs on a CPU, and for torch, which runs on a GPU; `xp` is
the library. What a model has one of, an entry of A or of P, is a `Number`: a float for one model,
(m, 1) for m of them. What it has one of at each of q times is (m, q), and states are
(m, 2, q, p), p points a time.

With A = [[a, b], [c, d]], k = (a + d) / 2, h = (a - d) / 2, C = [[h, b], [c, -h]], s = h^2 + b c,

    exp(A t) = e I + o C,    e = exp(k t) cosh(r t),    o = exp(k t) sinh(r t) / r,    r = sqrt(s),

cosine and sine for s < 0. The stationary covariance P is a sum of two positive terms (Gardiner,
"Handbook of Stochastic Methods", on the multivariate Ornstein-Uhlenbeck process),

    P = (det(A) K K^T + B K K^T B^T) / (-2 tr(A) det(A)),    B = A - tr(A) I,

and that of z_t is P - F P F^T = (1 - e^2) P - e o (M + M^T) - o^2 M C^T with M = C P.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

SMALL_ROOT = 0.03
"""Below it sinh(q) / q is taken from its series, whose next term is 1e-12."""

Array = Any
"""A NumPy array or a torch tensor."""

Number = Any
"""A float, or an array (m, 1)."""


def arrays_of(*tensors: Tensor) -> tuple[Any, list[Array]]:
    """Return the library that a node runs in, and what it takes: NumPy's views on a CPU."""
    if tensors[0].device.type != "cpu":
        return torch, [t.detach() for t in tensors]
    return np, [t.detach().numpy() for t in tensors]


def tensors_of(*arrays: Array) -> tuple[Tensor, ...]:
    """Return a node's arrays as tensors."""
    return tuple(a if isinstance(a, Tensor) else torch.from_numpy(a) for a in arrays)


def _total(xp: Any, x: Array) -> Number:
    """Sum over times."""
    return float(x.sum()) if xp is np and len(x) == 1 else x.sum(-1)[:, None]


def _numbers(xp: Any, x: Array) -> list[Number]:
    """Return the entries of (m, i, j) in their order."""
    if xp is np and len(x) == 1:
        return list(x.ravel().tolist())
    return [x[:, i, j, None] for i in range(x.shape[1]) for j in range(x.shape[2])]


def matrix(xp: Any, like: Array, rows: int, numbers: Sequence[Number]) -> Array:
    """Return numbers as (m, rows, columns), in the precision of an array."""
    if isinstance(numbers[0], float):
        return np.array(numbers, dtype=like.dtype).reshape(1, rows, -1)
    matrix = xp.concatenate(tuple(numbers), 1).reshape(len(numbers[0]), rows, -1)
    return _as(like, matrix)


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
    """e, (m, q)."""
    odd: Array
    """o, (m, q)."""
    drift: list[Number]
    """a, b, c, d."""
    half: Number
    """h."""
    times: Array
    rate: Array
    square: Array
    sinhc: Array
    """o / t."""


def exponential(xp: Any, drift: Array, times: Array) -> Exponential:
    """Return exp(A t) for A (m, 2, 2) and times (m, q)."""
    a, b, c, d = entries = _numbers(xp, drift)
    half = (a - d) / 2
    rate, square = (a + d) / 2 * times, (half * half + b * c) * (times * times)
    even, sinhc = cosh_sinh(xp, rate, square)
    return Exponential(even, sinhc * times, entries, half, times, rate, square, sinhc)


def exponential_gradient(
    xp: Any, e: Exponential, g_even: Array, g_odd: Array, g_centred: Sequence[Number]
) -> list[Number]:
    """Return the gradients of a, b, c, d from those of e, o (m, q) and of h, b, c in C."""
    g_rate, g_square = cosh_sinh_gradient(
        xp, (g_even, g_odd * e.times), (e.even, e.sinhc), e.rate, e.square
    )
    g_k, g_s = _total(xp, g_rate * e.times), _total(xp, g_square * (e.times * e.times))
    (_, b, c, _), (g_h, g_b, g_c) = e.drift, g_centred
    g_h = g_h + 2 * e.half * g_s
    return [(g_k + g_h) / 2, g_b + c * g_s, g_c + b * g_s, (g_k - g_h) / 2]


class Applied(NamedTuple):
    """exp(A t) z, and what its gradient needs, in the precision of z (m, 2, q, p)."""

    reached: Array
    z: Array
    turned: Array
    """C z."""
    even: Array
    """(m, 1, q, 1)."""
    odd: Array
    """(m, 1, q, 1)."""
    centred: Array
    """C, (m, 2, 2)."""


def applied(xp: Any, e: Exponential, z: Array) -> Applied:
    """Return exp(A t) z."""
    even, odd = (_as(z, x)[:, None, :, None] for x in (e.even, e.odd))
    _, b, c, _ = e.drift
    centred = matrix(xp, z, 2, [e.half, b, c, -e.half])
    turned = (centred @ z.reshape(*z.shape[:2], -1)).reshape(z.shape)
    return Applied(even * z + odd * turned, z, turned, even, odd, centred)


def applied_gradient(
    xp: Any, x: Applied, g: Array
) -> tuple[Array, tuple[Array, Array, tuple[Number, ...]]]:
    """Return the gradients of z, and of e, o (m, q) and of h, b, c in C, from exp(A t) z's."""
    scaled = (x.odd * g).reshape(*g.shape[:2], -1)
    back = (x.centred.swapaxes(-1, -2) @ scaled).reshape(g.shape)
    g_even, g_odd = ((g * y).sum(-1).sum(1) for y in (x.z, x.turned))
    corners = scaled @ x.z.reshape(*g.shape[:2], -1).swapaxes(-1, -2)
    first, g_b, g_c, last = _numbers(xp, corners)
    return x.even * g + back, (g_even, g_odd, (first - last, g_b, g_c))


class Propagate(torch.autograd.Function):
    """exp(A t) z for A (m, 2, 2), z (m, 2, q, p) and times (m, q), as one node."""

    @staticmethod
    def forward(ctx: Any, drift: Tensor, z: Tensor, times: Tensor) -> Tensor:
        """Return what is reached from z."""
        xp, (drift_, z_, times_) = arrays_of(drift, z, times)
        e = exponential(xp, drift_, times_)
        x = applied(xp, e, z_)
        ctx.kept = xp, e, x, drift_
        return tensors_of(x.reached)[0]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradients of A and z."""
        xp, e, x, drift = ctx.kept
        _, (g_,) = arrays_of(g)
        g_z, parts = applied_gradient(xp, x, g_)
        g_drift = matrix(xp, drift, 2, exponential_gradient(xp, e, *parts))
        return (*tensors_of(g_drift, g_z), None)


# Transition densities -----------------------------------------------------------------------


class Covariance(NamedTuple):
    """Of z_t, and what its gradient needs."""

    entries: Array
    """(m, 3, q): (0, 0), (0, 1) and (1, 1), the product of the next two."""
    parts: Array
    """(m, 3, 3): those entries of P, of -(M + M^T) and of -M C^T."""
    powers: Array
    """(m, 3, q): 1 - e^2, e o, o^2."""
    stationary: tuple[Number, Number, Number]
    mixed: tuple[Number, Number, Number, Number]
    """M."""
    noise: tuple[Number, Number]
    """The diagonal of K K^T."""


def covariance(xp: Any, e: Exponential, noise: Array) -> Covariance:
    """Return the covariance of z_t | z_0; over short horizons at least its own rounding."""
    n1, _, _, n2 = _numbers(xp, noise)
    (a, b, c, d), h = e.drift, e.half
    det = a * d - b * c
    scale = -2 * (a + d) * det
    p00 = (det * n1 + d * d * n1 + b * b * n2) / scale
    p01 = -(c * d * n1 + a * b * n2) / scale
    p11 = (det * n2 + c * c * n1 + a * a * n2) / scale
    m00, m01 = h * p00 + b * p01, h * p01 + b * p11
    m10, m11 = c * p00 - h * p01, c * p01 - h * p11
    parts = matrix(xp, e.even, 3, [
        p00, -2 * m00, -(m00 * h + m01 * b),
        p01, -(m01 + m10), -(m00 * c - m01 * h),
        p11, -2 * m11, -(m10 * c - m11 * h),
    ])  # fmt: skip
    powers = xp.stack([1 - e.even * e.even, e.even * e.odd, e.odd * e.odd], 1)
    entries = parts @ powers
    floor = 8 * np.finfo(np.float64).eps * xp.maximum(parts[:, 0, :1], parts[:, 2, :1])
    entries[:, 0] += floor
    entries[:, 2] += floor
    return Covariance(entries, parts, powers, (p00, p01, p11), (m00, m01, m10, m11), (n1, n2))


def covariance_gradient(
    xp: Any, e: Exponential, s: Covariance, g: Array
) -> tuple[list[Number], list[Number], tuple[Array, Array, tuple[Number, ...]]]:
    """Take the gradient of the entries, (m, 3, q), back.

    Returns those of a, b, c, d through P, of K K^T's diagonal, and of e, o and of h, b, c in C.
    """
    g_powers = s.parts.swapaxes(-1, -2) @ g
    g_even = e.odd * g_powers[:, 1] - 2 * e.even * g_powers[:, 0]
    g_odd = e.even * g_powers[:, 1] + 2 * e.odd * g_powers[:, 2]
    g00, t00, v00, g01, t01, v01, g11, t11, v11 = _numbers(xp, g @ s.powers.swapaxes(-1, -2))
    (a, b, c, d), h, (n1, n2) = e.drift, e.half, s.noise
    (p00, p01, p11), (m00, m01, m10, m11) = s.stationary, s.mixed
    # C, by -M C^T and by M = C P:
    g_m00 = -(v00 * h + v01 * c + 2 * t00)
    g_m01 = -(v00 * b - v01 * h + t01)
    g_m10 = -(v11 * c + t01)
    g_m11 = v11 * h - 2 * t11
    g_h = -(v00 * m00 - v01 * m01 - v11 * m11)
    g_h = g_h + g_m00 * p00 + (g_m01 - g_m10) * p01 - g_m11 * p11
    g_b = g_m00 * p01 + g_m01 * p11 - v00 * m01
    g_c = g_m10 * p00 + g_m11 * p01 - v01 * m00 - v11 * m10
    # P, whose numerator has the gradient q / scale:
    det = a * d - b * c
    scale = -2 * (a + d) * det
    q00 = (g00 + g_m00 * h + g_m10 * c) / scale
    q01 = (g01 + g_m00 * b + (g_m01 - g_m10) * h + g_m11 * c) / scale
    q11 = (g11 + g_m01 * b - g_m11 * h) / scale
    g_scale = -(q00 * p00 + q01 * p01 + q11 * p11)
    g_det = q00 * n1 + q11 * n2 - 2 * (a + d) * g_scale
    g_trace = -2 * det * g_scale
    g_drift = [
        2 * q11 * a * n2 - q01 * b * n2 + g_trace + g_det * d,
        2 * q00 * b * n2 - q01 * a * n2 - g_det * c,
        2 * q11 * c * n1 - q01 * d * n1 - g_det * b,
        2 * q00 * d * n1 - q01 * c * n1 + g_trace + g_det * a,
    ]
    g_noise = [
        q00 * (det + d * d) - q01 * c * d + q11 * c * c,
        q00 * b * b - q01 * a * b + q11 * (det + a * a),
    ]
    return g_drift, g_noise, (g_even, g_odd, (g_h, g_b, g_c))


class Transition(NamedTuple):
    """log p(z1 | z0), and what its gradient needs."""

    log_prob: Array
    """(m, q, p), in the precision of the states."""
    exponential: Exponential
    covariance: Covariance
    applied: Applied
    whiten: Array
    """(m, 3, q): what the Cholesky factor's inverse is made of."""
    residual: Array
    """(m, 2, q, p): the inverse covariance times z1 - F z0."""


def transition(
    xp: Any, drift: Array, noise: Array, before: Array, after: Array, times: Array
) -> Transition:
    """Return log N(z1 | F z0, P - F P F^T) for z0, z1 (m, 2, q, p) and times (m, q).

    Takes A and a diagonal K K^T (m, 2, 2), and both and the times in float64: the covariance is a
    small difference of large numbers.
    """
    e = exponential(xp, drift, times)
    s = covariance(xp, e, noise)
    x = applied(xp, e, before)
    # The Cholesky factor's inverse W: the squares cannot become negative by rounding.
    slope = s.entries[:, 1] / s.entries[:, 0]
    rest = s.entries[:, 2] - s.entries[:, 1] * slope
    whiten = xp.stack([1 / xp.sqrt(s.entries[:, 0]), slope, 1 / xp.sqrt(rest)], 1)
    shift = xp.log(s.entries[:, 0] * rest) / 2 + math.log(2 * math.pi)
    own, along, other = (_as(before, whiten)[:, i, :, None] for i in range(3))
    u = after - x.reached
    first = u[:, 0] * own
    second = (u[:, 1] - along * u[:, 0]) * other
    u[:, 1] = other * second
    u[:, 0] = own * first - along * u[:, 1]
    log_prob = (first * first + second * second) * -0.5 - _as(before, shift)[:, :, None]
    return Transition(log_prob, e, s, x, whiten, u)


def transition_gradient(
    xp: Any, made: Transition, g: Array
) -> tuple[list[Number], list[Number], Array, Array]:
    """Return the gradients of a, b, c, d, of K K^T's diagonal, of z0 and of z1."""
    _, e, s, x, whiten, u = made
    g_mean = g[:, None] * u
    g_z0, by_mean = applied_gradient(xp, x, g_mean)
    # By the entries: (u u^T - inverse) / 2, summed over the points; (0, 1) stands for two.
    own, along, other = (whiten[:, i] for i in range(3))
    precision = other * other
    inverse = xp.stack(
        [own * own + precision * along * along, -2 * precision * along, precision], 1
    )
    crosses = xp.stack([(g_mean[:, i] * u[:, j]).sum(-1) for i, j in ((0, 0), (0, 1), (1, 1))], 1)
    g_entries = _as(e.even, crosses) / 2
    g_entries[:, 1] *= 2
    g_entries -= _as(e.even, g.sum(-1))[:, None] * inverse / 2
    through, g_noise, (g_even, g_odd, g_centred) = covariance_gradient(xp, e, s, g_entries)
    mean_even, mean_odd, mean_centred = by_mean
    parts = exponential_gradient(
        xp,
        e,
        g_even + _as(e.even, mean_even),
        g_odd + _as(e.even, mean_odd),
        [p + q for p, q in zip(g_centred, mean_centred, strict=True)],
    )
    return [p + q for p, q in zip(parts, through, strict=True)], g_noise, g_z0, -g_mean


class TransitionLogProb(torch.autograd.Function):
    """`transition` for A, K K^T (m, 2, 2), z0, z1 (m, 2, q, p) and times (m, q), as one node."""

    @staticmethod
    def forward(
        ctx: Any, drift: Tensor, noise: Tensor, z0: Tensor, z1: Tensor, times: Tensor
    ) -> Tensor:
        """Return the log density, (m, q, p)."""
        precise = (drift.double(), noise.double(), times.double())
        xp, (drift_, noise_, times_, before, after) = arrays_of(*precise, z0, z1)
        ctx.kept = xp, transition(xp, drift_, noise_, before, after, times_)
        ctx.like = drift.detach()[:0], noise.detach()[:0]
        return tensors_of(ctx.kept[1].log_prob)[0]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradients of A, K K^T, z0 and z1."""
        xp, made = ctx.kept
        _, (g_, drift, noise) = arrays_of(g, *ctx.like)
        g_drift, (first, last), g_z0, g_z1 = transition_gradient(xp, made, g_)
        none = 0 * first
        g_noise = matrix(xp, noise, 2, [first, none, none, last])
        return (*tensors_of(matrix(xp, drift, 2, g_drift), g_noise, g_z0, g_z1), None)


def _as(like: Array, x: Array) -> Array:
    """Return x in the precision of another array."""
    return x.to(like.dtype) if isinstance(x, Tensor) else x.astype(like.dtype, copy=False)
