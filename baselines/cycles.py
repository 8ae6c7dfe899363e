"""Motions that repeat: phases of recordings that each begin somewhere on the cycle, and bases.

A recording's phase is its time in periods plus an offset. The first recording's offset is 0, every
other's is the circular shift at which its mean round lies closest to the first's: recordings may
begin anywhere on the cycle.
"""

from __future__ import annotations

import numpy as np

from iflow_gym.demonstrations import Demonstrations, FloatArray

GRID = 256
"""Phases at which mean rounds are compared."""

OVERLAP = 0.7
"""Value of a basis half way to its neighbour."""

RIDGE = 1e-8
"""Of regressions on the bases, per sample: phases that no sample has leave them undetermined."""


def circular_bases(phase: FloatArray, n_basis: int) -> FloatArray:
    """Return von Mises bases that sum to 1, shape (n, n_basis), of phases in rounds, shape (n,).

    Ijspeert, Nakanishi, Hoffmann, Pastor & Schaal, "Dynamical movement primitives", Neural
    Computation 25(2), 2013, table 1: psi_i = exp(h (cos(2 pi s - c_i) - 1)).
    """
    half = np.pi / n_basis
    h = np.log(OVERLAP) / (np.cos(half) - 1)
    centres = 2 * np.pi * np.arange(n_basis) / n_basis
    activations = np.exp(h * (np.cos(2 * np.pi * phase[:, None] - centres) - 1))
    return np.asarray(activations / activations.sum(axis=1, keepdims=True))


def ridge_regression(features: FloatArray, values: FloatArray, ridge: float) -> FloatArray:
    """Return weights, shape (B, k), of features, shape (n, B), that give values, shape (n, k).

    The penalty is `ridge` a sample, in units of the features' mean square.
    """
    n_features = features.shape[1]
    gram = features.T @ features
    scale = np.trace(gram) / n_features
    gram[np.diag_indices(n_features)] += ridge * n_features * scale
    return np.asarray(np.linalg.solve(gram, features.T @ values))


def phases(demonstrations: Demonstrations, n_basis: int) -> list[FloatArray]:
    """Return each recording's phases in rounds, shape (T_i,), aligned to the first recording.

    Raises
    ------
    ValueError
        If a recording has fewer samples a round than four, too few to say what the round is.
    """
    period = demonstrations.period
    assert period is not None
    times = [demonstrations.times(i) / period for i in range(len(demonstrations))]
    for i, t in enumerate(times):
        if t[1] > 0.25:
            raise ValueError(
                f"Expected at least 4 samples a period of {period:g} s, got a sample time of "
                f"{demonstrations.dt[i]:g} s in recording {i}: check the period's unit."
            )
    grid = circular_bases(np.arange(GRID) / GRID, n_basis)
    mean_rounds = [
        grid @ ridge_regression(circular_bases(t, n_basis), p, RIDGE)
        for t, p in zip(times, demonstrations.positions, strict=True)
    ]
    first = mean_rounds[0] - mean_rounds[0].mean(axis=0)
    aligned = []
    for t, curve in zip(times, mean_rounds, strict=True):
        # curve(s - offset) is closest to first(s) where their correlation is greatest.
        spectrum = np.fft.fft(first, axis=0) * np.conj(np.fft.fft(curve, axis=0))
        correlation = np.fft.ifft(spectrum, axis=0).real.sum(axis=1)
        aligned.append(t + _peak(correlation))
    return aligned


def _peak(correlation: FloatArray) -> float:
    """Return where a periodic function on the grid is greatest, in rounds, between samples too."""
    k = int(correlation.argmax())
    before, here, after = correlation[[k - 1, k, (k + 1) % GRID]]
    bend = before - 2 * here + after
    between = 0.5 * (before - after) / bend if bend < 0 else 0.0
    return float((k + between) / GRID)


def nearest_phase(x: FloatArray, orbit: FloatArray) -> FloatArray:
    """Return at which phase, shape (n,), an orbit is nearest to x, shape (n, d).

    The orbit, shape (m, d), is at the phases k / m.
    """
    squares = ((x[:, None] - orbit) ** 2).sum(axis=2)
    return np.asarray(squares.argmin(axis=1) / len(orbit))
