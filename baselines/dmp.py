"""Dynamic movement primitives, discrete and rhythmic.

A critically damped spring pulls to the goal, and a forcing term that a phase drives makes the
shape of the way (Ijspeert, Nakanishi, Hoffmann, Pastor & Schaal, "Dynamical movement primitives:
learning attractor models for motor behaviors", Neural Computation 25(2), 2013, eq. (2.1)-(2.3); in
the form of Pastor, Hoffmann, Asfour & Schaal, "Learning and generalization of motor skills by
learning from demonstration", ICRA 2009, whose forces do not grow with g - y0 and whose
spring does not jump at the start). With ' = d/ds, s the time in durations, beta = alpha / 4 and
z = exp(-alpha_z s):

    y'' = alpha (beta (g - y) - y' - beta (g - y0) z) + f(z),
    f(z) = z sum_i psi_i(z) w_i / sum_i psi_i(z).

Forces are read off each demonstration, f = y'' - alpha (...), and its weights are found by ridge
regression. Here all demonstrations are used: the weights, and the first y', are their conditional
mean given the start (`starts`).

A motion that repeats has circular bases, no factor z, the mean of its samples for a goal, and is
fitted to all recordings at once, their phases aligned (2013, table 1, right column).

The system goes on from where the mass is: y is observed at every step, y' is the primitive's own.
A step is exact for the forces at its middle.

Deviations: the forces end with the motion, z = 0 beyond s = 1, where the spring alone holds the
goal. In the source they fade with z, which recordings that end while they still move make slow:
stopping takes forces that are large where z is small. A round of a rhythmic motion is the unit of
phase, where the source has 2 pi.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np

from iflow_gym.baselines.bases import normalised
from iflow_gym.baselines.cycles import circular_bases, nearest_phase, ridge_regression
from iflow_gym.baselines.starts import GivenStart, by_basis, from_start
from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.phases import common_phases
from iflow_gym.primitive import MovementPrimitive, PhaseState
from iflow_gym.system import Guarantee

LAST_PHASE = 0.01
"""z at the end of the motion: alpha_z = -log of it."""

OVERLAP = 0.8
"""Value of a discrete basis at its neighbour's centre."""

ORBIT = 400
"""Phases at which a cycle is looked at to find the one nearest to the start."""

ROUNDS = 4
"""Rounds after which a rhythmic primitive, begun anywhere, is on its orbit."""


@dataclass(frozen=True)
class DMPConfig:
    """Settings of `DMP`."""

    n_basis: int = 40
    """Bases of the forcing term, for each dimension."""
    alpha: float = 25.0
    """Damping of the spring, per unit of phase; beta is a quarter of it. Offsets fall by a factor
    exp(-alpha / 2) in the motion's duration, after the phase's own decay."""
    ridge: float = 1e-7
    """Of the regression of weights, per sample, in units of the features' mean square."""

    def __post_init__(self) -> None:
        if self.n_basis < 4:
            raise ValueError(f"Expected n_basis >= 4, got {self.n_basis}.")
        for field in ("alpha", "ridge"):
            if not 0 < (value := getattr(self, field)) < np.inf:
                raise ValueError(f"Expected a finite {field} > 0, got {value}.")


