"""The reward of the point-mass environments: progress along the demonstrations.

Let m = (x + x') / 2 be the middle of a step, k the demonstrations' sample nearest to m, p_k its
position, t_k the unit tangent and s_k the speed there. With w a twentieth of the diagonal of the
demonstrations' bounding box and the step's velocity u = (x' - x) / dt,

    n = (t_k + (p_k - m) / w) / ||t_k + (p_k - m) / w||,
    r = <u, n> / max(||u||, s_k)        and r = 1 where ||x' - goal|| is within the tolerance.

On a demonstration n is its direction of travel; away from it n turns towards it. So r is the
share of the demonstrated speed that the mass makes good in the right direction: about 1 for a
replay, 0 for standing still, -1 for going back, and |r| <= 1 by the Cauchy-Schwarz inequality.
Faster than demonstrated pays no more than demonstrated. Outside the goal r(x, x') = -r(x', x):
taking a step back costs exactly what the step paid, whatever its length.

What no such reward can do: it is bounded, depends on (x, x') alone and gives 1 a step for a
replay, so a loop that goes forward at the demonstrated speed and back several times faster has a
positive sum (about 0.8 a step at full speed back). It never beats the replay, whose every step is
worth about 1, the maximum.

The tails of the recordings inside the goal's tolerance are replaced by one sample, the goal, with
no tangent and the mean speed at which the recordings enter: there n points at the goal.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iflow_gym.demonstrations import GOAL_TOLERANCE, Demonstrations, FloatArray
from iflow_gym.envs.dynamics import Arithmetic, Component, Table, dot

WIDTH = 0.05
"""w as a fraction of the diagonal: there the guide points 45 degrees off the tangent."""

CELLS = {1: 4096, 2: 256}
"""Cells a side of the table of nearest samples; with more dimensions a KD-tree is asked."""

SLOWEST = 1e-6
"""Samples slower than this fraction of the peak speed have no direction and are left out."""


class Guide:
    """The reward's field for one set of demonstrations; `guide_for` makes and keeps it.

    In one and two dimensions the nearest sample is looked up in a table over the bounding box
    enlarged by half of each side: the sample nearest to the middle of the cell stands for the
    whole cell (about half a percent of the diagonal wide), and a point beyond the table takes
    the nearest cell at its edge.
    """

    def __init__(self, demonstrations: Demonstrations) -> None:
        from scipy.spatial import cKDTree

        box = demonstrations.bounding_box
        points, tangents, speeds = _samples(demonstrations)
        self._per_width = 1 / (WIDTH * box.diagonal)
        rows = np.column_stack([points * self._per_width + tangents, speeds])
        self._samples = Table([tuple(row) for row in rows.tolist()], rows)
        self._tree = cKDTree(points)
        self._cells: Table | None = None
        d = demonstrations.n_dims
        if d in CELLS:
            side = np.maximum(box.high - box.low, 1e-3 * box.diagonal)
            low = (box.low + box.high) / 2 - side
            n = CELLS[d]
            axes = [lo + 2 * s * (np.arange(n) + 0.5) / n for lo, s in zip(low, side, strict=True)]
            middles = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, d)
            nearest: NDArray[np.intp] = np.ascontiguousarray(
                self._tree.query(middles)[1], dtype=np.intp
            )
            self._cells = Table(nearest.data, nearest)
            self._low: list[float] = low.tolist()
            self._cells_per_length: list[float] = (n / (2 * side)).tolist()
            self._side, self._last_cell = n, float(n - 1)

    def _nearest(self, ops: Arithmetic[Component], point: Sequence[Component]) -> Any:
        """Return the index of the sample nearest to a point."""
        if self._cells is None:
            return self._tree.query(np.stack(point, axis=-1))[1]
        cells = [
            ops.whole(ops.smallest(ops.largest((x - low) * rate, 0.0), self._last_cell))
            for x, low, rate in zip(point, self._low, self._cells_per_length, strict=True)
        ]
        return ops.pick(self._cells, reduce(lambda row, cell: row * self._side + cell, cells))

    def reward(
        self,
        ops: Arithmetic[Component],
        x: Sequence[Component],
        x_next: Sequence[Component],
        dt: Component,
    ) -> Component:
        """Return the reward of a step outside the goal's tolerance."""
        middle = [(a + b) * 0.5 for a, b in zip(x, x_next, strict=True)]
        *ahead, speed = ops.pick(self._samples, self._nearest(ops, middle))  # p / w + t, s
        guide = [p - m * self._per_width for p, m in zip(ahead, middle, strict=True)]
        step = [b - a for a, b in zip(x, x_next, strict=True)]
        pace = ops.largest(ops.root(dot(step, step)), speed * dt)
        norm = ops.largest(ops.root(dot(guide, guide)), _TINY)
        share = dot(step, guide) / (norm * pace)
        return ops.largest(ops.smallest(share, 1.0), -1.0)


_TINY = 1e-12
"""Keeps 0 / 0 away where the guide vanishes."""


@lru_cache(maxsize=64)
def guide_for(demonstrations: Demonstrations) -> Guide:
    """Return the guide of a set of demonstrations, made at the first call."""
    return Guide(demonstrations)


def _samples(demonstrations: Demonstrations) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return positions (m, d), unit tangents (m, d) and speeds (m,), the goal as the last."""
    goal = demonstrations.attractor
    tolerance = GOAL_TOLERANCE * demonstrations.bounding_box.diagonal
    points, velocities, entries = [], [], []
    for p, v in zip(demonstrations.positions, demonstrations.velocities, strict=True):
        outside = np.flatnonzero(np.linalg.norm(p - goal, axis=1) > tolerance)
        moving = np.linalg.norm(v, axis=1) > SLOWEST * demonstrations.peak_speed
        end = int(outside[-1]) + 1 if len(outside) else 0
        points.append(p[:end][moving[:end]])
        velocities.append(v[:end][moving[:end]])
        entries.append(float(np.linalg.norm(v[max(end - 1, 0)])))
    path, flow = np.concatenate(points), np.concatenate(velocities)
    speeds = np.linalg.norm(flow, axis=1)
    arrival = max(float(np.mean(entries)), SLOWEST * demonstrations.peak_speed)
    return (
        np.concatenate([path, goal[None]]),
        np.concatenate([flow / speeds[:, None], np.zeros_like(goal)[None]]),
        np.append(speeds, arrival),
    )
