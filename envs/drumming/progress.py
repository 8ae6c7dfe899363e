"""The reward of drumming, progress along the demonstrations, and the distance from their orbit.

The reward is that of the point mass (`iflow_gym.envs.guide`) without a goal: with m the middle of
a step, k the demonstrations' sample nearest to m, p_k its position, t_k its unit tangent, s_k its
speed, w a twentieth of the diagonal of the demonstrations' bounding box and u the step's velocity,

    n = (t_k + (p_k - m) / w) / ||t_k + (p_k - m) / w||,      r = <u, n> / max(||u||, s_k).

r is in [-1, 1]: about 1 for a replay, 0 for standing still, -1 for going back. On the heads, where
the way down and the way up lie side by side, the nearest sample may belong to the other one: a
replay of `iflow/Drumming-v0` has some steps there that cost, and a mean of 0.95 to 0.99.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from iflow_gym.demonstrations import Demonstrations, FloatArray

WIDTH: Final = 0.05
"""w as a fraction of the diagonal."""

SLOWEST: Final = 0.01
"""Samples slower than this fraction of the peak speed (the turns on a head) guide nobody."""


class Progress:
    """The reward's field for one set of demonstrations; `progress_along` makes and keeps it."""

    def __init__(self, demonstrations: Demonstrations) -> None:
        width = WIDTH * demonstrations.bounding_box.diagonal
        points = np.concatenate(demonstrations.positions)
        flow = np.concatenate(demonstrations.velocities)
        speeds = np.linalg.norm(flow, axis=1)
        moving = speeds > SLOWEST * demonstrations.peak_speed
        self._per_width = 1.0 / width
        self._samples = cKDTree(points[moving])
        self._ahead = points[moving] / width + flow[moving] / speeds[moving, None]
        self._speeds = speeds[moving]

    def of_step(self, x: FloatArray, x_next: FloatArray, dt: float) -> tuple[float, float]:
        """Return a step's reward, and how far in m its end is from the demonstrations.

        Parameters
        ----------
        x, x_next : arrays, shape (3,)
            Where the step begins and ends, in m.
        dt : float
            Seconds a step.
        """
        middle = (x + x_next) * 0.5
        distances, indices = self._samples.query(np.stack([middle, x_next]))
        nearest, distance = np.atleast_1d(indices)[0], np.atleast_1d(distances)[1]
        guide = self._ahead[nearest] - middle * self._per_width
        step = x_next - x
        pace = max(float(np.sqrt(step @ step)), float(self._speeds[nearest]) * dt)
        norm = max(float(np.sqrt(guide @ guide)), 1e-12)
        reward = float(step @ guide) / (norm * pace)
        return min(max(reward, -1.0), 1.0), float(distance)

    def distance(self, x: FloatArray) -> float:
        """Return the distance of a position, shape (3,), from the demonstrations in m."""
        return float(self._samples.query(x)[0])


@lru_cache(maxsize=16)
def progress_along(demonstrations: Demonstrations) -> Progress:
    """Return the field of a set of demonstrations, made at the first call."""
    return Progress(demonstrations)
