"""The numbers that SEDS searches over, as one vector, and the way of gradients back to them.

Under the constraints of SEDS (eq. (16)) a Gaussian over positions and velocities has
mu_v = A mu_x, so that its density is N(x; mu_x, Sigma_x) N(v; A x, C) with C = Cov(v | x). The
mixture is then five blocks:

    log-priors (a softmax), mu_x, W, U, A,    Sigma_x^-1 = Wᵀ W,  C^-1 = Uᵀ U,

W and U lower triangular with the logarithms of their diagonals: every vector is a mixture with
positive priors and positive definite covariances. What is left is A + Aᵀ < 0, in one of two ways:

    by construction   A = -(R Rᵀ + margin I) + (S - Sᵀ),  R lower, S strictly lower triangular
    free              A itself, for a solver that takes the constraint
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from iflow_gym.demonstrations import FloatArray

LARGEST_LOG = 25.0
"""Of a diagonal of W or U, whose inverse squares are variances over the samples' mean square."""


@dataclass(frozen=True, eq=False)
class Mixture:
    """A mixture that passes through the goal, or a gradient with respect to one.

    Attributes
    ----------
    log_priors : array, shape (K,)
        Up to a constant.
    centres : array, shape (K, d)
        mu_x.
    whitening, precision_roots : arrays, shape (K, d, d), lower triangular
        W and U.
    gains : array, shape (K, d, d)
        A.
    """

    log_priors: FloatArray
    centres: FloatArray
    whitening: FloatArray
    precision_roots: FloatArray
    gains: FloatArray

    @cached_property
    def normalised(self) -> FloatArray:
        """Log-priors, shape (K,), of priors that sum to 1."""
        return np.asarray(self.log_priors - logsumexp(self.log_priors))


