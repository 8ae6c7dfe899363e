"""Kernelized movement primitives, led through the start and the goal.

Of the demonstrations a reference is taken: the mean mu_n and the covariance Sigma_n of the position
at N phases s_n. The motion whose parameters have the least Kullback-Leibler divergence from it is,
with a kernel in place of the bases (Huang, Rozo, Silverio & Caldwell, "Kernelized movement
primitives", IJRR 38(7), 2019, the mean prediction),

    r(s) = k(s) (K + lambda Sigma)^-1 mu,   K_ij = k(s_i, s_j) I,   Sigma = blockdiag(Sigma_n),

which is Gaussian process regression of the mean with the demonstrations' spread for noise. To pass
through a point, the reference has that point, with a small covariance, in place of its own at the
phase (ibid., on via-points): here the start x0 at s = 0 and the goal at s = 1. The kernel is the
squared exponential; its length and lambda are those of least error on demonstrations left out one
at a time. What runs is r(s) with the tracking controller of `ProMP`.

Deviations: the demonstrations are compared at equal phases, so that mu_n and Sigma_n are their
mean and covariance there, with no mixture fitted to them; positions alone are in the reference, no
velocities. Lengths are divided by the motion's root mean square: the kernel has a variance of 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any, ClassVar

import numpy as np

from iflow_gym.baselines.elementwise import exp_
from iflow_gym.baselines.starts import by_basis, from_start, with_one
from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.primitive import MovementPrimitive, PhaseState, tracked
from iflow_gym.system import Guarantee

LENGTHS = (0.02, 0.04, 0.08, 0.16)
"""Candidates for the kernel's length scale, in durations."""

STRENGTHS = (0.1, 1.0, 10.0)
"""Candidates for lambda."""

LENGTH, STRENGTH = 0.04, 1.0
"""Of a single demonstration, which leaves none to be left out."""

VIA_VARIANCE = 1e-6
"""Of a point to pass through, with lengths scaled to a mean square of 1."""

LEAST_VARIANCE = 1e-5
"""Of a reference point: demonstrations that agree are not followed more exactly than this."""


@dataclass(frozen=True)
class KMPConfig:
    """Settings of `KMP`."""

    n_reference: int = 100
    """N, phases of the reference, evenly from 0 to 1."""
    length_scale: float | None = None
    """Of the kernel, in durations; None leaves demonstrations out to choose it."""
    strength: float | None = None
    """lambda, what the reference's covariances are multiplied by; None chooses it likewise."""
    feedback: float = 20.0
    """Decay of the tracking error per unit of phase: 20 is a time constant of 5 % of the motion."""

    def __post_init__(self) -> None:
        if self.n_reference < 4:
            raise ValueError(f"Expected n_reference >= 4, got {self.n_reference}.")
        for field in ("length_scale", "strength", "feedback"):
            value = getattr(self, field)
            if value is not None and not 0 < value < np.inf:
                raise ValueError(f"Expected a finite {field} > 0, got {value}.")


class KMP(MovementPrimitive):
    """A kernel regression of the demonstrations' mean, led through the start and the goal.

    Attributes
    ----------
    means_ : array, shape (N, d)
        mu_n, as offsets from the goal, in length.
    covariances_ : array, shape (N, d, d)
        Sigma_n, in length^2.
    length_scale_ : float
        In durations.
    strength_ : float
        lambda.

    References
    ----------
    Huang, Rozo, Silverio & Caldwell, IJRR 38(7), 2019.

    Examples
    --------
    >>> from iflow_gym import load_lasa
    >>> primitive = KMP().fit(load_lasa("Angle"), seed=0)
    >>> primitive.rollout([-40.0, 30.0], n_steps=100, dt=0.03).shape
    (101, 2)
    """

    name: ClassVar[str] = "kmp"
    title: ClassVar[str] = "KMP"
    Config: ClassVar[type] = KMPConfig
    stochastic_fit: ClassVar[bool] = False
    not_learned: ClassVar[str] = "it is led through a start and a goal"

    def _fit(self, demonstrations: Demonstrations, rng: np.random.Generator) -> None:
        goal = demonstrations.attractor
        grid = np.linspace(0, 1, self.config.n_reference)
        paths = np.stack([_resampled(p - goal, grid) for p in demonstrations.positions])
        scale = float(np.sqrt(np.mean(paths**2)))
        length, strength = choose_kernel(
            paths / scale, self.config.length_scale, self.config.strength
        )
        means, covariances = reference(paths)
        self._adopt(means, covariances, length, strength, scale, goal)

    def _adopt(
        self,
        means: FloatArray,
        covariances: FloatArray,
        length: float,
        strength: float,
        scale: float,
        goal: FloatArray,
    ) -> None:
        self.means_, self.covariances_ = means, covariances
        self.length_scale_, self.strength_ = length, strength
        self._scale, self._goal = scale, goal
        alpha, lead = solved(means / scale, covariances / scale**2, length, strength)
        # r(s) = k(s) alpha, and alpha is an affine function of the point to begin at.
        self._alpha = by_basis(np.concatenate([scale * alpha[None], lead.transpose(2, 0, 1)]))
        self._grid = np.linspace(0, 1, len(means))

    # The motion ---------------------------------------------------------------------------

    def _begin(self, x: FloatArray, state: PhaseState) -> PhaseState:
        state = {**state, "factors": with_one(x - self._goal)}
        return {**state, **self._reached(state, state["phase"])}

    def _reached(self, state: PhaseState, phase: FloatArray) -> PhaseState:
        """Return r(s), as `_reference` does, and what s it is of: the next step begins there."""
        return {"reference": self._reference(state, phase), "reference_phase": phase}

    def _reference(self, state: PhaseState, phase: FloatArray) -> FloatArray:
        """Return r(s), shape (n, d), as an offset from the goal, which it is at from s = 1 on."""
        if (phase >= 1).all():
            return np.zeros((len(phase), self.n_dims_))
        curves = kernel(phase, self._grid, self.length_scale_) @ self._alpha
        path = from_start(curves, state["factors"])
        path[phase >= 1] = 0.0
        return path

    def _advance(
        self, x: FloatArray, state: PhaseState, phase: FloatArray, dt: FloatArray
    ) -> tuple[FloatArray, PhaseState]:
        if not np.array_equal(state["reference_phase"], state["phase"]):  # put there by a caller
            state = {**state, **self._reached(state, state["phase"])}
        there = self._reached(state, phase)
        elapsed = phase - state["phase"]
        references = state["reference"], there["reference"]
        offset = tracked(x - self._goal, *references, self.config.feedback, elapsed)
        return offset + self._goal, there

    @property
    def guarantee(self) -> Guarantee:
        """None: a clock drives it."""
        return Guarantee(
            "none",
            "a clock drives it, so that it is no autonomous system and has no Lyapunov function; "
            "that it ends at the goal follows from the clock alone, which goes on regardless of "
            "where the motion is",
        )

    def _arrays(self) -> dict[str, np.ndarray[Any, Any]]:
        return super()._arrays() | {
            "means": self.means_,
            "covariances": self.covariances_,
            "kernel": np.array([self.length_scale_, self.strength_, self._scale]),
        }

    def _restore(self, arrays: Mapping[str, np.ndarray[Any, Any]]) -> None:
        super()._restore(arrays)
        names = ("means", "covariances", "kernel")
        means, covariances, settings = (np.asarray(arrays[k], np.float64) for k in names)
        n, d = self.config.n_reference, self.n_dims_
        expected, came = [(n, d), (n, d, d), (3,)], [means.shape, covariances.shape, settings.shape]
        if came != expected:
            raise ValueError(f"expected {', '.join(names)} of shapes {expected}, got {came}")
        if not (settings > 0).all():
            raise ValueError(f"expected a length, lambda and a scale > 0, got {settings}")
        length, strength, scale = settings.tolist()
        if not (np.linalg.eigvalsh(covariances / scale**2) > -LEAST_VARIANCE / 2).all():
            raise ValueError("expected covariances that are positive semidefinite, got others")
        self._adopt(means, covariances, length, strength, scale, self.goal_)


