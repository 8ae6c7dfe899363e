"""Bases of motions that repeat, and the place on an orbit."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from iflow_gym.baselines.bases import normalised
from iflow_gym.demonstrations import FloatArray

OVERLAP = 0.7
"""Value of a basis half way to its neighbour."""


def circular_bases(phase: FloatArray, n_basis: int) -> FloatArray:
    """Return von Mises bases that sum to 1, shape (n, n_basis), of phases in rounds, shape (n,).

    Ijspeert, Nakanishi, Hoffmann, Pastor & Schaal, "Dynamical movement primitives", Neural
    Computation 25(2), 2013, table 1: psi_i = exp(h (cos(2 pi s - c_i) - 1)).
    """
    cosine_and_sine = np.cos(2 * np.pi * phase[:, None] - (0.0, np.pi / 2))
    # cos(2 pi s - c_i) is a product of matrices, and the -1 falls out of the quotient.
    return normalised(cosine_and_sine @ _directions(n_basis))


@lru_cache
def _directions(n_basis: int) -> FloatArray:
    """Return h (cos c_i, sin c_i), shape (2, n_basis)."""
    h = np.log(OVERLAP) / (np.cos(np.pi / n_basis) - 1)
    centres = 2 * np.pi * np.arange(n_basis) / n_basis
    return np.asarray(h * np.stack([np.cos(centres), np.sin(centres)]))


def ridge_regression(features: FloatArray, values: FloatArray, ridge: float) -> FloatArray:
    """Return weights, shape (B, k), of features, shape (n, B), that give values, shape (n, k).

    The penalty is `ridge` a sample, in units of the features' mean square.
    """
    n_features = features.shape[1]
    gram = features.T @ features
    scale = np.trace(gram) / n_features
    gram[np.diag_indices(n_features)] += ridge * n_features * scale
    return np.asarray(np.linalg.solve(gram, features.T @ values))


def nearest_phase(x: FloatArray, orbit: FloatArray) -> FloatArray:
    """Return at which phase, shape (n,), an orbit is nearest to x, shape (n, d).

    The orbit, shape (m, d), is at the phases k / m.
    """
    squares = ((x[:, None] - orbit) ** 2).sum(axis=2)
    return np.asarray(squares.argmin(axis=1) / len(orbit))
