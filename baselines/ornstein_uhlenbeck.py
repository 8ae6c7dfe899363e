"""Transitions of a stable linear stochastic system, exact over any horizon.

    dz = A z dt + K dB,   D = K Kᵀ,   z_t | z_0 ~ N(F z_0, Q),
    F = exp(A t),   Q = ∫_0^t exp(A s) D exp(A s)ᵀ ds

(van Loan, "Computing integrals involving the matrix exponential", IEEE TAC 23(3), 1978).

Deviation: his block exponential holds exp(-A t), which overflows over a long horizon, where A is
stable. It is taken over a short one, t / 2ⁿ, and doubled n times: F(2 s) = F(s)² and
Q(2 s) = Q(s) + F(s) Q(s) F(s)ᵀ, a sum of positive terms, in which nothing cancels.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg import expm

from iflow_gym.demonstrations import FloatArray


def transition(
    drift: FloatArray, diffusion: FloatArray, time: float
) -> tuple[FloatArray, FloatArray]:
    """Return the propagator F and the covariance Q of z_t | z_0.

    Parameters
    ----------
    drift : array, shape (d, d)
        A, in 1/s (or in any other unit of time).
    diffusion : array, shape (d, d)
        D, symmetric, in length²/s.
    time : float
        t > 0, in s.

    Returns
    -------
    propagator, covariance : arrays, shape (d, d)
    """
    d = len(drift)
    size = float(np.linalg.norm(drift))
    doublings = max(0, math.ceil(math.log2(size) + math.log2(time))) if size > 0 else 0
    # The two blocks are of like size, or scaling and squaring would follow D alone.
    scale = (float(np.abs(diffusion).max()) or 1.0) / (size or 1.0)
    block = np.block([[-drift, diffusion / scale], [np.zeros((d, d)), drift.T]])
    exponential = expm(math.ldexp(time, -doublings) * block)
    propagator = exponential[d:, d:].T
    covariance = propagator @ exponential[:d, d:]
    for _ in range(doublings):
        covariance = covariance + propagator @ covariance @ propagator.T
        propagator = propagator @ propagator
    return propagator, scale * (covariance + covariance.T) / 2
