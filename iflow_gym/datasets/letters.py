"""Letters traced as closed outlines, round and round: I, R, O and S.

The letters of Urain, Ginesi, Tateo & Peters, "ImitationFlow: Learning deep stable stochastic
dynamic systems by normalizing flows", IROS 2020, written anew by a model of a hand (see
`handwriting`); the authors' own recordings are in `recorded`. An outline never crosses itself, and
so a limit cycle in the plane, the image of a circle, can follow it.

Twenty recordings of four rounds a letter, 100 Hz, letters 100 mm high around the origin. The first
ten are to fit on, the last ten are held out to test on. They are made on call, always the same:
positions are rounded to 0.001 mm, far coarser than what platforms differ by.
"""

from __future__ import annotations

import difflib
from functools import lru_cache

import numpy as np

from iflow_gym.datasets.handwriting import (
    MARGIN,
    Hand,
    Outline,
    Recording,
    central_difference,
    steadier,
    stratified,
    trace,
)
from iflow_gym.demonstrations import Demonstrations

LETTERS = ("I", "R", "O", "S")

N_RECORDINGS = 20
N_HELD_OUT = 10
N_ROUNDS = 4
DT = 0.01
"""Sample time in seconds."""

VERSION = 0
"""Of the numbers; part of the random seed."""

_DECIMALS = 3

_VIA = {
    "I": [
        (15, 0), (23, 6), (28, 22), (31, 45), (33, 68), (32, 87), (24, 98), (16, 100),
        (7, 96), (1, 82), (-1, 60), (-1, 38), (1, 16), (7, 4),
    ],
    "R": [
        (6, 1), (20, 0), (33, 3), (37, 14), (38, 28), (43, 39), (52, 39), (60, 28), (68, 13),
        (78, 2), (90, 1), (99, 6), (100, 16), (92, 31), (81, 44), (70, 55), (71, 62), (82, 68),
        (96, 76), (102, 88), (96, 97), (80, 100), (55, 100), (30, 100), (12, 98), (4, 88),
        (1, 66), (0, 44), (-1, 20), (1, 7),
    ],
    "O": [
        (46, 0), (66, 3), (84, 15), (94, 36), (94, 62), (85, 84), (68, 96), (48, 100),
        (28, 97), (10, 86), (0, 65), (0, 40), (8, 17), (24, 4),
    ],
    "S": [
        (6, 3), (24, 1), (48, -1), (72, 1), (92, 10), (98, 26), (91, 42), (74, 54), (56, 60),
        (52, 66), (60, 72), (78, 74), (94, 79), (99, 90), (88, 98), (68, 101), (44, 100),
        (24, 93), (13, 78), (15, 62), (30, 49), (44, 40), (47, 30), (38, 25), (20, 25),
        (5, 22), (-1, 12),
    ],
}  # fmt: skip
"""Via points, anticlockwise, in mm from the left foot."""

_PERIODS = {"I": 0.8, "R": 2.6, "O": 0.75, "S": 1.0}
"""Usual duration of a round in seconds."""

_DRAWS = {("R", 6): 1, ("R", 11): 1, ("R", 17): 1, ("S", 6): 2}
"""Recordings drawn again, so many times: in the draws before, a round's end crossed its start."""

HAND = Hand()

_VARIATION = {"I": 0.65, "R": 1.1, "O": 0.7, "S": 0.92}
"""How much the path varies, of what `HAND`'s does: simple letters are traced more steadily."""


def outline(letter: str) -> Outline:
    """Return the letter that the hand has in mind, centred at the origin, in mm."""
    via = np.array(_VIA[_known(letter)], dtype=np.float64)
    return Outline(via - (via.min(axis=0) + via.max(axis=0)) / 2, HAND)


def load_letter(letter: str) -> Demonstrations:
    """Return the twenty recordings of a letter, the last ten of them held out.

    Parameters
    ----------
    letter : str
        One of `LETTERS`.

    Returns
    -------
    Demonstrations
        20 recordings, shape (T_i, 2) in mm at 100 Hz, each of four rounds from anywhere on the
        outline, anticlockwise. The period is the mean duration of a round of the first ten.

    Raises
    ------
    ValueError
        If the letter is unknown.
    """
    return _load(_known(letter))


def recordings(letter: str) -> list[Recording]:
    """Return what the hand did in full precision, with the phase of each sample in rounds."""
    shape, hand = outline(letter), steadier(HAND, _VARIATION[letter])
    parts = (N_RECORDINGS - N_HELD_OUT, N_HELD_OUT)
    tempos = [
        tempo
        for k, n in enumerate(parts)
        for tempo in stratified(n, (ord(letter), VERSION, N_RECORDINGS + k))
    ]
    return [
        trace(
            shape,
            hand,
            period=_PERIODS[letter],
            n_rounds=N_ROUNDS,
            dt=DT,
            tempo=tempos[i],
            seed=(ord(letter), VERSION, i, _DRAWS.get((letter, i), 0)),
        )
        for i in range(N_RECORDINGS)
    ]


@lru_cache(maxsize=len(LETTERS))
def _load(letter: str) -> Demonstrations:
    made = recordings(letter)
    rounded = [np.round(r.positions, _DECIMALS) for r in made]
    inner = slice(MARGIN, -MARGIN)
    durations = [
        np.interp(r.phases[MARGIN] + N_ROUNDS, r.phases, DT * np.arange(len(r.phases)))
        - MARGIN * DT
        for r in made[: N_RECORDINGS - N_HELD_OUT]
    ]
    return Demonstrations.from_arrays(
        [p[inner] for p in rounded],
        dt=DT,
        velocities=[np.round(central_difference(p, DT), _DECIMALS) for p in rounded],
        period=round(float(np.mean(durations)) / N_ROUNDS, 6),
        held_out=N_HELD_OUT,
        name=f"Letter-{letter}",
        length_unit="mm",
        source=f"iflow_gym.datasets.letters, version {VERSION}",
    )


def _known(letter: str) -> str:
    if letter not in LETTERS:
        close = difflib.get_close_matches(str(letter).upper(), LETTERS, n=1)
        hint = f" Did you mean {close[0]!r}?" if close else ""
        raise ValueError(f"Unknown letter {letter!r}.{hint} Known: {', '.join(LETTERS)}.")
    return letter
