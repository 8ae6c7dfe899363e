"""MovementPrimitive: the contract of methods that use time, policies with a phase.

A primitive is no vector field: what it does in a state depends on how long ago it began. Its clock,
the phase, starts at the first observation and runs on whatever happens to the mass, which is what a
push then shows. A primitive implements `_fit`, `_begin` and `_advance`, its parameters as arrays
for files, and states its guarantee.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, Self, SupportsIndex

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.system import Method, seconds, step_times, whole_number

PhaseState = dict[str, FloatArray]
"""What a primitive remembers between two steps: arrays by name, a row for each of n states."""


class MovementPrimitive(Method):
    """A motion that is driven by a phase, learned from demonstrations.

    The phase s runs from 0 to 1 in the motion's duration and on beyond it, where a motion that ends
    holds its goal; of a motion that repeats, one round is one unit of phase and takes the
    demonstrations' period. How long a motion from x0 takes is the mean of what the demonstrations
    took, weighted by 1 / ‖x0 - start‖² (Shepard, "A two-dimensional interpolation function for
    irregularly-spaced data", Proc. 23rd ACM National Conference, 1968): from a demonstrated start
    it is that demonstration's time, from far away the mean.

    Attributes
    ----------
    starts_ : array, shape (n, d)
        Where the demonstrations began.
    durations_ : array, shape (n,)
        Seconds that each took; of a motion that repeats, the period for each.
    """

    uses_time: ClassVar[bool] = True
    integrator: ClassVar[str] = "its own phase"

    def _fitted(self, demonstrations: Demonstrations) -> Self:
        super()._fitted(demonstrations)
        self.starts_ = demonstrations.starts
        self.durations_ = (
            demonstrations.durations
            if demonstrations.period is None
            else np.full(len(demonstrations), demonstrations.period)
        )
        return self

    # The motion ---------------------------------------------------------------------------

    def begin(self, x: ArrayLike) -> PhaseState:
        """Start the clock at positions x, shape (..., d), which count as n states.

        Returns
        -------
        dict
            ``"phase"``, shape (n,), ``"rate"``, shape (n,), its growth in 1/s, and what else the
            method remembers.
        """
        states, _ = self._states(x)
        rate = 1.0 / self.duration(states)
        return self._begin(states, {"phase": np.zeros(len(states)), "rate": rate})

    def duration(self, x: ArrayLike) -> FloatArray:
        """Return the seconds, shape (...), that the motion from x, shape (..., d), takes."""
        states, shape = self._states(x)
        squares = ((states[:, None] - self.starts_) ** 2).sum(axis=-1)
        least = squares.min(axis=1, keepdims=True)
        # Relative to the nearest: from a demonstrated start, that one has all the weight.
        weights = np.where(squares > 0, least / np.where(squares > 0, squares, 1.0), 1.0)
        durations: FloatArray = weights @ self.durations_ / weights.sum(axis=1)
        return durations.reshape(shape[:-1])

    def advance(
        self, x: ArrayLike, state: PhaseState, dt: float | FloatArray
    ) -> tuple[FloatArray, PhaseState]:
        """Return where to be a time dt after x, and the state then.

        Parameters
        ----------
        x : array, shape (..., d)
            Where the mass is, which need not be where the last call wanted it to be.
        state : dict
            From `begin` or the last call, for as many states; left as it is.
        dt : float or array, seconds > 0, broadcast to (...)

        Returns
        -------
        x_next : array, shape (..., d)
        state : dict
        """
        states, shape = self._states(x)
        if (n := len(state["phase"])) != len(states):
            raise ValueError(
                f"Expected the {n} states that the clock was started for, got {len(states)}: "
                "call begin(x) for others."
            )
        steps = step_times(dt, shape[:-1])
        phase = state["phase"] + state["rate"] * steps
        following, kept = self._advance(states, state, phase, steps)
        return following.reshape(shape), {**state, **kept, "phase": phase}

    def rollout(self, x0: ArrayLike, n_steps: SupportsIndex, dt: float) -> FloatArray:
        """Return the trajectory from x0, shape (..., n_steps + 1, d), x0 (..., d) included.

        The mass is where the primitive wants it to be at every step, dt seconds apart.
        """
        states, shape = self._states(x0)
        n_steps, dt = whole_number(n_steps), seconds(dt)
        path = np.empty((len(states), n_steps + 1, self.n_dims_))
        path[:, 0] = states
        state = self.begin(states)
        for k in range(n_steps):
            path[:, k + 1], state = self.advance(path[:, k], state, dt)
        return path.reshape(*shape[:-1], n_steps + 1, shape[-1])

    @abstractmethod
    def _begin(self, x: FloatArray, state: PhaseState) -> PhaseState:
        """Return the state at the start, `state` and what else the method remembers of x, (n, d).

        A motion that repeats sets ``"phase"`` to where on the cycle it begins.
        """

    @abstractmethod
    def _advance(
        self, x: FloatArray, state: PhaseState, phase: FloatArray, dt: FloatArray
    ) -> tuple[FloatArray, PhaseState]:
        """Return where to be at `phase`, shape (n,), dt (n,) later, and what changed of the state.

        ``state["phase"]`` is the phase now.
        """

    # Files --------------------------------------------------------------------------------

    def _arrays(self) -> dict[str, NDArray[Any]]:
        """Return what the clock needs; a primitive adds its own."""
        return {"starts": self.starts_, "durations": self.durations_}

    def _restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        starts, durations = (
            np.asarray(arrays[k], dtype=np.float64) for k in ("starts", "durations")
        )
        n = durations.size
        if n < 1 or durations.shape != (n,) or starts.shape != (n, self.n_dims_):
            raise ValueError(
                f"expected starts and durations of shapes (n, {self.n_dims_}) and (n,) with n >= 1,"
                f" got {starts.shape} and {durations.shape}"
            )
        if not (durations > 0).all():
            raise ValueError(f"expected durations > 0, got {durations}")
        self.starts_, self.durations_ = starts, durations


def tracked(
    x: FloatArray, here: FloatArray, there: FloatArray, gain: float, elapsed: FloatArray
) -> FloatArray:
    """Return where a mass that tracks a moving reference is to be next, shape (n, d).

    The reference moves from `here` to `there`, shape (n, d), while the phase grows by `elapsed`,
    shape (n,); the mass at x, shape (n, d), moves along with it and the error decays at the rate
    `gain`, in 1/phase: dx/ds = dr/ds - gain (x - r), whose solution is exact for any step.
    """
    return np.asarray(there + np.exp(-gain * elapsed)[:, None] * (x - here))


def start_again(old: PhaseState, new: PhaseState, where: NDArray[np.bool_]) -> PhaseState:
    """Return `old` with the rows of `new` where the mask, shape (n,), is true."""
    return {
        key: np.where(where.reshape(-1, *(1,) * (value.ndim - 1)), new[key], value)
        for key, value in old.items()
    }
