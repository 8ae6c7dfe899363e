"""Simulation of an Ito equation dz = f(z) dt + g(z) dB by Euler-Maruyama (Kloeden & Platen 1992).

Strong order 1/2 and weak order 1: for g that depend on the state, where there is no closed form,
and as an oracle for those that have one.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from iflow_gym.demonstrations import FloatArray

StateFunction = Callable[[FloatArray], FloatArray]


def euler_maruyama(
    drift: StateFunction,
    diffusion: StateFunction,
    z: FloatArray,
    t: float,
    n_substeps: int,
    rng: np.random.Generator,
) -> FloatArray:
    """Return a draw of the state after t from each of z (n, d).

    Parameters
    ----------
    drift, diffusion : callables
        f and g, from states (n, d) to (n, d) and to (n, d, d).
    t : float
        The horizon, in the drift's unit of time, taken in n_substeps >= 1 equal steps.
    """
    if n_substeps < 1:
        raise ValueError(f"expected n_substeps >= 1, got {n_substeps}")
    step = t / n_substeps
    for _ in range(n_substeps):
        noise = math.sqrt(step) * rng.standard_normal(z.shape)
        z = z + step * drift(z) + np.einsum("nij,nj->ni", diffusion(z), noise)
    return z


def heun(
    drift: StateFunction,
    diffusion: StateFunction,
    z: FloatArray,
    t: float,
    n_substeps: int,
    rng: np.random.Generator,
) -> FloatArray:
    """Return a draw of the Stratonovich equation dz = f dt + g o dB; arguments as above."""
    if n_substeps < 1:
        raise ValueError(f"expected n_substeps >= 1, got {n_substeps}")
    step = t / n_substeps
    for _ in range(n_substeps):
        noise = math.sqrt(step) * rng.standard_normal(z.shape)
        rate = drift(z)
        kick = np.einsum("nij,nj->ni", diffusion(z), noise)
        ahead = z + step * rate + kick
        kick = kick + np.einsum("nij,nj->ni", diffusion(ahead), noise)
        z = z + 0.5 * (step * (rate + drift(ahead)) + kick)
    return z
