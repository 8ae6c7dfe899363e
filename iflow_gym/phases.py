"""The phases that the recordings of a motion that repeats have in common.

Recordings begin anywhere on the cycle and drift in tempo. Each is cut into rounds by itself
(`iflow_gym.rounds`), which leaves an offset between them: the circular shift at which a recording's
mean round lies closest to the first one's. The first recording begins at phase 0.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.rounds import LEAST_ROUNDS, LEAST_SAMPLES, phases

GRID = 256
"""Phases at which mean rounds are compared."""


@lru_cache(maxsize=64)
def common_phases(demonstrations: Demonstrations) -> tuple[FloatArray, ...]:
    """Return each recording's phases in rounds, shape (T_i,), increasing, aligned to the first's.

    A recording that is shorter than about 1.3 rounds is taken to keep the set's period.

    Raises
    ------
    ValueError
        If the demonstrations end at a goal, or have too few samples a round.
    """
    if demonstrations.period is None:
        raise ValueError(
            f"Expected a motion that repeats, got {demonstrations.name!r}, which ends at a goal."
        )
    own = [
        _own_phases(p, dt, demonstrations.period, i)
        for i, (p, dt) in enumerate(zip(demonstrations.positions, demonstrations.dt, strict=True))
    ]
    rounds = [_mean_round(u, p) for u, p in zip(own, demonstrations.positions, strict=True)]
    first = rounds[0] - rounds[0].mean(axis=0)
    aligned = []
    for u, curve in zip(own, rounds, strict=True):
        # curve(s - offset) is closest to first(s) where their correlation is greatest.
        spectrum = np.fft.fft(first, axis=0) * np.conj(np.fft.fft(curve, axis=0))
        correlation = np.fft.ifft(spectrum, axis=0).real.sum(axis=1)
        aligned.append(np.asarray(u + _peak(correlation)))
    return tuple(aligned)


def _own_phases(positions: FloatArray, dt: float, period: float, index: int) -> FloatArray:
    samples = period / dt
    if samples < LEAST_SAMPLES:
        raise ValueError(
            f"Expected at least {LEAST_SAMPLES} samples a period of {period:g} s, got a sample "
            f"time of {dt:g} s in recording {index}: check the period's unit."
        )
    if samples * LEAST_ROUNDS > len(positions):
        return np.arange(len(positions)) / samples
    return phases(positions, dt, period)


def _mean_round(phase: FloatArray, positions: FloatArray) -> FloatArray:
    """Return the mean position at each of GRID phases, shape (GRID, d), round the cycle."""
    cells = np.floor((phase % 1.0) * GRID).astype(np.intp) % GRID
    counts = np.bincount(cells, minlength=GRID)
    filled = np.flatnonzero(counts)
    columns = [
        np.interp(
            np.arange(GRID),
            filled,
            (np.bincount(cells, column, GRID) / np.maximum(counts, 1))[filled],
            period=GRID,
        )
        for column in positions.T
    ]
    return np.stack(columns, axis=1)


def _peak(correlation: FloatArray) -> float:
    """Return where a periodic function on the grid is greatest, in rounds, between samples too."""
    k = int(correlation.argmax())
    before, here, after = correlation[[k - 1, k, (k + 1) % GRID]]
    bend = before - 2 * here + after
    between = 0.5 * (before - after) / bend if bend < 0 else 0.0
    return float((k + between) / GRID)
