"""The best linear system that settles in time: a straight idea, whose proof costs nothing.

    dx/dt = A (x - x*),   A = argmin sum_t ‖A (x_t - x*) - v_t‖²   over  Re λ(A) <= -a

over every sample of every demonstration, a > 0 the margin: the least-squares best among the linear
systems that decay at least that fast, not among all that are stable. The margin is a choice. At the
default, 1.5 / mean duration, every LASA shape settles within the horizon that is scored. A
smaller one can follow the demonstrations more closely and comes late: at 0.1 the RMSE on Sharpc is
8.71 mm instead of 10.27 mm, but on Saeghe 0.18 of the starts converge instead of 1.0.

Where ordinary least squares keeps the margin already, it is the answer. Otherwise A is written so
that it keeps it whatever the numbers:

    A = -a I + (J - R) Q,   J = S - Sᵀ,   R = L Lᵀ,   Q = M Mᵀ + eps I

(Gillis & Sharma, "On computing the distance to stability for matrices using linear dissipative
Hamiltonian systems", Automatica 85, 2017, theorem 1: a matrix is stable if and only if it is
(J - R) Q with J skew, R positive semidefinite and Q positive definite), and S, L, M are found by
L-BFGS with exact gradients. The set of stable matrices is not convex, so several starts are tried.
A common quadratic Lyapunov function fixed beforehand, as in A + Aᵀ < 0, would be convex and worse.

The flow is exp(A t) in closed form. V(x) = (x - x*)ᵀ P (x - x*) with Aᵀ P + P A = -I, up to scale.
With noise of constant covariance D a second it is an Ornstein-Uhlenbeck process, whose transition
is Gaussian (`ornstein_uhlenbeck`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy.linalg import expm, solve_continuous_lyapunov
from scipy.optimize import minimize

from iflow_gym.baselines.ornstein_uhlenbeck import transition
from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.system import DynamicalSystem, Guarantee, check_positive_definite

LEAST_Q = 1e-8
"""eps in Q = M Mᵀ + eps I, with lengths and times of order 1."""

LEAST_NOISE = 1e-6
"""Least standard deviation of the noise over one demonstration, in root mean square distances from
the goal: demonstrations of an exactly linear motion have a density too."""

RANK_TOLERANCE = 1e-12
"""Directions in which the samples' second moment is below this fraction of the largest say nothing
of A; there it stays the isotropic contraction."""


@dataclass(frozen=True)
class StableLinearConfig:
    """Settings of `StableLinear`."""

    margin: float = 1.5
    """Slowest rate of decay, in 1 / mean duration of the demonstrations: Re λ(A) <= -margin / T.
    Below 1.5 some LASA shapes do not settle within the scored horizon; more costs accuracy."""
    noise_horizons: tuple[int, ...] = (1, 10)
    """Horizons in samples whose residuals, pooled, set the noise of `log_prob`, each cut to the
    length of a shorter recording; the field does not depend on it."""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.margin) and self.margin > 0):
            raise ValueError(f"Expected margin > 0, got {self.margin}: without it nothing decays.")
        if not self.noise_horizons or min(self.noise_horizons) < 1:
            raise ValueError(
                f"Expected noise_horizons of at least one whole number >= 1, got "
                f"{self.noise_horizons}."
            )


class StableLinear(DynamicalSystem):
    """dx/dt = A (x - x*) with the least-squares optimal A among those that keep the margin.

    Attributes
    ----------
    matrix_ : array, shape (d, d)
        A, in 1/s.
    diffusion_ : array, shape (d, d)
        D, covariance of the noise a second, in length²/s.
    lyapunov_matrix_ : array, shape (d, d)
        P, of trace d, so that V is a length².

    References
    ----------
    Gillis & Sharma, Automatica 85, 2017.

    Examples
    --------
    >>> from iflow_gym import load_lasa
    >>> system = StableLinear().fit(load_lasa("Line"), seed=0)
    >>> system.guarantee.kind
    'proved'
    """

    name: ClassVar[str] = "linear"
    title: ClassVar[str] = "Stable linear"
    Config: ClassVar[type] = StableLinearConfig
    stochastic_fit: ClassVar[bool] = False
    integrator: ClassVar[str] = "exact"

    def _fit(self, demonstrations: Demonstrations, rng: np.random.Generator) -> None:
        goal = demonstrations.attractor
        x = np.concatenate(demonstrations.positions) - goal
        v = np.concatenate(demonstrations.velocities)
        duration = float(demonstrations.durations.mean())
        scale = float(np.sqrt((x**2).mean()))  # > 0: demonstrations move, and end at the goal
        # With lengths in `scale` and times in `duration` everything is of order 1.
        matrix = fit_stable_matrix(x / scale, v * (duration / scale), self.config.margin)
        self._adopt(matrix / duration, goal)
        least = (LEAST_NOISE * scale) ** 2 / duration
        self.diffusion_ = fit_diffusion(
            self.matrix_, demonstrations, self.config.noise_horizons, least
        )

    def _adopt(self, matrix: FloatArray, goal: FloatArray) -> None:
        """Take A over, and its Lyapunov function, which is the check that A is stable."""
        self.matrix_ = matrix
        self._goal = goal
        self.lyapunov_matrix_ = lyapunov_matrix(matrix)
        self._propagators = np.empty(0), np.empty((0, *matrix.shape))

    def _velocity(self, x: FloatArray) -> FloatArray:
        return np.asarray((x - self._goal) @ self.matrix_.T)

    def _step(self, x: FloatArray, dt: FloatArray) -> FloatArray:
        flows = self._flows(dt)
        return np.asarray(self._goal + np.einsum("nij,nj->ni", flows, x - self._goal))

    def _flows(self, dt: FloatArray) -> FloatArray:
        """Return exp(A dt), (n, d, d); the last ones are kept: a rollout asks for them every step.

        States that step together may have times of their own, but few different ones.
        """
        kept, flows = self._propagators
        if not np.array_equal(dt, kept):
            times, which = np.unique(dt, return_inverse=True)
            flows = expm(times[:, None, None] * self.matrix_)[which]
            self._propagators = dt.copy(), flows
        return flows

    def _lyapunov(self, x: FloatArray) -> FloatArray:
        offset = x - self._goal
        return np.asarray(((offset @ self.lyapunov_matrix_) * offset).sum(axis=1))

    def _lyapunov_rate(self, x: FloatArray) -> FloatArray:
        offset = x - self._goal
        return np.asarray(2.0 * ((offset @ self.lyapunov_matrix_) * self._velocity(x)).sum(axis=1))

    def _log_prob(self, x: FloatArray, x_next: FloatArray, dt: float) -> FloatArray:
        flow, covariance = transition(self.matrix_, self.diffusion_, dt)
        root = np.linalg.cholesky(covariance)
        residual = x_next - self._goal - (x - self._goal) @ flow.T
        white = np.linalg.solve(root, residual.T)
        constant = 0.5 * len(root) * np.log(2 * np.pi) + np.log(np.diag(root)).sum()
        return np.asarray(-0.5 * (white**2).sum(axis=0) - constant)

    @property
    def guarantee(self) -> Guarantee:
        """Global exponential stability: every eigenvalue of A has a negative real part."""
        self._require_fit()
        slowest = float(np.linalg.eigvals(self.matrix_).real.max())
        return Guarantee(
            "proved",
            f"linear; every eigenvalue of A has a real part <= {slowest:.3g} 1/s, and "
            "V = (x - x*)ᵀ P (x - x*) with P > 0 and AᵀP + PA < 0, both checked, decreases",
        )

    def _arrays(self) -> dict[str, np.ndarray[Any, Any]]:
        return {"matrix": self.matrix_, "diffusion": self.diffusion_}

    def _restore(self, arrays: Mapping[str, np.ndarray[Any, Any]]) -> None:
        d = self.n_dims_
        matrix, diffusion = (
            np.asarray(arrays[k], dtype=np.float64) for k in ("matrix", "diffusion")
        )
        if matrix.shape != (d, d) or diffusion.shape != (d, d):
            raise ValueError(
                f"expected matrix and diffusion of shape {(d, d)}, got {matrix.shape} and "
                f"{diffusion.shape}"
            )
        check_positive_definite(diffusion, "diffusion")
        self._adopt(matrix, self.goal_)
        self.diffusion_ = diffusion


def fit_stable_matrix(x: FloatArray, v: FloatArray, margin: float) -> FloatArray:
    """Return the A of least ‖x Aᵀ - v‖² among those with every Re λ(A) <= -margin.

    Parameters
    ----------
    x, v : arrays, shape (n, d)
        Offsets from the goal and velocities, in units that make both of order 1.
    margin : float
        In 1 / unit of time.

    Returns
    -------
    array, shape (d, d)
        Ordinary least squares where that keeps the margin; else a local minimum, the best from the
        starts of `_starts`. What lies off the samples' span contracts isotropically.
    """
    second, cross = x.T @ x / len(x), v.T @ x / len(x)
    rate = max(2 * margin, -float(np.trace(cross)) / float(np.trace(second)))
    contraction = -rate * np.eye(x.shape[1])
    inverse = np.linalg.pinv(second, rcond=RANK_TOLERANCE, hermitian=True)
    free = contraction + (cross - contraction @ second) @ inverse
    if np.linalg.eigvals(free).real.max() <= -margin:
        return free
    best, least = contraction, np.inf
    for start in _starts(free, contraction, margin):
        result = minimize(
            stable_objective,
            _parameters(start, margin),
            args=(second, cross, margin),
            jac=True,
            method="L-BFGS-B",
            options={"maxiter": 2000, "maxfun": 4000, "ftol": 1e-15, "gtol": 1e-10},
        )
        if result.fun < least:
            best, least = _matrix(result.x, x.shape[1], margin)[0], float(result.fun)
    return best


def stable_objective(
    parameters: FloatArray, second: FloatArray, cross: FloatArray, margin: float
) -> tuple[float, FloatArray]:
    """Return tr(A C Aᵀ) / 2 - tr(A Bᵀ) and its gradient, for A = -margin I + (J - R) Q.

    Parameters
    ----------
    parameters : array, shape (d (d - 1) / 2 + d (d + 1),)
        The lower triangles of S (strict), L and M, row by row.
    second, cross : arrays, shape (d, d)
        C = mean x xᵀ and B = mean v xᵀ: the squared error over two, less what A cannot change.
    margin : float
    """
    d = len(second)
    matrix, turn, root, q_root = _matrix(parameters, d, margin)
    error = matrix @ second - cross
    value = 0.5 * float(np.sum(matrix * (error - cross)))
    q = q_root @ q_root.T + LEAST_Q * np.eye(d)
    outer = error @ q
    inner = (turn - turn.T - root @ root.T).T @ error
    strict, lower = np.tril_indices(d, -1), np.tril_indices(d)
    gradient = np.concatenate(
        [
            (outer - outer.T)[strict],
            (-(outer + outer.T) @ root)[lower],
            ((inner + inner.T) @ q_root)[lower],
        ]
    )
    return value, gradient


def _matrix(
    parameters: FloatArray, d: int, margin: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return A and the triangles S, L and M that it is made of, each shape (d, d)."""
    turn, root, q_root = np.zeros((3, d, d))
    n_strict, n_lower = d * (d - 1) // 2, d * (d + 1) // 2
    turn[np.tril_indices(d, -1)] = parameters[:n_strict]
    root[np.tril_indices(d)] = parameters[n_strict : n_strict + n_lower]
    q_root[np.tril_indices(d)] = parameters[n_strict + n_lower :]
    product = (turn - turn.T - root @ root.T) @ (q_root @ q_root.T + LEAST_Q * np.eye(d))
    return product - margin * np.eye(d), turn, root, q_root


