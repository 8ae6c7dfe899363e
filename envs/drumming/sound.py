r"""What hits sound like: each drum an ideal membrane that is struck off its centre.

The modes of a round membrane of radius a have the frequencies

    f_mn = f_01 j_mn / j_01,

j_mn the n-th zero of the Bessel function J_m, and a stroke at the distance r from the centre
excites them as J_m(j_mn r / a) (Kinsler, Frey, Coppens and Sanders, *Fundamentals of Acoustics*,
4th ed., sec. 4.4). The higher a mode, the sooner it has died away. A hit is as loud as it is hard.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from scipy.io import wavfile
from scipy.special import jn_zeros, jv

from iflow_gym.datasets.drums import DRUMS, Drum
from iflow_gym.demonstrations import FloatArray
from iflow_gym.metrics.drumming import Hit

RATE: Final = 16_000
"""Samples a second."""

HIGHEST: Final = 150.0
"""f_01 in Hz of the first drum; each further one is a fourth lower."""
FOURTH: Final = 3 / 4

STRUCK_AT: Final = 0.4
"""r / a."""
DIAMETERS, CIRCLES = 6, 4
"""Modes that are heard: m below the first, n up to the second."""

DECAY: Final = 0.25
"""Seconds in which the lowest mode falls to 1/e; one of k times its frequency takes 1/k of it."""

RINGS: Final = 1.5
"""Seconds after which nothing is left of a hit."""

LOUDEST: Final = 0.9
"""Of full scale: the greatest sample of all."""


def sound(
    hits: Iterable[Hit], drums: Sequence[Drum] = DRUMS, seconds: float | None = None
) -> FloatArray:
    """Return the sound of hits, at `RATE`.

    Parameters
    ----------
    hits : iterable of Hit
        As ``info["hits"]`` has them.
    drums : sequence of Drum
        What is hit; a drum on the right (y < 0) is heard there.
    seconds : float, optional
        Length; None lets the last hit ring out.

    Returns
    -------
    array, shape (n, 2)
        Left and right, in [-1, 1]; silence without hits.

    Raises
    ------
    ValueError
        For a length that is not positive, or a hit of a drum that there is not.
    """
    played = sorted(hits)
    if strange := sorted({hit.drum for hit in played} - set(range(len(drums)))):
        raise ValueError(f"Expected hits of drums 0 to {len(drums) - 1}, got some of {strange}.")
    last = played[-1].time if played else 0.0
    length = last + RINGS if seconds is None else seconds
    if not (np.isfinite(length) and length > 0):
        raise ValueError(f"Expected seconds > 0, got {length}.")
    heard = np.zeros((round(length * RATE), 2))
    voices = [_voice(HIGHEST * FOURTH**i) for i in range(len(drums))]
    for hit in played:
        begin = round(hit.time * RATE)
        part = heard[begin : begin + len(voices[hit.drum])]
        left = 0.5 + np.clip(drums[hit.drum].head[1], -0.3, 0.3)
        part += hit.force * voices[hit.drum][: len(part), None] * np.sqrt([left, 1.0 - left])
    loudest = float(np.abs(heard).max(initial=0.0))
    return heard * (LOUDEST / loudest) if loudest > 0 else heard


def write_sound(
    path: str | Path,
    hits: Iterable[Hit],
    drums: Sequence[Drum] = DRUMS,
    seconds: float | None = None,
) -> Path:
    """Write the `sound` of hits as a WAV file, 16 bits a sample, and return its path."""
    file = Path(path)
    if file.suffix.lower() != ".wav":
        raise ValueError(f"Expected a file that ends with .wav, got {str(path)!r}.")
    samples = np.round(32767 * sound(hits, drums, seconds)).astype(np.int16)
    wavfile.write(file, RATE, samples)
    return file


def _voice(lowest: float) -> FloatArray:
    """Return the sound of a stroke of 1 N, shape (n,), of a drum with f_01 in Hz."""
    time = np.arange(round(RINGS * RATE)) / RATE
    first = float(jn_zeros(0, 1)[0])
    voice = np.zeros_like(time)
    for m in range(DIAMETERS):
        for zero in jn_zeros(m, CIRCLES).tolist():
            ratio = zero / first
            amount = float(jv(m, zero * STRUCK_AT))
            ringing = np.exp(-time * ratio / DECAY) - np.exp(-time / 1e-3)  # no click
            voice += amount * ringing * np.sin(2 * np.pi * ratio * lowest * time)
    return voice