class DMP(MovementPrimitive):
    """A spring to the goal with a forcing term that the phase drives.

    Attributes
    ----------
    given_start_ : GivenStart or None
        Of weights, shape (n_basis, d), and the first y', shape (d,), as one vector, in length: its
        `coefficients` are what they are made of. None for a motion that repeats.
    weights_ : array, shape (n_basis, d)
        Of a motion that repeats; of one that ends, the mean start's.

    References
    ----------
    Ijspeert et al., Neural Computation 25(2), 2013; Pastor et al., ICRA 2009.

    Examples
    --------
    >>> from iflow_gym import load_lasa
    >>> primitive = DMP().fit(load_lasa("Angle"), seed=0)
    >>> primitive.rollout([-40.0, 30.0], n_steps=100, dt=0.03).shape
    (101, 2)
    """

    name: ClassVar[str] = "dmp"
    title: ClassVar[str] = "DMP"
    Config: ClassVar[type] = DMPConfig
    stochastic_fit: ClassVar[bool] = False
    learns_cycles: ClassVar[bool] = True

    def _fit(self, demonstrations: Demonstrations, rng: np.random.Generator) -> None:
        n_basis, ridge = self.config.n_basis, self.config.ridge
        if demonstrations.goal is None:
            centre = np.concatenate(demonstrations.positions).mean(axis=0)
            aligned = common_phases(demonstrations)
            forces = [self._forces(demonstrations, i, centre) for i in range(len(aligned))]
            features = circular_bases(np.concatenate(aligned), n_basis)
            self._adopt_cycle(ridge_regression(features, np.concatenate(forces), ridge), centre)
            return
        goal, found = demonstrations.goal, []
        for i, positions in enumerate(demonstrations.positions):
            s = np.linspace(0, 1, len(positions))
            weights = ridge_regression(
                discrete_bases(s, n_basis), self._forces(demonstrations, i, goal), ridge
            )
            first = demonstrations.velocities[i][0] * demonstrations.durations[i]
            found.append(np.concatenate([weights.ravel(), first]))
        self._adopt(GivenStart.fit(demonstrations.starts - goal, np.stack(found)), goal)

    def _forces(self, demonstrations: Demonstrations, i: int, goal: FloatArray) -> FloatArray:
        """Return the forces that recording i asks for, shape (T_i, d), in length."""
        period = demonstrations.period
        duration = demonstrations.durations[i] if period is None else period
        y = demonstrations.positions[i] - goal
        velocity = demonstrations.velocities[i] * duration
        step = demonstrations.dt[i] / duration
        acceleration = np.gradient(velocity, step, axis=0)
        alpha = self.config.alpha
        spring = -y
        if period is None:
            z = phase_variable(np.asarray(np.arange(len(y)) * step))
            spring = spring + y[0] * z[:, None]  # g - y0 is -y[0] from the goal
        return np.asarray(acceleration - alpha * (0.25 * alpha * spring - velocity))

    def _adopt(self, given_start: GivenStart, goal: FloatArray) -> None:
        self.given_start_: GivenStart | None = given_start
        d = len(goal)
        self.weights_ = given_start.mean[:-d].reshape(-1, d)
        weights = given_start.coefficients[:, :-d].reshape(-1, *self.weights_.shape)
        self._weights = by_basis(weights)
        self._centre = goal

    def _adopt_cycle(self, weights: FloatArray, centre: FloatArray) -> None:
        self.given_start_, self.weights_, self._centre = None, weights, centre
        # The orbit: where the motion is a few rounds after it began anywhere.
        y, velocity = np.zeros((1, len(centre))), np.zeros((1, len(centre)))
        step, orbit = np.full(1, 1 / ORBIT), []
        targets = self._circular((np.arange(ORBIT) + 0.5) / ORBIT)
        for k in range(ROUNDS * ORBIT):
            orbit.append((y[0], velocity[0]))
            y, velocity = self._moved(y, velocity, targets[k % ORBIT], step)
        self._orbit, self._orbit_velocity = (np.stack(a[-ORBIT:]) for a in zip(*orbit, strict=True))

    def _circular(self, phase: FloatArray) -> FloatArray:
        """Return where the spring pulls to, shape (n, d), at phases of a cycle, shape (n,)."""
        return circular_bases(phase, self.config.n_basis) @ self.weights_ / self._stiffness

    @property
    def _stiffness(self) -> float:
        return 0.25 * float(self.config.alpha) ** 2

    # The motion ---------------------------------------------------------------------------

    def _begin(self, x: FloatArray, state: PhaseState) -> PhaseState:
        offset = x - self._centre
        if self.given_start_ is None:
            phase = nearest_phase(offset, self._orbit)
            velocity = self._orbit_velocity[np.rint(phase * ORBIT).astype(int) % ORBIT]
            return {**state, "phase": phase, "velocity": velocity}
        factors, _ = self.given_start_.factors(offset)
        velocity = factors @ self.given_start_.coefficients[:, -x.shape[1] :]
        return {**state, "start": offset, "factors": factors, "velocity": velocity}

    def _advance(
        self, x: FloatArray, state: PhaseState, phase: FloatArray, dt: FloatArray
    ) -> tuple[FloatArray, PhaseState]:
        elapsed = phase - state["phase"]
        middle = state["phase"] + 0.5 * elapsed
        cycle = self.given_start_ is None
        target = self._circular(middle) if cycle else self._target(state, middle)
        y, velocity = self._moved(x - self._centre, state["velocity"], target, elapsed)
        return y + self._centre, {"velocity": velocity}

    def _target(self, state: PhaseState, phase: FloatArray) -> FloatArray:
        """Return where the spring pulls to, shape (n, d): the goal once the forces have ended."""
        if (phase > 1).all():
            return np.zeros_like(state["start"])
        curves = discrete_bases(phase, self.config.n_basis) @ self._weights
        force = from_start(curves, state["factors"])
        target = phase_variable(phase)[:, None] * state["start"] + force / self._stiffness
        target[phase > 1] = 0.0
        return target

    def _moved(
        self, y: FloatArray, velocity: FloatArray, target: FloatArray, elapsed: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return y and y' after a time in which a critically damped spring pulls to `target`."""
        rate = 0.5 * self.config.alpha
        s = elapsed[:, None]
        error = y - target
        drift = velocity + rate * error
        decay = np.exp(-rate * s)
        return target + decay * (error + s * drift), decay * (velocity - rate * s * drift)

    @property
    def guarantee(self) -> Guarantee:
        """None: a clock drives it."""
        return Guarantee(
            "none",
            "a clock drives it, so that it is no autonomous system and has no Lyapunov function "
            "of the position; that it ends at the goal follows from the forces' end with the "
            "clock, which goes on regardless of where the motion is",
        )

    def _arrays(self) -> dict[str, np.ndarray[Any, Any]]:
        if self.given_start_ is None:
            return super()._arrays() | {"weights": self.weights_}
        return super()._arrays() | self.given_start_.arrays()

    def _restore(self, arrays: Mapping[str, np.ndarray[Any, Any]]) -> None:
        super()._restore(arrays)
        n_basis, d = self.config.n_basis, self.n_dims_
        if self.period_ is None:
            self._adopt(GivenStart.restore(arrays, n_basis * d + d, d), self.goal_)
            return
        weights = np.asarray(arrays["weights"], dtype=np.float64)
        if weights.shape != (n_basis, d):
            raise ValueError(f"expected weights of shape {(n_basis, d)}, got {weights.shape}")
        self._adopt_cycle(weights, self.goal_)


def phase_variable(phase: FloatArray) -> FloatArray:
    """Return z, shape (n,), at times in durations: the canonical system, 2013, eq. (2.2)."""
    return np.asarray(np.exp(np.log(LAST_PHASE) * phase))


def discrete_bases(phase: FloatArray, n_basis: int) -> FloatArray:
    """Return z psi_i(z) / sum psi, shape (n, n_basis), at times in durations, shape (n,).

    Centres lie evenly in time; each basis is as wide as its neighbour's centre is far.
    """
    z = phase_variable(phase)[:, None]
    centres, widths = _centres_and_widths(n_basis)
    exponents = (z - centres) ** 2
    exponents *= -widths
    return normalised(exponents) * z


@lru_cache
def _centres_and_widths(n_basis: int) -> tuple[FloatArray, FloatArray]:
    centres = phase_variable(np.linspace(0, 1, n_basis))
    gaps = np.diff(centres)
    return centres, -np.log(OVERLAP) / np.append(gaps, gaps[-1]) ** 2