def _parameters(matrix: FloatArray, margin: float) -> FloatArray:
    """Return the parameters of a matrix that keeps the margin with room to spare.

    With B = A + margin I and Bᵀ Q + Q B = -I, theorem 1 has Q itself, R = Q⁻² / 2 and J the skew
    part of B Q⁻¹.
    """
    d = len(matrix)
    shifted = matrix + margin * np.eye(d)
    q = solve_continuous_lyapunov(shifted.T, -np.eye(d))
    q = (q + q.T) / 2
    q *= d / np.trace(q)  # (J - R) takes the scale up
    product = shifted @ np.linalg.inv(q)
    skew, dissipation = (product - product.T) / 2, -(product + product.T) / 2
    roots = [np.linalg.cholesky(m + LEAST_Q * np.eye(d)) for m in (dissipation, q)]
    lower = np.tril_indices(d)
    return np.concatenate([skew[np.tril_indices(d, -1)], roots[0][lower], roots[1][lower]])


def _starts(free: FloatArray, contraction: FloatArray, margin: float) -> list[FloatArray]:
    """Return stable matrices to start from: a contraction, and bent forms of least squares."""
    d = len(free)
    least = -2 * margin  # with room to spare: the boundary has no Lyapunov function
    values, vectors = np.linalg.eig(free)
    starts = [contraction, free + (least - values.real.max()) * np.eye(d)]
    symmetric, skew = (free + free.T) / 2, (free - free.T) / 2
    w, u = np.linalg.eigh(symmetric)
    starts.append((u * np.minimum(w, least)) @ u.T + skew)
    if np.linalg.cond(vectors) < 1e6:
        cut = np.minimum(values.real, least) + 1j * values.imag
        starts.append(np.real((vectors * cut) @ np.linalg.inv(vectors)))
    return starts


