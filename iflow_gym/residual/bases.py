"""What residuals are added to: anything that commands a velocity, step by step.

A *memory* goes from step to step, as in `predict(observation, state, episode_start)`: a movement
primitive's clock, a recurrent policy's state; a dynamical system has none.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from iflow_gym.demonstrations import FloatArray
from iflow_gym.policy import DynamicalSystemPolicy, MethodPolicy
from iflow_gym.primitive import MovementPrimitive, start_again
from iflow_gym.system import DynamicalSystem, Method

BoolArray = NDArray[np.bool_]


class Base(Protocol):
    """Commands velocities for n masses."""

    def command(
        self, observations: FloatArray, dt: FloatArray, memory: Any, begun: BoolArray
    ) -> tuple[FloatArray, Any]:
        """Return commands, shape (n, d) in length/s, and the memory for the next step.

        Parameters
        ----------
        observations : array, shape (n, observation)
            The environment's own; the position comes first.
        dt : array, shape (n,)
            Seconds that the command will be held.
        memory
            What the last call returned; None at the first.
        begun : array of bool, shape (n,)
            Where an episode begins with this observation.
        """


def base_of(policy: Any, task: Any) -> Base:
    """Return the base that a method, a policy or None (no command at all) makes in a task.

    Raises
    ------
    TypeError, ValueError
        If it is none of these, is not fitted, or has another dimension than the task.
    """
    if policy is None:
        return Still(task.n_dims)
    if isinstance(policy, MethodPolicy):
        policy = policy.method
    if isinstance(policy, Method):
        policy._require_fit()
        if policy.n_dims_ != task.n_dims:
            raise ValueError(
                f"Expected a base of {task.n_dims} dimensions as the environment has, got "
                f"{policy.n_dims_}."
            )
    if isinstance(policy, DynamicalSystem):
        return OfSystem(policy, task)
    if isinstance(policy, MovementPrimitive):
        return OfPrimitive(policy, task)
    if not callable(getattr(policy, "predict", None)):
        raise TypeError(
            "Expected a fitted method, a policy with predict(observation, state, episode_start, "
            f"deterministic) or None as the base, got {type(policy).__name__}."
        )
    return OfPolicy(policy, task)


class Still:
    """Commands standing still: what reinforcement learning from scratch adds to."""

    def __init__(self, n_dims: int) -> None:
        self._n_dims = n_dims

    def command(
        self, observations: FloatArray, dt: FloatArray, memory: Any, begun: BoolArray
    ) -> tuple[FloatArray, Any]:
        """Return zeros."""
        return np.zeros((len(observations), self._n_dims)), memory


class OfSystem:
    """Commands what `DynamicalSystemPolicy` does."""

    def __init__(self, system: DynamicalSystem, task: Any) -> None:
        self._policy = DynamicalSystemPolicy(system, max_speed=task.max_speed, dt=1.0)
        self._n_dims = task.n_dims

    def command(
        self, observations: FloatArray, dt: FloatArray, memory: Any, begun: BoolArray
    ) -> tuple[FloatArray, Any]:
        """Return the mean velocities of the system's own steps, within the speed limit."""
        return self._policy.command(observations[:, : self._n_dims], dt), memory


class OfPrimitive:
    """Commands what `MovementPrimitivePolicy` does; its memory is the primitive's clock."""

    def __init__(self, primitive: MovementPrimitive, task: Any) -> None:
        self._primitive = primitive
        self._n_dims, self._max_speed = task.n_dims, task.max_speed

    def command(
        self, observations: FloatArray, dt: FloatArray, memory: Any, begun: BoolArray
    ) -> tuple[FloatArray, Any]:
        """Return the mean velocities to where the primitive wants to be next."""
        x = observations[:, : self._n_dims]
        if memory is None:
            memory = self._primitive.begin(x)
        elif begun.any():
            memory = start_again(memory, self._primitive.begin(x), begun)
        following, memory = self._primitive.advance(x, memory, dt)
        command = (following - x) / dt[:, None]
        most = np.abs(command).max(axis=1, keepdims=True) / self._max_speed
        return command / np.maximum(most, 1.0), memory


class OfPolicy:
    """Commands what any policy's actions mean in velocity mode."""

    def __init__(self, policy: Any, task: Any) -> None:
        if getattr(task, "control_mode", "velocity") != "velocity":
            raise ValueError(
                "Expected control_mode='velocity' for a base that is known by its actions alone, "
                f"got {task.control_mode!r}: there an action is no velocity. Use a fitted method."
            )
        self._policy, self._task = policy, task

    def command(
        self, observations: FloatArray, dt: FloatArray, memory: Any, begun: BoolArray
    ) -> tuple[FloatArray, Any]:
        """Return the velocities that the policy's actions command."""
        actions, memory = self._policy.predict(
            observations, state=memory, episode_start=begun, deterministic=True
        )
        largest = np.abs(actions).max(axis=-1, keepdims=True)
        scaled = np.asarray(actions, dtype=np.float64) / np.maximum(largest, 1.0)
        return scaled * self._task.max_speed, memory
