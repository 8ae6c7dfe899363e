"""How long a round of a recording takes: the start of the latent rate b, and each one's tempo.

Paper, sec. IV-B and IV-C: the main frequency of the Fourier transform of the recordings along their
first principal axis is the initial angular velocity. Two things are added here, since a line of the
spectrum is as wide as one over the recording, and may be a harmonic of the rounds:

- Which harmonic it is, the period says that the demonstrations come with: an eight goes along its
  long axis twice a round, a rosette turns several times.
- Close to that frequency, the period is the shift at which the recording is nearest to itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from iflow_gym.demonstrations import FloatArray

N_SPECTRUM = 16
"""The spectrum is sampled so many times as finely as the recording's length gives."""

SHORTEST = 8
"""Samples of a recording whose period is looked for."""

LEAST_ROUNDS = 1.5
"""Shorter recordings say nothing of their period: a second round has to be there to compare."""

NEAR = 0.25
"""How far from the main frequency's period the period may be, as a fraction of it."""


def main_frequency(path: FloatArray) -> float:
    """Return the main frequency of samples (T,), per sample, by the periodogram with a Hann window.

    Below two rounds in T samples there is no line to be told from the mean: it is not looked for.
    """
    n = len(path)
    window = np.hanning(n)
    centred = path - np.average(path, weights=window)
    power = np.abs(np.fft.rfft(window * centred, N_SPECTRUM * n)) ** 2
    least = math.ceil(LEAST_ROUNDS * N_SPECTRUM)
    return float(least + power[least:].argmax()) / (N_SPECTRUM * n)


def periods(paths: Sequence[FloatArray], given: Sequence[float]) -> list[float | None]:
    """Return the period of each recording (T, d) of a motion in samples; None for one too short.

    The first axis is the one of largest spread. Which harmonic of the rounds the main frequency is,
    is a matter of the motion's shape: the recordings' median tells, by the period of each that is
    `given` in samples.
    """
    long = [i for i, path in enumerate(paths) if len(path) >= SHORTEST]
    found = [max(1.0, round(given[i] * main_frequency(paths[i][:, 0]))) for i in long]
    harmonic = float(np.median(found)) if found else 1.0
    return [_period(path, harmonic) if len(path) >= SHORTEST else None for path in paths]


def _period(path: FloatArray, harmonic: float) -> float | None:
    """Return where the recording is nearest to itself, close to the main frequency's period."""
    middle = harmonic / main_frequency(path[:, 0])
    low, high = math.floor((1 - NEAR) * middle), math.ceil((1 + NEAR) * middle)
    shifts = range(max(low, 2), min(high, math.floor((len(path) - 1) / LEAST_ROUNDS)) + 1)
    apart = np.array([_apart(path, k) for k in shifts])
    at = int(apart.argmin()) if len(apart) else 0
    if not 0 < at < len(apart) - 1:
        return None
    before, least, after = apart[at - 1 : at + 2]
    bend = before - 2 * least + after
    return shifts[at] + (0.5 * float((before - after) / bend) if bend > 0 else 0.0)


def _apart(path: FloatArray, shift: int) -> float:
    """Return the mean squared distance of a recording from itself so many samples later."""
    return float(np.mean(np.sum((path[shift:] - path[:-shift]) ** 2, axis=1)))
