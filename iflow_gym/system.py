"""Method and DynamicalSystem: the contract that every method keeps.

A method learns a motion from demonstrations. It implements `_fit`, gives its parameters as arrays
for files, and states its guarantee. A `DynamicalSystem` learns an autonomous system dx/dt = f(x)
and implements `_velocity` too (and `_step` where it has a closed form); the other kind of method,
which uses time, is `iflow_gym.primitive.MovementPrimitive`. Shapes are checked here, once, so that
methods need not.
"""

from __future__ import annotations

import dataclasses
import operator
import os
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, Self, SupportsIndex, get_args

import numpy as np
from numpy.typing import ArrayLike

from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.model_files import (
    ModelFileError,
    model_file_errors,
    read_model_file,
    write_model_file,
)

SYMMETRIC = 1e-9
"""How far a covariance may be from symmetric, with variances scaled to 1: rounding."""

GuaranteeKind = Literal["none", "sampled", "verified", "proved"]
GUARANTEE_KINDS: tuple[GuaranteeKind, ...] = get_args(GuaranteeKind)
"""From the weakest to the strongest."""


@dataclass(frozen=True)
class Guarantee:
    """What is known about stability, and why.

    ``proved``: by construction, for every state. ``verified``: checked on a bounded region with
    an error bound. ``sampled``: seen to hold where it was tried. ``none``: nothing is claimed.
    """

    kind: GuaranteeKind
    reason: str

    def __post_init__(self) -> None:
        if self.kind not in (kinds := GUARANTEE_KINDS):
            raise ValueError(f"Expected a guarantee of kind {', '.join(kinds)}, got {self.kind!r}.")
        if not (isinstance(self.reason, str) and self.reason.strip()):
            raise ValueError(f"Expected the reason of the guarantee, got {self.reason!r}.")


class NotFittedError(RuntimeError):
    """A method was asked for what it has learned before `fit`."""


