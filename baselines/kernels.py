"""Squared exponential kernels around fixed centres, for many calls."""

from __future__ import annotations

import numpy as np

from iflow_gym.demonstrations import FloatArray


class SquaredExponentials:
    """The kernels k_i(x) = peak exp(-‖(x - z_i) / scales‖² / 2), as powers of 2.

    All exponents are one product of matrices, (x, x², 1) with what does not depend on x. 2 is the
    base because its powers take less time than those of e (`elementwise`).

    Parameters
    ----------
    centres : array, shape (m, d)
        z_i.
    scales : array, shape (d,), or float
    peak : float
    """

    def __init__(self, centres: FloatArray, scales: FloatArray | float, peak: float = 1.0) -> None:
        m, d = centres.shape
        scaled = centres / scales
        precisions = np.broadcast_to(1 / np.square(scales), d)
        rows = [
            (scaled / scales).T,
            np.broadcast_to(-0.5 * precisions[:, None], (d, m)),
            -0.5 * (scaled**2).sum(axis=1) + np.log(peak),
        ]
        self._factors = np.vstack(rows) / np.log(2)

    def exponents(self, x: FloatArray) -> FloatArray:
        """Return log2 k_i(x), shape (n, m), at positions x, shape (n, d)."""
        n, d = x.shape
        terms = np.ones((n, 2 * d + 1))
        terms[:, :d] = x
        np.multiply(x, x, out=terms[:, d : 2 * d])
        return np.asarray(terms @ self._factors)

    def relative_exponents(self, x: FloatArray) -> FloatArray:
        """Return log2 k_i(x) / max_j k_j(x), shape (n, m): digits are left however far x is."""
        exponents = x @ self._factors[: x.shape[1]]  # without ‖x‖², which is the same for all
        exponents += self._factors[-1]
        exponents -= exponents.max(axis=1, keepdims=True)
        return np.asarray(exponents)
