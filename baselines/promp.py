"""Probabilistic movement primitives, conditioned on the start.

A motion is a weighted sum of bases of the phase, y(s) = w^T phi(s), and demonstrations are samples
of a Gaussian over w (Paraschos, Daniel, Peters & Neumann, "Using probabilistic movement primitives
in robotics", Autonomous Robots 42, 2018). Each demonstration's weights are found by
ridge regression, and the Gaussian is their mean and covariance. To begin at x0 it is conditioned,

    E[w | x0] = mu_w + Sigma_w Psi (Psi^T Sigma_w Psi + Sigma_y)^-1 (x0 - Psi^T mu_w),  Psi = Phi(0)

(Paraschos, Daniel, Peters & Neumann, "Probabilistic movement primitives", NIPS 2013, eq. (5)). What
runs is the conditional mean r(s) with a tracking controller,

    dx/ds = dr/ds - feedback (x - r(s)),

in closed form for any step. It is what a user runs on a robot that takes velocities. The stochastic
controller of the papers has, for such a plant, the gain cov(y', y) cov(y)^-1: repelling where the
demonstrations spread, undefined where they meet, and of no use after a push that none shows.

A motion that repeats has circular bases (ibid.) and a round for a sample of w. Its mean
orbit is tracked from the phase at which it is nearest to the start: conditioning would carry the
offset of a start beside the orbit round with it for ever.

Deviations: the recorded starts stand for Psi^T w, from which they differ by the residual of the
regression. A start beyond the demonstrated ones is conditioned on as far as they reach (see
`starts`), and the rest of its offset fades as a minimum-jerk curve does. What the end lacks of the
goal is added by such a curve, so that the motion ends there exactly.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from iflow_gym.baselines.bases import normalised
from iflow_gym.baselines.cycles import circular_bases, nearest_phase, ridge_regression
from iflow_gym.baselines.starts import EXACTNESS, GivenStart, by_basis, from_start, minimum_jerk
from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.phases import common_phases
from iflow_gym.primitive import MovementPrimitive, PhaseState, tracked
from iflow_gym.system import Guarantee

OVERLAP = 0.7
"""Value of a basis half way to its neighbour."""

NEARLY = 0.05
"""A round that lacks less than this is whole."""

RIDGE = 1e-10
"""Of the regression of weights, per sample."""

ORBIT = 400
"""Phases at which a cycle is looked at to find the one nearest to the start."""


@dataclass(frozen=True)
class ProMPConfig:
    """Settings of `ProMP`."""

    n_basis: int = 40
    """Bases, for each dimension."""
    feedback: float = 20.0
    """Decay of the tracking error per unit of phase: 20 is a time constant of 5 % of the motion."""

    def __post_init__(self) -> None:
        if self.n_basis < 4:
            raise ValueError(f"Expected n_basis >= 4, got {self.n_basis}.")
        if not 0 < self.feedback < np.inf:
            raise ValueError(f"Expected a finite feedback > 0, got {self.feedback}.")


class ProMP(MovementPrimitive):
    """A Gaussian over motions, whose mean given the start is tracked.

    Attributes
    ----------
    mean_ : array, shape (d, n_basis)
        mu_w, of offsets from the goal (of a cycle, from its mean), in length.
    deviations_ : array, shape (n, d, n_basis)
        What the n demonstrations, or rounds, differ by; ``covariance_`` is theirs.

    References
    ----------
    Paraschos, Daniel, Peters & Neumann, NIPS 2013 and Autonomous Robots 42, 2018.

    Examples
    --------
    >>> from iflow_gym import load_lasa
    >>> primitive = ProMP().fit(load_lasa("Angle"), seed=0)
    >>> primitive.rollout([-40.0, 30.0], n_steps=100, dt=0.03).shape
    (101, 2)
    """

    name: ClassVar[str] = "promp"
    title: ClassVar[str] = "ProMP"
    Config: ClassVar[type] = ProMPConfig
    stochastic_fit: ClassVar[bool] = False
    learns_cycles: ClassVar[bool] = True

    def _fit(self, demonstrations: Demonstrations, rng: np.random.Generator) -> None:
        rhythmic = demonstrations.period is not None
        centre = (
            np.concatenate(demonstrations.positions).mean(axis=0)
            if demonstrations.goal is None
            else demonstrations.goal
        )
        motions = (
            _rounds(demonstrations, self.config.n_basis)
            if rhythmic
            else [(np.linspace(0, 1, len(p)), p) for p in demonstrations.positions]
        )
        shape = circular_bases if rhythmic else bases
        weights = np.stack(
            [
                ridge_regression(shape(s, self.config.n_basis), y - centre, RIDGE).T
                for s, y in motions
            ]
        )
        mean = weights.mean(axis=0)
        self._adopt(mean, weights - mean, centre, None if rhythmic else demonstrations.starts)

    def _adopt(
        self,
        mean: FloatArray,
        deviations: FloatArray,
        centre: FloatArray,
        starts: FloatArray | None,
    ) -> None:
        """Take the Gaussian; `starts`, shape (n, d), are those of a motion that ends."""
        self.mean_, self.deviations_ = mean, deviations
        self._centre, self._rhythmic = centre, starts is None
        if starts is None:
            phase = np.arange(ORBIT) / ORBIT
            self._orbit = circular_bases(phase, self.config.n_basis) @ mean.T
            return
        weights = (mean + deviations).transpose(0, 2, 1)
        self._given_start = GivenStart.fit(starts - centre, weights.reshape(len(weights), -1))
        self._weights = by_basis(self._given_start.coefficients.reshape(-1, *weights.shape[1:]))
        self._last = bases(np.ones(1), self.config.n_basis) @ self._weights

    @property
    def covariance_(self) -> FloatArray:
        """Sigma_w, shape (d n_basis, d n_basis), in length^2, dimension by dimension."""
        flat = self.deviations_.reshape(len(self.deviations_), -1)
        return np.asarray(flat.T @ flat / len(flat))

    def condition(
        self, phase: float, position: ArrayLike, variance: float | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the Gaussian over w given that the motion passes a position at a phase.

        NIPS 2013, eq. (5) and (6), as they stand: however far the position is.

        Parameters
        ----------
        phase : float
        position : array, shape (d,), in length
        variance : float, length^2, optional
            Of the position, Sigma_y; by default a small part of the motions' variance there.

        Returns
        -------
        mean : array, shape (d, n_basis)
        covariance : array, shape (d n_basis, d n_basis)

        Raises
        ------
        ValueError
            If the position has another shape.
        """
        self._require_fit()
        d = self.n_dims_
        psi = np.kron(np.eye(d), self._bases(np.array([phase])).T)  # (d n_basis, d)
        sigma = self.covariance_
        there = psi.T @ sigma @ psi
        noise = EXACTNESS * np.trace(there) / d if variance is None else variance
        gain = np.linalg.solve(there + noise * np.eye(d), psi.T @ sigma).T
        mean = self.mean_.ravel()
        if np.shape(position) != (d,):
            raise ValueError(f"Expected a position of shape {(d,)}, got {np.shape(position)}.")
        offset = np.asarray(position, dtype=np.float64) - self._centre
        conditional = mean + gain @ (offset - psi.T @ mean)
        return conditional.reshape(d, -1), np.asarray(sigma - gain @ psi.T @ sigma)

    def _bases(self, phase: FloatArray) -> FloatArray:
        shape = circular_bases if self._rhythmic else bases
        return shape(phase, self.config.n_basis)

    # The motion ---------------------------------------------------------------------------

    def _begin(self, x: FloatArray, state: PhaseState) -> PhaseState:
        offset = x - self._centre
        if self._rhythmic:
            state = {**state, "phase": nearest_phase(offset, self._orbit)}
        else:
            factors, rest = self._given_start.factors(offset)
            state = {**state, "factors": factors, "rest": rest}
        return {**state, **self._reached(state, state["phase"])}

    def _reached(self, state: PhaseState, phase: FloatArray) -> PhaseState:
        """Return r(s), as `_reference` does, and what s it is of: the next step begins there."""
        return {"reference": self._reference(state, phase), "reference_phase": phase}

    def _reference(self, state: PhaseState, phase: FloatArray) -> FloatArray:
        """Return r(s), shape (n, d), as an offset from the goal or the cycle's mean.

        It is at the goal from s = 1 on.
        """
        if self._rhythmic:
            return self._bases(phase) @ self.mean_.T
        if (phase >= 1).all():
            return np.zeros_like(state["rest"])
        done = minimum_jerk(phase)[:, None]
        curves = self._bases(phase) @ self._weights - done * self._last
        path = from_start(curves, state["factors"]) + (1 - done) * state["rest"]
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
        offset = tracked(x - self._centre, *references, self.config.feedback, elapsed)
        return offset + self._centre, there

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
        own = {"mean": self.mean_, "deviations": self.deviations_}
        return super()._arrays() | own

    def _restore(self, arrays: Mapping[str, np.ndarray[Any, Any]]) -> None:
        super()._restore(arrays)
        mean, deviations = (np.asarray(arrays[k], np.float64) for k in ("mean", "deviations"))
        n, shape = len(np.atleast_1d(deviations)), (self.n_dims_, self.config.n_basis)
        expected, came = [shape, (n, *shape)], [mean.shape, deviations.shape]
        if n < 1 or came != expected:
            raise ValueError(
                f"expected mean and deviations of shapes {expected} with n >= 1, got {came}"
            )
        if self.period_ is None and n != len(self.starts_):
            raise ValueError(f"expected {len(self.starts_)} deviations, one a start, got {n}")
        self._adopt(mean, deviations, self.goal_, self.starts_ if self.period_ is None else None)


def bases(phase: FloatArray, n_basis: int) -> FloatArray:
    """Return Gaussian bases that sum to 1, shape (n, n_basis), of phases, shape (n,).

    Centres are spaced evenly from 0 to 1.
    """
    exponents = (phase[:, None] - _centres(n_basis)) ** 2
    exponents *= 4 * n_basis**2 * math.log(OVERLAP)
    return normalised(exponents)


@lru_cache
def _centres(n_basis: int) -> FloatArray:
    return np.linspace(0, 1, n_basis)


def _rounds(demonstrations: Demonstrations, n_basis: int) -> list[tuple[FloatArray, FloatArray]]:
    """Return phases and positions of each whole round, and of recordings shorter than one."""
    found = []
    for s, p in zip(common_phases(demonstrations), demonstrations.positions, strict=True):
        done = s - s[0] + 1e-9  # so that rounding does not put a round's first sample before it
        n_rounds = max(1, int(done[-1] + NEARLY))
        number = np.minimum(np.floor(done), n_rounds - 1)
        found += [(s[number == k], p[number == k]) for k in range(n_rounds)]
    return found
