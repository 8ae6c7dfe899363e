"""A rhythmic movement primitive whose phase is read from the state: a field round a learned orbit.

The orbit c(u), u in rounds, is a closed curve in the von Mises bases of rhythmic primitives
(Ijspeert, Nakanishi, Hoffmann, Pastor & Schaal, "Dynamical movement primitives: learning attractor
models for motor behaviors", Neural Computation 25(2), 2013, table 1), passed in the period T with
u = t / T. A primitive's clock is replaced by the phase u(x) of the point of the orbit that is
nearest to x, so that it becomes an autonomous system,

    dx/dt = c'(u(x)) / T + k (c(u(x)) - x),                                                   (1)

which circulates along the curve and converges to it: a guiding vector field by the Euclidean
distance (Rezende, Goncalves & Pimenta, "Constructive time-varying vector fields for robot
navigation", IEEE Transactions on Robotics 38(2), 2022) with the demonstrated tempo.

The distance D(x) = |x - c(u(x))| falls as exp(-k t) from everywhere: its gradient is
(x - c) / D, which is normal to c', so that dD/dt = -k D. Where several points of the orbit are
nearest the field jumps from one branch to another; D is continuous there, and each branch's
distance falls, so the least of them does. The same holds at any step: a step

    x(t + dt) = c(u + dt / T) + exp(-k dt) (x - c(u))                                         (2)

agrees with (1) to first order and leaves D(x(t + dt)) <= |x(t + dt) - c(u + dt / T)|
= exp(-k dt) D(x(t)).

Fitting. Rounds are cut and their phases aligned (`iflow_gym.phases`), and the curve is the ridge
regression of positions on the bases. Since a person's tempo varies within a round too, corners are
blurred in it: as for principal curves (Hastie & Stuetzle, Journal of the American Statistical
Association 84, 1989), samples are given the phase of the nearest point of the curve beside their
own, and the curve is fitted again, a few times. The phases so found do not pass evenly; the curve
is at last parametrised anew by the mean time that the samples take from phase to phase.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from iflow_gym.baselines.cycles import circular_bases, ridge_regression
from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.phases import common_phases
from iflow_gym.system import DynamicalSystem, Guarantee, check_positive_definite

N_POINTS = 1024
"""Points of the orbit among which the nearest is looked for first."""

CANDIDATES = 4
"""Nearest points whose neighbouring segments are searched for the nearest point of the orbit."""

NEWTON_STEPS = 3
"""From there on: its error, a hundredth of a round's thousandth, is squared by each."""

BESIDE = 0.1
"""How far from its own phase, in rounds, a sample's nearest point of the curve is looked for."""

LEAST_RIDGE = 1e-12
"""Of the last regression, which has no noise."""

LEAST_RATE = 0.2
"""The least mean pace of the phase, as a fraction of the mean: time does not stand still."""


@dataclass(frozen=True)
class OrbitFieldConfig:
    """Settings of `OrbitField`."""

    n_basis: int = 40
    """Bases of the orbit, for each dimension."""
    decay: float = 10.0
    """Rate at which the distance from the orbit falls, per period: k T."""
    n_projections: int = 5
    """Times that samples are given the phase of the nearest point and the curve is fitted again."""
    ridge: float = 1e-7
    """Of the regression of weights, per sample, in units of the features' mean square."""

    def __post_init__(self) -> None:
        for field, least in (("n_basis", 4), ("n_projections", 0)):
            if type(value := getattr(self, field)) is not int or value < least:
                raise ValueError(f"Expected a whole number {field} >= {least}, got {value!r}.")
        for field in ("decay", "ridge"):
            if not 0 < (value := getattr(self, field)) < np.inf:
                raise ValueError(f"Expected a finite {field} > 0, got {value}.")