def lyapunov_matrix(matrix: FloatArray) -> FloatArray:
    """Return P of trace d with Aᵀ P + P A negative definite, shape (d, d).

    Raises
    ------
    ValueError
        If the eigenvalues of `matrix` are not all in the left half plane, or P does not show it in
        floating point.
    """
    d = len(matrix)
    size = float(np.abs(matrix).max()) or 1.0
    unit = matrix / size  # the unit of time does not matter to P, and this one cannot overflow
    slowest = float(np.linalg.eigvals(unit).real.max())
    if not slowest < -np.finfo(np.float64).eps:
        raise ValueError(
            "expected eigenvalues with negative real parts beyond rounding, got "
            f"{slowest * size:.3g}"
        )
    p = solve_continuous_lyapunov(unit.T, -np.eye(d))
    p = (p + p.T) * (d / (2 * np.trace(p)))
    decay = -(unit.T @ p + p @ unit)
    if not (np.linalg.eigvalsh(p)[0] > 0 and np.linalg.eigvalsh(decay)[0] > 0):
        raise ValueError(
            f"expected a matrix that is stable beyond rounding, got one whose slowest rate is "
            f"{slowest * size:.3g} 1/s: raise the margin"
        )
    return np.asarray(p)


def fit_diffusion(
    matrix: FloatArray,
    demonstrations: Demonstrations,
    horizons: tuple[int, ...],
    least: float,
) -> FloatArray:
    """Return D, shape (d, d) in length²/s, from the residuals of transitions over `horizons`.

    The transition covariance is linear in D. Each recording and horizon gives the D that explains
    its residuals' second moment; they are averaged, weighted by their transitions. Horizons beyond
    a recording are cut to its whole length, once; eigenvalues below `least` are raised to it.
    """
    goal = demonstrations.attractor
    d = demonstrations.n_dims
    total, n_transitions = np.zeros((d, d)), 0
    for x, dt in zip(demonstrations.positions, demonstrations.dt, strict=True):
        # A set: two horizons that are cut to the same length count once.
        for k in {min(h, len(x) - 1) for h in horizons}:
            offset = x - goal
            residual = offset[k:] - offset[:-k] @ expm(k * dt * matrix).T
            moment = residual.T @ residual
            total += _diffusion_of(matrix, moment, k * dt)
            n_transitions += len(residual)
    w, u = np.linalg.eigh(total / n_transitions)
    return np.asarray((u * np.maximum(w, least)) @ u.T)


def _diffusion_of(matrix: FloatArray, covariance: FloatArray, dt: float) -> FloatArray:
    """Return the D, shape (d, d), whose transition over dt has this covariance."""
    d = len(matrix)
    basis = np.eye(d * d).reshape(d * d, d, d)
    columns = [transition(matrix, (e + e.T) / 2, dt)[1].ravel() for e in basis]
    # The map is taken on symmetric matrices alone, where it is one to one.
    solution = np.linalg.lstsq(np.stack(columns, axis=1), covariance.ravel(), rcond=None)[0]
    solution = solution.reshape(d, d)
    return np.asarray((solution + solution.T) / 2)