def kernel(s: FloatArray, t: FloatArray, length: float) -> FloatArray:
    """Return exp(-(s_i - t_j)^2 / 2 length^2), shape (n, m)."""
    exponents = (s[:, None] - t) ** 2
    exponents *= -0.5 / length**2
    return exp_(exponents)


def reference(paths: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return mean, shape (N, d), and covariance, (N, d, d), of paths, shape (n, N, d), by phase."""
    means = paths.mean(axis=0)
    apart = paths - means
    return means, np.asarray(np.einsum("nki,nkj->kij", apart, apart) / len(paths))


def solved(
    means: FloatArray, covariances: FloatArray, length: float, strength: float
) -> tuple[FloatArray, FloatArray]:
    """Return alpha = (K + lambda Sigma)^-1 mu with the ends of mu led through points.

    Parameters
    ----------
    means : array, shape (N, d)
    covariances : array, shape (N, d, d)
    length, strength : float

    Returns
    -------
    alpha : array, shape (N, d)
        With both ends of mu at 0, where the goal is.
    lead : array, shape (N, d, d)
        What alpha grows by with the start, an offset from the goal.
    """
    n, d = means.shape
    sigma = covariances + LEAST_VARIANCE * np.eye(d)
    sigma[[0, -1]] = VIA_VARIANCE / strength * np.eye(d)
    grid = np.linspace(0, 1, n)
    matrix = np.kron(kernel(grid, grid, length), np.eye(d))
    blocks = matrix.reshape(n, d, n, d)
    blocks[np.arange(n), :, np.arange(n)] += strength * sigma
    right = np.zeros((n, d, 1 + d))
    right[1:-1, :, 0] = means[1:-1]
    right[0, :, 1:] = np.eye(d)
    found = np.linalg.solve(matrix, right.reshape(n * d, 1 + d)).reshape(n, d, 1 + d)
    return found[:, :, 0], found[:, :, 1:]


def choose_kernel(
    paths: FloatArray, length: float | None, strength: float | None
) -> tuple[float, float]:
    """Return the length scale and lambda of least squared error on paths left out.

    Parameters
    ----------
    paths : array, shape (n, N, d)
        At even phases, scaled to a mean square of 1.
    length, strength : float or None
        What is given is kept.
    """
    lengths = LENGTHS if length is None else (length,)
    strengths = STRENGTHS if strength is None else (strength,)
    if len(paths) == 1:
        return (length or LENGTH), (strength or STRENGTH)
    candidates = list(product(lengths, strengths))
    if len(candidates) == 1:
        return candidates[0]
    grid = np.linspace(0, 1, paths.shape[1])
    errors = np.zeros(len(candidates))
    for i, out in enumerate(paths):
        means, covariances = reference(np.delete(paths, i, axis=0))
        for j, (one, other) in enumerate(candidates):
            alpha, lead = solved(means, covariances, one, other)
            made = kernel(grid, grid, one) @ (alpha + lead @ out[0])
            errors[j] += np.sum((made - out) ** 2)
    return candidates[int(errors.argmin())]


def _resampled(path: FloatArray, grid: FloatArray) -> FloatArray:
    """Return a path at even phases, shape (N, d), by lines between its samples."""
    own = np.linspace(0, 1, len(path))
    return np.stack([np.interp(grid, own, column) for column in path.T], axis=1)