class OrbitField(DynamicalSystem):
    """A field that circulates along a learned closed curve and converges to it.

    Attributes
    ----------
    weights_ : array, shape (n_basis, d)
        Of the orbit's bases, in length; phases are even in time.
    noise_ : array, shape (d, d)
        Covariance of what a step of a second leaves unexplained, length²/s: the diffusion of
        Gaussian transitions around (2).

    Examples
    --------
    >>> import numpy as np
    >>> from iflow_gym import Demonstrations
    >>> angle = np.linspace(0, 8 * np.pi, 801)
    >>> circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    >>> system = OrbitField().fit(Demonstrations.from_arrays([circle], dt=0.01, period=2), seed=0)
    >>> end = system.rollout([3.0, 0.0], n_steps=400, dt=0.01)[-1]
    >>> round(float(np.linalg.norm(end)), 2)
    1.0
    """

    name: ClassVar[str] = "orbit-field"
    title: ClassVar[str] = "Orbit field"
    Config: ClassVar[type] = OrbitFieldConfig
    stochastic_fit: ClassVar[bool] = False
    integrator: ClassVar[str] = "along the orbit, its distance decaying exactly"
    learns_goals: ClassVar[bool] = False
    learns_cycles: ClassVar[bool] = True
    not_learned: ClassVar[str] = "its systems go round a closed curve"

    def _fit(self, demonstrations: Demonstrations, rng: np.random.Generator) -> None:
        if demonstrations.n_dims < 2:
            raise ValueError(
                "Expected a motion in at least 2 dimensions, where a closed curve need not pass a "
                "point twice, got 1."
            )
        period = demonstrations.period
        assert period is not None
        self._adopt(self._fitted_weights(demonstrations, period), period)
        left, time = [], 0.0
        for positions, dt in zip(demonstrations.positions, demonstrations.dt, strict=True):
            steps = np.full(len(positions) - 1, dt)
            left.append(positions[1:] - self._step(positions[:-1], steps))
            time += float(steps.sum())
        errors = np.concatenate(left)
        floor = (1e-9 * demonstrations.bounding_box.diagonal) ** 2 / period
        self.noise_ = errors.T @ errors / time + floor * np.eye(errors.shape[1])

    def _fitted_weights(self, demonstrations: Demonstrations, period: float) -> FloatArray:
        """Return weights of the orbit, shape (n_basis, d), for phases that are even in time."""
        own = common_phases(demonstrations)
        points = np.concatenate(demonstrations.positions)
        assigned = np.concatenate(own)
        grid = np.arange(N_POINTS) / N_POINTS
        for again in range(self.config.n_projections + 1):
            features = circular_bases(assigned, self.config.n_basis)
            weights = ridge_regression(features, points, self.config.ridge)
            curve = circular_bases(grid, self.config.n_basis) @ weights
            if again < self.config.n_projections:
                assigned = _projected(points, assigned, curve)
        # The mean pace of the phase along the curve, du/dt in rounds a period.
        ends = np.cumsum([len(u) for u in own])[:-1]
        rates = [
            np.gradient(np.unwrap(u, period=1.0), dt / period)
            for u, dt in zip(np.split(assigned, ends), demonstrations.dt, strict=True)
        ]
        pace = circular_bases(grid, self.config.n_basis) @ ridge_regression(
            features, np.concatenate(rates)[:, None], self.config.ridge
        )
        times = np.cumsum(1 / np.maximum(pace[:, 0], LEAST_RATE * pace.mean()))
        times = np.concatenate([[0.0], times / times[-1]])
        even = np.interp(grid, times, np.append(grid, 1.0))
        curve = circular_bases(even, self.config.n_basis) @ weights
        return ridge_regression(circular_bases(grid, self.config.n_basis), curve, LEAST_RIDGE)

    def _adopt(self, weights: FloatArray, period: float) -> None:
        self.weights_, self._seconds = weights, period
        grid = np.arange(N_POINTS + 1) / N_POINTS
        points = circular_bases(grid, self.config.n_basis) @ weights
        points[-1] = points[0]
        self._curve = CubicSpline(grid, points, bc_type="periodic")
        self._points, self._sides = points[:-1], np.diff(points, axis=0)
        self._tree = cKDTree(self._points)
        self._decay = self.config.decay / period

    def _nearest(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the phase of the orbit's nearest point, shape (n,), and the point, (n, d)."""
        _, found = self._tree.query(x, k=CANDIDATES)
        segments = np.concatenate([found, (found - 1) % N_POINTS], axis=1)  # (n, 8)
        starts, sides = self._points[segments], self._sides[segments]
        squares = np.einsum("nki,nki->nk", sides, sides)
        share = np.einsum("nki,nki->nk", x[:, None] - starts, sides)
        share = np.clip(share / np.where(squares > 0, squares, 1.0), 0.0, 1.0)
        points = starts + share[..., None] * sides
        best = np.square(x[:, None] - points).sum(axis=2).argmin(axis=1)
        rows = np.arange(len(x))
        phase = (segments[rows, best] + share[rows, best]) / N_POINTS
        for _ in range(NEWTON_STEPS):
            away, along = x - self._curve(phase), self._curve(phase, 1)
            bend = np.square(along).sum(axis=1) - (away * self._curve(phase, 2)).sum(axis=1)
            step = (away * along).sum(axis=1) / np.where(bend > 0, bend, np.inf)
            phase = phase + np.clip(step, -1 / N_POINTS, 1 / N_POINTS)
        return phase, np.asarray(self._curve(phase))

    def _velocity(self, x: FloatArray) -> FloatArray:
        phase, point = self._nearest(x)
        return np.asarray(self._curve(phase, 1) / self._seconds + self._decay * (point - x))

    def _step(self, x: FloatArray, dt: FloatArray) -> FloatArray:
        phase, point = self._nearest(x)
        ahead = self._curve(phase + dt / self._seconds)
        return np.asarray(ahead + np.exp(-self._decay * dt)[:, None] * (x - point))

    def _lyapunov(self, x: FloatArray) -> FloatArray:
        return np.asarray(np.square(x - self._nearest(x)[1]).sum(axis=1))

    def _lyapunov_rate(self, x: FloatArray) -> FloatArray:
        return np.asarray(-2 * self._decay * self._lyapunov(x))

    def _log_prob(self, x: FloatArray, x_next: FloatArray, dt: float) -> FloatArray:
        error = x_next - self._step(x, np.full(len(x), dt))
        root = np.linalg.cholesky(self.noise_ * dt)
        whitened = np.linalg.solve(root, error.T)
        constant = 0.5 * len(root) * np.log(2 * np.pi) + np.log(np.diag(root)).sum()
        return np.asarray(-0.5 * np.square(whitened).sum(axis=0) - constant)

    @property
    def guarantee(self) -> Guarantee:
        """Proved: the distance from the orbit falls at a known rate from every state."""
        self._require_fit()
        return Guarantee(
            "proved",
            "the distance from the orbit falls as exp(-k t) from every state, with k = "
            f"{self._decay:.3g} / s, at every step of any length: the field pulls straight to the "
            "nearest point, and is discontinuous where two are equally near",
        )

    def _arrays(self) -> dict[str, np.ndarray[Any, Any]]:
        return {"weights": self.weights_, "noise": self.noise_}

    def _restore(self, arrays: Mapping[str, np.ndarray[Any, Any]]) -> None:
        weights, noise = (np.asarray(arrays[k], dtype=np.float64) for k in ("weights", "noise"))
        n_basis, d = self.config.n_basis, self.n_dims_
        if weights.shape != (n_basis, d) or noise.shape != (d, d):
            raise ValueError(
                f"expected weights {(n_basis, d)} and a noise {(d, d)}, got {weights.shape} and "
                f"{noise.shape}"
            )
        check_positive_definite(noise, "noise")
        if self.period_ is None:
            raise ValueError("expected the period of a motion that repeats, got none")
        self._adopt(weights, self.period_)
        self.noise_ = noise


def _projected(points: FloatArray, own: FloatArray, curve: FloatArray) -> FloatArray:
    """Return the phases, shape (n,), at which a curve, shape (m, d), is nearest beside `own`."""
    m = len(curve)
    reach = round(BESIDE * m)
    around = np.rint(own * m).astype(np.intp)[:, None] + np.arange(-reach, reach + 1)
    best = np.empty(len(points), dtype=np.intp)
    for rows in np.array_split(np.arange(len(points)), max(1, len(points) // 2000)):
        squares = np.square(curve[around[rows] % m] - points[rows, None]).sum(axis=2)
        best[rows] = squares.argmin(axis=1)
    return np.asarray(around[np.arange(len(points)), best] / m)
