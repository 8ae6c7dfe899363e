"""What a motion that begins at x0 is like, learned from demonstrations that began elsewhere.

Numbers that describe a motion, such as a primitive's weights, are taken to be jointly Gaussian with
its start, and the conditional mean

    E[w | x0] = mu_w + Cov(w, x0) (Cov(x0) + Sigma_y)^-1 (x0 - mu_x)

says what they are from another start. Primitives share it: for probabilistic movement primitives it
is their conditioning (Paraschos et al., NIPS 2013, eq. (5)), for dynamic movement primitives the
linear case of what Ude, Gams, Asfour & Morimoto do ("Task-specific generalization of discrete and
periodic dynamic movement primitives", IEEE T-RO 26(5), 2010).

A handful of demonstrations that began close to each other says nothing of starts far away, and the
formula would swing wildly there. So the offset x0 - mu_x is shortened to what was demonstrated: to
the largest Mahalanobis distance of a demonstrated start. What it was shortened by is for the
primitive to lead over, as the last part of a motion that fades.

The mean is affine in the start, and what a primitive does at a phase is linear in its weights. So a
batch of motions needs no weights of its own: bases times weights are a few curves that all share
(`from_start`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from iflow_gym.demonstrations import FloatArray

EXACTNESS = 1e-4
"""Variance Sigma_y with which a start is observed, as a fraction of the starts' mean variance."""


class GivenStart(NamedTuple):
    """The conditional mean of k numbers given a start."""

    mean: FloatArray
    """mu_w, shape (k,)."""
    slope: FloatArray
    """Cov(w, x0) (Cov(x0) + Sigma_y)^-1, shape (k, d)."""
    start: FloatArray
    """mu_x, shape (d,)."""
    whitening: FloatArray
    """Shape (d, d): ‖whitening (x0 - mu_x)‖ is the Mahalanobis distance."""
    reach: FloatArray
    """Its largest value among the demonstrations, shape (1,); 0 where they began in one place."""

    @classmethod
    def fit(cls, starts: FloatArray, values: FloatArray) -> GivenStart:
        """Fit to n demonstrations: starts, shape (n, d), and values, shape (n, k)."""
        mean, start = values.mean(axis=0), starts.mean(axis=0)
        offsets = starts - start
        n, d = starts.shape
        covariance = offsets.T @ offsets / n
        variance = float(np.trace(covariance)) / d
        if not variance > 0:
            return cls(mean, np.zeros((values.shape[1], d)), start, np.eye(d), np.zeros(1))
        covariance += EXACTNESS * variance * np.eye(d)
        crossed = (values - mean).T @ offsets / n
        slope = np.linalg.solve(covariance, crossed.T).T
        whitening = np.linalg.inv(np.linalg.cholesky(covariance))
        reach = np.linalg.norm(offsets @ whitening.T, axis=1).max(keepdims=True)
        return cls(mean, slope, start, whitening, reach)

    @property
    def coefficients(self) -> FloatArray:
        """What the numbers are made of, shape (1 + d, k): mu_w, and what a unit of offset adds."""
        return np.vstack([self.mean, self.slope.T])

    def factors(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what `coefficients` are multiplied by for starts x, shape (n, d), and a rest.

        The factors, shape (n, 1 + d), are 1 and the offset from mu_x, shortened; the rest, shape
        (n, d), is what it was shortened by. ``factors @ coefficients`` are the numbers.
        """
        offsets = x - self.start
        distances = np.linalg.norm(offsets @ self.whitening.T, axis=1)
        shorter = np.minimum(1.0, self.reach / np.maximum(distances, np.finfo(np.float64).tiny))
        reached = shorter[:, None] * offsets
        return with_one(reached), offsets - reached

    def arrays(self) -> dict[str, FloatArray]:
        """Return what a file holds of it."""
        return {f"given_start.{k}": v for k, v in self._asdict().items()}

    @classmethod
    def restore(cls, arrays: Mapping[str, np.ndarray[Any, Any]], k: int, d: int) -> GivenStart:
        """Return what a file holds; raise KeyError or ValueError if it does not fit."""
        found = cls(*(np.asarray(arrays[f"given_start.{n}"], np.float64) for n in cls._fields))
        expected, came = [(k,), (k, d), (d,), (d, d), (1,)], [a.shape for a in found]
        if came != expected:
            raise ValueError(f"expected {', '.join(cls._fields)} of shapes {expected}, got {came}")
        if not found.reach >= 0:
            raise ValueError(f"expected a reach >= 0, got {found.reach}")
        return found


def with_one(offsets: FloatArray) -> FloatArray:
    """Return offsets, shape (n, d), with a 1 before each, shape (n, 1 + d)."""
    return np.insert(offsets, 0, 1.0, axis=1)


def by_basis(weights: FloatArray) -> FloatArray:
    """Return weights of B bases, shape (1 + d, B, d), as `from_start`'s, shape (B, (1 + d) d)."""
    return np.asarray(weights.transpose(1, 0, 2).reshape(weights.shape[1], -1))


def from_start(curves: FloatArray, factors: FloatArray) -> FloatArray:
    """Return sum_k factors_k curves_k, shape (n, d), of factors, shape (n, 1 + d).

    The curves, bases times weights, shape (n, (1 + d) d), are the motion from the mean start and
    what a unit of offset along each axis adds to it, at a phase for each row.
    """
    n, m = factors.shape
    return np.asarray(np.einsum("nkd,nk->nd", curves.reshape(n, m, -1), factors))


def minimum_jerk(phase: FloatArray) -> FloatArray:
    """Return the share, shape (n,), of a way from rest to rest that is done at phases in [0, 1].

    Flash & Hogan, "The coordination of arm movements", J. Neuroscience 5(7), 1985.
    """
    s = np.clip(phase, 0.0, 1.0)
    return np.asarray(s * s * s * (10.0 - s * (15.0 - 6.0 * s)))
