"""The demonstrations' sample nearest to a point, looked up fast."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iflow_gym.demonstrations import BoundingBox, FloatArray
from iflow_gym.envs.dynamics import Arithmetic, Component, Table

CELLS = {1: 4096, 2: 256}
"""Cells a side of the table of nearest samples; with more dimensions a KD-tree is asked."""


class NearestSample:
    """What is known of the sample nearest to a point.

    In one and two dimensions the sample is looked up in a table over the bounding box enlarged by
    half of each side: the sample nearest to the middle of the cell stands for the whole cell (about
    half a percent of the diagonal wide), and a point beyond the table takes the nearest cell at its
    edge.

    Parameters
    ----------
    points : array, shape (m, d)
    rows : array, shape (m, k)
        What is known of each.
    box : BoundingBox
        Of the demonstrations.
    """

    def __init__(self, points: FloatArray, rows: FloatArray, box: BoundingBox) -> None:
        from scipy.spatial import cKDTree

        self._rows = Table([tuple(row) for row in rows.tolist()], rows)
        self._tree = cKDTree(points)
        self._cells: Table | None = None
        d = points.shape[1]
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

    def of(self, ops: Arithmetic[Component], point: Sequence[Component]) -> Any:
        """Return the k components of the row of the sample nearest to a point of d components."""
        return ops.pick(self._rows, self._index(ops, point))

    def _index(self, ops: Arithmetic[Component], point: Sequence[Component]) -> Any:
        if self._cells is None:
            one: Any = point if isinstance(point[0], float) else np.stack(point, axis=-1)
            return self._tree.query(one)[1]
        cells = [
            ops.whole(ops.smallest(ops.largest((x - low) * rate, 0.0), self._last_cell))
            for x, low, rate in zip(point, self._low, self._cells_per_length, strict=True)
        ]
        return ops.pick(self._cells, reduce(lambda row, cell: row * self._side + cell, cells))
