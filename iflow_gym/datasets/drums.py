"""The drum kit and the demonstrations of drumming, recorded in the simulator by a scripted teacher.

The motion is that of the ImitationFlow paper's robot (Urain et al., IROS 2020, sec. IV-D): an arch
between two drums, high over on the way to the right drum, low on the way back, a stroke at either
end. The demonstrations are what the simulated tip of the stick did, not what the teacher wanted;
`iflow_gym.envs.drumming.teacher` made them, and says how.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import Final

import numpy as np

from iflow_gym.demonstrations import Demonstrations

TIP_RADIUS: Final = 0.009
"""Radius of the bead at the end of the stick, in m; the tip is its centre."""


@dataclass(frozen=True)
class Drum:
    """A drum: a level, round head."""

    name: str
    head: tuple[float, float, float]
    """Centre of the head's upper face in m, in the frame of the arm's base: x forward, y to the
    left, z up."""
    radius: float = 0.12
    """Of the head, in m."""


RIGHT: Final = Drum("right", (0.68, -0.14, 0.25))
LEFT: Final = Drum("left", (0.68, 0.14, 0.25))
DRUMS: Final = (RIGHT, LEFT)
"""The kit of `iflow/Drumming-v0`; a hit's `drum` is an index into it."""

FILE: Final = "drums.npz"
SHA256: Final = "d55113f8b0a2c9fe41e4435bfeb79845a5dd38275f406daa7cea6248a4fe1f2e"


@lru_cache(maxsize=1)
def load_drums() -> Demonstrations:
    """Load the six demonstrations of drumming.

    Returns
    -------
    Demonstrations
        6 recordings of shape (1000, 3): the tip of the stick in m at 100 Hz, two rounds of four
        strokes. `period` is the mean duration of a round.
    """
    file = resources.files("iflow_gym.datasets").joinpath(FILE)
    content = file.read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    if digest != SHA256:
        raise ValueError(
            f"Expected {FILE} with sha256 {SHA256}, got {digest}: reinstall iflow-gym, or make the "
            "file anew with `python -m iflow_gym.envs.drumming.teacher`."
        )
    with file.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
        positions, dt, period = arrays["positions"], float(arrays["dt"]), float(arrays["period"])
    return Demonstrations.from_arrays(
        list(positions.astype(np.float64)),
        dt=dt,
        period=period,
        name="Drumming",
        source=f"{FILE}, sha256 {digest}",
    )
