"""What the page shows of a fitted system: its field on a grid, paths of points, its accuracy."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.metrics import frechet
from iflow_gym.metrics.cycles import PERIODS, STEADY_PERIODS, orbit_distance
from iflow_gym.system import DynamicalSystem

HALF = 50.0
"""The sheet is the square [-HALF, HALF]² in millimetres, whatever the screen's size."""

N_GRID = 64
"""Nodes along a side of the grid on which the field is handed out, to draw streamlines."""

HORIZON = 2.0
"""Paths are handed out for so many durations, or rounds, at a time."""

STEP_TIME = 0.004
"""Seconds of a path's steps, where the demonstrations' are not shorter."""

MOST_STEPS = 3000

LOST = 20 * HALF
"""Farther from the sheet's centre a path is not followed."""


def field_on_grid(system: DynamicalSystem) -> FloatArray:
    """Return the velocities at the sheet's nodes in mm/s, shape (N_GRID, N_GRID, 2), y first."""
    nodes = np.linspace(-HALF, HALF, N_GRID)
    x, y = np.meshgrid(nodes, nodes)
    with np.errstate(all="ignore"):
        return system.velocity(np.stack([x, y], axis=-1))


def step_time(demonstrations: Demonstrations) -> float:
    """Return the seconds between two samples of a path."""
    return min(STEP_TIME, demonstrations.mean_dt)


def paths_from(
    system: DynamicalSystem, demonstrations: Demonstrations, starts: ArrayLike
) -> list[tuple[FloatArray, bool]]:
    """Return the path of each point, shape (n, 2) with its start first, and whether it got lost.

    They are the system's own steps, `step_time` apart: exact where it has a closed form, Euler's
    where it has none. A path that gets lost ends before it does, so that it may be the start alone.

    Parameters
    ----------
    system : DynamicalSystem
    demonstrations : Demonstrations
        What it was fitted on: durations and step are theirs.
    starts : array, shape (m, 2)
        In millimetres.
    """
    dt = step_time(demonstrations)
    unit = demonstrations.period or float(demonstrations.durations.max())
    n_steps = min(MOST_STEPS, max(1, round(HORIZON * unit / dt)))
    with np.errstate(all="ignore"):
        paths = system.rollout(np.asarray(starts, dtype=np.float64).reshape(-1, 2), n_steps, dt)
        near = np.linalg.norm(paths, axis=2) < LOST  # False for what is not finite
    ends = np.where(near.all(axis=1), n_steps + 1, np.argmin(near, axis=1)).clip(min=1)
    return [(path[:end], end <= n_steps) for path, end in zip(paths, ends.tolist(), strict=True)]


def accuracy(system: DynamicalSystem, demonstrations: Demonstrations) -> float:
    """Return how far the learned motion is from the demonstrations in millimetres; may be infinite.

    Of motions that end the mean Fréchet distance of reproductions from the demonstrations' starts;
    of motions that repeat the mean distance of the steady orbit, from the first start, to them and
    back (`iflow_gym.metrics`).
    """
    with np.errstate(all="ignore"):
        if demonstrations.period is None:
            return float(
                np.mean(
                    [
                        frechet(path, system.rollout(path[0], len(path) - 1, dt))
                        for path, dt in zip(
                            demonstrations.positions, demonstrations.dt, strict=True
                        )
                    ]
                )
            )
        dt = step_time(demonstrations)
        n_steady = max(2, round(STEADY_PERIODS * demonstrations.period / dt))
        n_steps = round(PERIODS * demonstrations.period / dt)
        path = system.rollout(demonstrations.starts[0], n_steps, dt)
        return orbit_distance(path[-n_steady:], np.concatenate(demonstrations.positions))
