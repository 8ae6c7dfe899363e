"""Which motion a trajectory is of: argmax_k p(tau | k), from the densities in the records.

ImitationFlow paper, sec. IV-C. Each cell's model says how likely the scored demonstrations of every
motion of its family are; a demonstration is taken for the motion whose model finds it likeliest.
"""

from __future__ import annotations

import numpy as np
from board import Row
from numpy.typing import NDArray


def confusion(row: Row) -> NDArray[np.int64] | None:
    """Return how many demonstrations of motion i were taken for motion j, summed over the seeds.

    Shape (E, E), in the order of the row's environments. None where a cell has no densities of all
    the others' demonstrations.
    """
    names = row.environments
    counts = np.zeros((len(names), len(names)), dtype=np.int64)
    for seed in row.seeds:
        cells = [row.cells.get((name, seed)) for name in names]
        if any(c is None or set(c.likelihoods) != set(names) for c in cells):
            return None
        for i, name in enumerate(names):
            densities = np.array([c.likelihoods[name] for c in cells if c is not None])
            for taken in densities.argmax(axis=0):  # of shape (models, demonstrations)
                counts[i, taken] += 1
    return counts


def fraction_right(counts: NDArray[np.int64]) -> float:
    """Return the fraction of demonstrations that were taken for what they are."""
    return float(np.trace(counts) / counts.sum())
