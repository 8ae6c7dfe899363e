"""How long a round of a recording takes: the start of the latent rate b, and each one's tempo.

Paper, sec. IV-B and IV-C: the main frequency of the Fourier transform of the recordings along their
first principal axis is the initial angular velocity. Two things are added here, since a line of the
spectrum is as wide as one over the recording, and may be a harmonic of the rounds:

- Where the motion goes round its centre, the winding number is the number of rounds. Where it does
  not (an S has its centre on its stroke), a harmonic is told by the recording: half a round later
  it is not where it was.
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

CLEAR = 0.3
"""A recording goes round the centre if it stays so far from it, as a fraction of its mean distance:
nearer, the winding number is a matter of chance."""

SAME = 0.25
"""A round later a recording is nearer to itself than this, as a fraction of the mean squared
distance between any two of its samples."""

MOST_HARMONIC = 6
"""The highest harmonic that is looked for."""

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


def winding_number(path: FloatArray) -> float:
    """Return how often samples (T, 2) go round the origin counter-clockwise."""
    turned = np.unwrap(np.arctan2(path[:, 1], path[:, 0]))
    return float(turned[-1] - turned[0]) / (2 * math.pi)


def periods(
    paths: Sequence[FloatArray], given: Sequence[float] | None = None
) -> list[float | None]:
    """Return the period of each recording (T, d) of a motion in samples; None for one too short.

    The origin is the centre, and the first axis the one of largest spread. Which harmonic of the
    rounds is the main one is a matter of the motion's shape: the recordings' median tells. Where a
    period of each recording is `given`, in samples, it is the harmonic that the given ones say: a
    coil, or a rosette, turns several times a round.
    """
    long = [i for i, path in enumerate(paths) if len(path) >= SHORTEST]
    if given is None:
        found = [float(_harmonic(paths[i])) for i in long]
    else:
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


def _harmonic(path: FloatArray) -> int:
    """Return which harmonic of the rounds the main frequency is."""
    n, frequency = len(path), main_frequency(path[:, 0])
    distance = np.linalg.norm(path[:, :2], axis=1)
    if distance.min() > CLEAR * distance.mean():
        rounds = abs(winding_number(path[:, :2]))
        return max(1, round(frequency * (n - 1) / rounds)) if rounds > 1 else 1
    spread = 2 * float(path.var(axis=0).sum())
    for k in range(1, MOST_HARMONIC + 1):
        shift = round(k / frequency)
        if shift > (n - 1) / LEAST_ROUNDS:
            break
        if _apart(path, shift) < SAME * spread:
            return k
    return 1


def _apart(path: FloatArray, shift: int) -> float:
    """Return the mean squared distance of a recording from itself so many samples later."""
    return float(np.mean(np.sum((path[shift:] - path[:-shift]) ** 2, axis=1)))