class Method(ABC):
    """Something that learns a motion from demonstrations: settings, fitting, files, guarantee.

    Methods derive from one of its kinds, `DynamicalSystem` or `MovementPrimitive`.

    Attributes
    ----------
    n_dims_ : int
        Dimension d of the state, set by `fit`.
    goal_ : array, shape (d,)
        The demonstrations' goal, set by `fit`; of a motion that repeats, the mean of its samples.
    period_ : float or None
        Seconds a round, set by `fit`; None for a motion that ends.
    """

    name: ClassVar[str]
    """The method's name in tables and files."""
    title: ClassVar[str]
    """The method's name as people write it."""
    Config: ClassVar[type[Any]]
    """A frozen dataclass of the method's settings."""
    stochastic_fit: ClassVar[bool] = True
    """Whether the seed changes the fit."""
    integrator: ClassVar[str] = "explicit Euler"
    """How the next state is found: recorded with every score."""
    uses_time: ClassVar[bool] = False
    """Whether a command depends on the time since the start, and not on the state alone."""
    learns_goals: ClassVar[bool] = True
    """Whether `fit` takes demonstrations that end at a goal."""
    learns_cycles: ClassVar[bool] = False
    """Whether `fit` takes demonstrations that repeat with a period."""
    not_learned: ClassVar[str] = "its systems end at a goal"
    """Why it does not learn motions of the other kind, for tables; a clause."""

    def __init__(self, config: Any = None, **settings: Any) -> None:
        """Store the settings: a `Config`, or its fields by name, or both (names win)."""
        base: Any = self.Config() if config is None else config
        if not isinstance(base, self.Config):
            raise TypeError(
                f"Expected a {self.Config.__name__} for {type(self).__name__}, got {base!r}."
            )
        known = [f.name for f in dataclasses.fields(self.Config)]
        if unknown := sorted(set(settings) - set(known)):
            raise TypeError(
                f"Unknown settings {unknown} for {type(self).__name__}; known: {', '.join(known)}."
            )
        self.config = dataclasses.replace(base, **settings)

    # Fitting ------------------------------------------------------------------------------

    def fit(self, demonstrations: Demonstrations, *, seed: int) -> Self:
        """Learn from demonstrations; the same seed gives the same fit on the same machine."""
        self._check_demonstrations(demonstrations)
        self._fit(demonstrations, np.random.default_rng(seed))
        return self._fitted(demonstrations)

    def fit_many(
        self, demonstrations: Sequence[Demonstrations], *, seeds: Sequence[int]
    ) -> list[Self]:
        """Learn one motion for each entry of `demonstrations`, with the seed beside it.

        Methods that train faster together override `_fit_many`; the default is a loop.
        """
        if len(demonstrations) != len(seeds):
            raise ValueError(
                f"Expected a seed for each of {len(demonstrations)} sets of demonstrations, "
                f"got {len(seeds)}."
            )
        for entry in demonstrations:
            self._check_demonstrations(entry)
        systems = self._fit_many(demonstrations, seeds)
        return [s._fitted(d) for s, d in zip(systems, demonstrations, strict=True)]

    def _fit_many(
        self, demonstrations: Sequence[Demonstrations], seeds: Sequence[int]
    ) -> list[Self]:
        clones = [type(self)(self.config) for _ in seeds]
        return [c.fit(d, seed=s) for c, d, s in zip(clones, demonstrations, seeds, strict=True)]

    def _check_demonstrations(self, demonstrations: Demonstrations) -> None:
        if not isinstance(demonstrations, Demonstrations):
            raise TypeError(
                f"Expected Demonstrations, got {type(demonstrations).__name__}: make them with "
                "Demonstrations.from_arrays(...)."
            )
        if demonstrations.goal is None and not self.learns_cycles:
            raise ValueError(
                f"{self.title} learns motions that end at a goal, got {demonstrations.name!r}, "
                f"which repeats with a period of {demonstrations.period} s."
            )
        if demonstrations.goal is not None and not self.learns_goals:
            raise ValueError(
                f"{self.title} learns motions that repeat, got {demonstrations.name!r}, which ends "
                "at a goal: pass period=... if it repeats, or use another method."
            )

    def _fitted(self, demonstrations: Demonstrations) -> Self:
        self.n_dims_ = demonstrations.n_dims
        self.period_ = demonstrations.period
        self.goal_ = demonstrations.centre
        return self

    @abstractmethod
    def _fit(self, demonstrations: Demonstrations, rng: np.random.Generator) -> None:
        """Learn from demonstrations; every random number comes from `rng`."""

    @property
    @abstractmethod
    def guarantee(self) -> Guarantee:
        """What is known about the stability of what was fitted, and why."""

    @property
    def n_parameters(self) -> int:
        """How many numbers describe what was fitted."""
        self._require_fit()
        return sum(a.size for a in self._arrays().values())

    def _require_fit(self) -> None:
        if not hasattr(self, "n_dims_"):
            raise NotFittedError(
                f"{type(self).__name__} has not been fitted: call fit(demonstrations, seed=0)."
            )

    def _states(self, x: ArrayLike) -> tuple[FloatArray, tuple[int, ...]]:
        self._require_fit()
        states = np.asarray(x, dtype=np.float64)
        if states.ndim == 0 or states.shape[-1] != self.n_dims_:
            raise ValueError(f"Expected states of shape (..., {self.n_dims_}), got {states.shape}.")
        return states.reshape(-1, self.n_dims_), states.shape

    # Files --------------------------------------------------------------------------------

    @abstractmethod
    def _arrays(self) -> dict[str, np.ndarray[Any, Any]]:
        """Return the fitted parameters by name, real floating and finite: what a file holds."""

    @abstractmethod
    def _restore(self, arrays: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Take the fitted parameters back; raise KeyError or ValueError if they do not fit.

        `config`, `n_dims_`, `goal_` and `period_` are set. A file may come from anywhere: the
        numbers that the guarantee rests on are checked here. What `_arrays` returns afterwards are
        the names that a file must have; other ones are refused.
        """

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write a safetensors file whose header holds the settings as JSON; replace atomically."""
        self._require_fit()
        header = {
            "method": self.name,
            "config": dataclasses.asdict(self.config),
            "n_dims": self.n_dims_,
        }
        arrays = self._arrays() | {"goal": np.array(self.goal_)}
        if self.period_ is not None:
            arrays["period"] = np.array([self.period_])
        return write_model_file(path, header, arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read a file that `save` wrote; raise ModelFileError if it is anything else."""
        header, arrays = read_model_file(path)
        if header["method"] != cls.name:
            raise ModelFileError(
                f"Expected {path} to hold a {cls.name!r} model, got {header['method']!r}."
            )
        with model_file_errors(path, cls.name):
            config, n_dims = header["config"], header["n_dims"]
            if not isinstance(config, dict):
                raise ValueError(f"expected a config of settings by name, got {config!r}")
            if type(n_dims) is not int or n_dims < 1:
                raise ValueError(f"expected n_dims to be a whole number >= 1, got {n_dims!r}")
            system = cls(cls.Config(**_as_tuples(config)))
            system.n_dims_ = n_dims
            system.goal_ = np.asarray(arrays.pop("goal"), dtype=np.float64)
            if system.goal_.shape != (n_dims,):
                raise ValueError(f"expected a goal of shape {(n_dims,)}, got {system.goal_.shape}")
            system.period_ = _period(arrays.pop("period", None), cls.learns_cycles)
            with np.errstate(all="ignore"):  # absurd numbers are told by the checks
                system._restore(arrays)
            if (names := sorted(system._arrays())) != sorted(arrays):
                raise ValueError(f"expected the arrays {names}, got {sorted(arrays)}")
        return system


class DynamicalSystem(Method):
    """An autonomous dynamical system dx/dt = f(x) that is learned from demonstrations."""

    # The field ----------------------------------------------------------------------------

    def velocity(self, x: ArrayLike) -> FloatArray:
        """Return f(x) in length/s: shape (..., d) for states x of shape (..., d)."""
        states, shape = self._states(x)
        return self._velocity(states).reshape(shape)

    def step(self, x: ArrayLike, dt: float | FloatArray) -> FloatArray:
        """Return the states, shape (..., d), a time dt (seconds, > 0, broadcast) after x."""
        states, shape = self._states(x)
        return self._step(states, step_times(dt, shape[:-1])).reshape(shape)

    def rollout(self, x0: ArrayLike, n_steps: int, dt: float) -> FloatArray:
        """Return the trajectory from x0, shape (..., n_steps + 1, d), x0 (..., d) included.

        n_steps is a whole number >= 0, dt one time in seconds > 0.
        """
        states, shape = self._states(x0)
        n_steps, dt = whole_number(n_steps), seconds(dt)
        path = self._rollout(states, n_steps, dt)
        return path.reshape(*shape[:-1], n_steps + 1, shape[-1])

    def lyapunov(self, x: ArrayLike) -> FloatArray | None:
        """Return V(x), shape (...), for a method that has a Lyapunov function; None otherwise."""
        states, shape = self._states(x)
        value = self._lyapunov(states)
        return None if value is None else value.reshape(shape[:-1])

    def lyapunov_rate(self, x: ArrayLike) -> FloatArray | None:
        """Return dV/dt along the field, shape (...); None without a Lyapunov function."""
        states, shape = self._states(x)
        value = self._lyapunov_rate(states)
        return None if value is None else value.reshape(shape[:-1])

    def log_prob(self, x: ArrayLike, x_next: ArrayLike, dt: float) -> FloatArray | None:
        """Return log p(x_next | x, dt), shape (...); None for a method without a density.

        x and x_next are of one shape, (..., d), dt is one time in seconds > 0.
        """
        states, shape = self._states(x)
        following, shape_next = self._states(x_next)
        if shape != shape_next:
            raise ValueError(f"Expected x and x_next of one shape, got {shape} and {shape_next}.")
        value = self._log_prob(states, following, seconds(dt))
        return None if value is None else value.reshape(shape[:-1])

    def trajectory_log_prob(
        self, x: ArrayLike, dt: float, *, stride: int = 1, initial: bool = False
    ) -> float | None:
        """Return log p(tau) of a trajectory x, shape (T, d), sampled every dt; or None.

        The sum of the log densities of its transitions over `stride` samples, in nats; None for a
        method without a density. With `initial` the first state counts with its stationary
        density, where the method has one; this one has none.
        """
        states, shape = self._states(x)
        stride = whole_number(stride)
        if len(shape) != 2 or stride < 1 or len(states) <= stride:
            raise ValueError(
                f"Expected a trajectory (T, d) of more than stride = {stride} >= 1 samples, got "
                f"shape {shape}."
            )
        states = states[::stride]
        value = self._log_prob(states[:-1], states[1:], stride * seconds(dt))
        return None if value is None else float(value.sum())

    @abstractmethod
    def _velocity(self, x: FloatArray) -> FloatArray:
        """Return f(x), shape (n, d)."""

    def _step(self, x: FloatArray, dt: FloatArray) -> FloatArray:
        return x + dt[:, None] * self._velocity(x)

    def _rollout(self, x0: FloatArray, n_steps: int, dt: float) -> FloatArray:
        path = np.empty((len(x0), n_steps + 1, x0.shape[1]))
        path[:, 0] = x0
        steps = np.full(len(x0), dt)
        for k in range(n_steps):
            path[:, k + 1] = self._step(path[:, k], steps)
        return path

    def _lyapunov(self, x: FloatArray) -> FloatArray | None:
        return None

    def _lyapunov_rate(self, x: FloatArray) -> FloatArray | None:
        return None

    def _log_prob(self, x: FloatArray, x_next: FloatArray, dt: float) -> FloatArray | None:
        return None


def _as_tuples(config: Mapping[str, Any]) -> dict[str, Any]:
    """JSON has lists where settings have tuples."""
    return {k: tuple(v) if isinstance(v, list) else v for k, v in config.items()}


def check_positive_definite(matrices: np.ndarray[Any, Any], what: str) -> None:
    """Raise ValueError unless matrices, shape (..., d, d), are symmetric and positive definite.

    Rows and columns are divided by the diagonal's roots first, so that units do not matter.
    """
    variances = np.diagonal(matrices, axis1=-2, axis2=-1)
    if not (variances > 0).all():
        raise ValueError(f"expected {what} > 0 on the diagonal, got {variances.min():.3g}")
    roots = np.sqrt(variances)
    unit = matrices / roots[..., :, None] / roots[..., None, :]
    apart = np.abs(unit - np.swapaxes(unit, -1, -2)).max()
    if not apart <= SYMMETRIC:
        raise ValueError(f"expected a symmetric {what}, got a scaled asymmetry {apart:.3g}")
    least = np.linalg.eigvalsh(unit).min()
    if not least > 0:
        raise ValueError(
            f"expected a positive definite {what}, got the scaled eigenvalue {least:.3g}"
        )


def _period(array: np.ndarray[Any, Any] | None, learns_cycles: bool) -> float | None:
    """Return the seconds of a round that a file holds; None where it holds none."""
    if array is None:
        return None
    if not learns_cycles:
        raise ValueError(f"expected a motion that ends, got a period of {array}")
    if array.shape != (1,) or not array[0] > 0:
        raise ValueError(f"expected one period > 0, got {array}")
    return float(array[0])


def step_times(dt: float | FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Return times > 0, broadcast to `shape` and flattened."""
    times = np.asarray(dt, dtype=np.float64)
    if not ((times > 0) & (times < np.inf)).all():
        raise ValueError(f"Expected a finite dt > 0 in seconds, got {dt}.")
    try:
        return np.broadcast_to(times, shape).reshape(-1)
    except ValueError:
        raise ValueError(
            f"Expected dt of a shape that broadcasts to {shape}, got {times.shape}."
        ) from None


def seconds(dt: float) -> float:
    """Return one finite time > 0 as a float; raise ValueError for anything else."""
    return float(step_times(dt, ())[0])


def whole_number(n_steps: SupportsIndex) -> int:
    """Return n_steps as an int >= 0; raise TypeError or ValueError for anything else."""
    try:
        count = operator.index(n_steps)
    except TypeError:
        raise TypeError(f"Expected n_steps to be a whole number, got {n_steps!r}.") from None
    if count < 0:
        raise ValueError(f"Expected n_steps >= 0, got {count}.")
    return count