@dataclass(frozen=True)
class Parametrisation:
    """Between a `Mixture` and a vector of parameters."""

    n_components: int
    n_dims: int
    margin: float
    """Greatest eigenvalue of (A + Aᵀ) / 2 is at most minus this, in the units of A."""
    by_construction: bool = True

    @cached_property
    def _lower(self) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
        rows, columns = np.tril_indices(self.n_dims)
        return rows, columns

    @cached_property
    def _strict(self) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
        rows, columns = np.tril_indices(self.n_dims, -1)
        return rows, columns

    @cached_property
    def _sizes(self) -> tuple[int, ...]:
        d = self.n_dims
        lower = d * (d + 1) // 2
        return (1, d, lower, lower, d * d)

    @property
    def size(self) -> int:
        """Length of the vector, K (1 + 2 d + 2 d²): one more than is free, as the softmax is."""
        return self.n_components * sum(self._sizes)

    def mixture(self, vector: FloatArray) -> Mixture:
        """Return the mixture of a vector, shape (size,)."""
        logits, centres, whitening, roots, gains = self._split(vector)
        return Mixture(
            logits[:, 0],
            centres,
            self._triangles(whitening),
            self._triangles(roots),
            self._gains(gains),
        )

    def vector(self, mixture: Mixture) -> FloatArray:
        """Return the vector of a mixture whose gains keep the margin."""
        d = self.n_dims
        gains = mixture.gains
        if self.by_construction:
            symmetric = (gains + np.swapaxes(gains, 1, 2)) / 2
            roots = np.linalg.cholesky(-symmetric - self.margin * np.eye(d))
            turn = (gains - symmetric)[:, *self._strict]
            parts = np.concatenate([roots[:, *self._lower], turn], axis=1)
        else:
            parts = gains.reshape(-1, d * d)
        columns = [
            mixture.log_priors[:, None],
            mixture.centres,
            self._flattened(mixture.whitening),
            self._flattened(mixture.precision_roots),
            parts,
        ]
        return np.concatenate([c.ravel() for c in columns])

    def bounds(self) -> list[tuple[float | None, float | None]]:
        """Return bounds of the vector's entries for a solver: none but of logarithms' sizes.

        A trial step of a solver may be absurd, and has to stay a number.
        """
        k = self.n_components
        rows, columns = self._lower
        logs = [(-LARGEST_LOG, LARGEST_LOG) if same else (None, None) for same in rows == columns]
        free: list[tuple[float | None, float | None]] = [(None, None)]
        before, after = k * (1 + self.n_dims), k * self.n_dims**2
        return free * before + 2 * k * logs + free * after

    def pull_back(self, vector: FloatArray, gradient: Mixture) -> FloatArray:
        """Return the gradient with respect to the vector, of one with respect to the mixture.

        Of `whitening` and `precision_roots` only the lower triangles are read.
        """
        _, _, whitening, roots, gains = self._split(vector)
        columns = [
            gradient.log_priors[:, None],
            gradient.centres,
            self._onto_triangles(whitening, gradient.whitening),
            self._onto_triangles(roots, gradient.precision_roots),
            self._onto_gains(gains, gradient.gains),
        ]
        return np.concatenate([c.ravel() for c in columns])

    def _split(self, vector: FloatArray) -> list[FloatArray]:
        k = self.n_components
        ends = np.cumsum([k * s for s in self._sizes])
        parts = np.split(vector, ends[:-1])
        return [p.reshape(k, s) for p, s in zip(parts, self._sizes, strict=True)]

    def _triangles(self, flat: FloatArray) -> FloatArray:
        d = self.n_dims
        full = np.zeros((self.n_components, d, d))
        full[:, *self._lower] = flat
        full[:, range(d), range(d)] = np.exp(full[:, range(d), range(d)])
        return full

    def _flattened(self, triangles: FloatArray) -> FloatArray:
        d = self.n_dims
        logs = triangles.copy()
        logs[:, range(d), range(d)] = np.log(logs[:, range(d), range(d)])
        return np.asarray(logs[:, *self._lower])

    def _onto_triangles(self, flat: FloatArray, gradient: FloatArray) -> FloatArray:
        d = self.n_dims
        scaled = gradient.copy()
        scaled[:, range(d), range(d)] *= self._triangles(flat)[:, range(d), range(d)]
        return np.asarray(scaled[:, *self._lower])

    def _roots_and_turns(self, flat: FloatArray) -> tuple[FloatArray, FloatArray]:
        d = self.n_dims
        roots, turns = np.zeros((2, self.n_components, d, d))
        n_lower = d * (d + 1) // 2
        roots[:, *self._lower] = flat[:, :n_lower]
        turns[:, *self._strict] = flat[:, n_lower:]
        return roots, turns

    def _gains(self, flat: FloatArray) -> FloatArray:
        d = self.n_dims
        if not self.by_construction:
            return flat.reshape(-1, d, d)
        roots, turns = self._roots_and_turns(flat)
        skew = turns - np.swapaxes(turns, 1, 2)
        return skew - roots @ np.swapaxes(roots, 1, 2) - self.margin * np.eye(d)

    def _onto_gains(self, flat: FloatArray, gradient: FloatArray) -> FloatArray:
        if not self.by_construction:
            return gradient
        roots, _ = self._roots_and_turns(flat)
        across = np.swapaxes(gradient, 1, 2)
        of_roots = -(gradient + across) @ roots
        return np.concatenate(
            [of_roots[:, *self._lower], (gradient - across)[:, *self._strict]], axis=1
        )

    # For solvers that take the constraint ---------------------------------------------------

    def constraint(self, vector: FloatArray) -> FloatArray:
        """Return -margin - eigenvalues of (A + Aᵀ) / 2, shape (K d,): feasible where >= 0."""
        gains = self.mixture(vector).gains
        values = np.linalg.eigvalsh((gains + np.swapaxes(gains, 1, 2)) / 2)
        return np.asarray(-self.margin - values.ravel())

    def constraint_jacobian(self, vector: FloatArray) -> FloatArray:
        """Return its Jacobian, shape (K d, size); of equal eigenvalues one of the choices."""
        k, d = self.n_components, self.n_dims
        gains = self.mixture(vector).gains
        _, axes = np.linalg.eigh((gains + np.swapaxes(gains, 1, 2)) / 2)
        rows = np.zeros((k, d, k, d * d))
        for i in range(k):
            rows[i, :, i] = -np.einsum("ai,bi->iab", axes[i], axes[i]).reshape(d, d * d)
        jacobian = np.zeros((k * d, self.size))
        jacobian[:, -k * d * d :] = rows.reshape(k * d, k * d * d)
        return jacobian
