"""Even subsets of samples, for what need not or cannot look at all of them."""

from __future__ import annotations

import numpy as np

from iflow_gym.demonstrations import FloatArray


def evenly(samples: FloatArray, n: int) -> FloatArray:
    """Return n samples, evenly taken from the first to the last; all where there are fewer.

    Parameters
    ----------
    samples : array, shape (T, d)
    n : int, >= 2

    Returns
    -------
    array, shape (min(n, T), d)
    """
    chosen = np.linspace(0, len(samples) - 1, min(n, len(samples))).round().astype(int)
    return np.asarray(samples[chosen])
