"""A fitted method as a policy, with the interface of Stable-Baselines3's models."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from iflow_gym.demonstrations import FloatArray
from iflow_gym.primitive import MovementPrimitive, PhaseState, start_again
from iflow_gym.system import DynamicalSystem, Method

BISECTIONS = 30
"""At most so many halvings of the time fraction: it is found to 1e-9."""


class MethodPolicy:
    """What the policies of both kinds of method have in common: an environment, or its numbers.

    Parameters
    ----------
    method : Method
        Fitted.
    env : an environment or vector environment of iflow_gym, optional
        Its `unwrapped.dt` is read at every call, since each episode has its demonstration's.
    max_speed : float, length/s, and dt : float, seconds
        In place of `env`: the action is then the command as a fraction of `max_speed`.
    """

    def __init__(
        self,
        method: Method,
        env: Any = None,
        *,
        max_speed: float | None = None,
        dt: float | None = None,
    ) -> None:
        n_dims = getattr(method, "n_dims_", None)
        if n_dims is None:
            raise ValueError(
                f"Expected a fitted system, got {type(method).__name__}: call "
                "fit(demonstrations, seed=0) first."
            )
        self.method = method
        self._n_dims = int(n_dims)
        self._env: Any = None
        self._dt = 0.0
        if env is None:
            if max_speed is None or dt is None:
                raise TypeError("Expected an environment, or both max_speed and dt.")
            if not (max_speed > 0 and dt > 0):
                raise ValueError(f"Expected max_speed > 0 and dt > 0, got {max_speed} and {dt}.")
            self.max_speed, self._dt = float(max_speed), float(dt)
            return
        if max_speed is not None or dt is not None:
            raise TypeError("Expected an environment, or max_speed and dt, got both.")
        self._env = env.unwrapped
        if not hasattr(self._env, "command_to_action"):
            raise TypeError(
                "Expected an environment of iflow_gym, or a batch from gymnasium.make_vec(id, "
                f"num_envs=n), got {type(self._env).__name__}: it has no command_to_action. Give "
                "max_speed and dt in its place."
            )
        if self._env.n_dims != self._n_dims:
            raise ValueError(
                f"Expected a system of {self._env.n_dims} dimensions as the environment has, got "
                f"{self._n_dims}."
            )
        self.max_speed = float(self._env.max_speed)

    @property
    def dt(self) -> Any:
        """Seconds a step: the environment's at this moment, a float or shape (n,)."""
        return self._dt if self._env is None else self._env.dt

    def _checked(self, observation: ArrayLike) -> tuple[FloatArray, Any]:
        """Return observations, shape (..., observation), and their dt; the position comes first."""
        values = np.asarray(observation, dtype=np.float64)
        width = self._n_dims if self._env is None else self._env.observation_space.shape[-1]
        if values.ndim == 0 or values.shape[-1] != width:
            raise ValueError(f"Expected observations of shape (..., {width}), got {values.shape}.")
        dt = self.dt
        if np.ndim(dt) and np.shape(dt) != values.shape[:-1]:
            raise ValueError(
                f"Expected observations of all {len(dt)} environments, got shape {values.shape}: "
                "each environment has its own dt."
            )
        return values, dt

    def _action(self, command: FloatArray, observation: FloatArray, dt: Any) -> FloatArray:
        """Return the action, shape (..., d), for a velocity command, shape (..., d)."""
        if self._env is None:
            action = command / self.max_speed
            scaled: FloatArray = action / np.maximum(_largest(np.abs(action)), 1.0)[..., None]
            return scaled
        converted: FloatArray = self._env.command_to_action(command, observation, dt)
        return converted


class DynamicalSystemPolicy(MethodPolicy):
    """Runs a dynamical system in an environment.

    The command in state x is the mean velocity of the system's own step,

        (step(x, dt) - x) / dt,

    which the environment holds for one dt. So the mass is where the system would be, exactly where
    the method's flow is exact.

    An environment has a greatest speed. Where a component of the command exceeds it, the command
    is not clipped: time is slowed along the system's own path. The policy finds by bisection a
    fraction s in (0, 1] with max_i |step(x, s dt) - x|_i <= max_speed dt, the largest one where
    the displacement grows with s, and commands (step(x, s dt) - x) / dt. The next state then still
    lies on the orbit through x, so whatever decreases along orbits still decreases at every step:
    a Lyapunov function proves as much of the saturated policy as of the system. Clipping, or
    scaling the command, would leave the orbit.

    In force mode the environment's `command_to_action` turns the command into the force that
    reaches that velocity at the end of dt; the statement about orbits then holds only as far as the
    mass follows its command.

    Parameters
    ----------
    system : DynamicalSystem
        Fitted.
    env : an environment or vector environment of iflow_gym, optional
        Its `unwrapped.dt` is read at every call, since each episode has its demonstration's.
    max_speed : float, length/s, and dt : float, seconds
        In place of `env`: the action is then the command as a fraction of `max_speed`.

    Examples
    --------
    >>> policy = DynamicalSystemPolicy(system, env)  # doctest: +SKIP
    >>> action, _ = policy.predict(observation)  # doctest: +SKIP
    """

    def __init__(
        self,
        system: DynamicalSystem,
        env: Any = None,
        *,
        max_speed: float | None = None,
        dt: float | None = None,
    ) -> None:
        super().__init__(system, env, max_speed=max_speed, dt=dt)
        self.system = system

    def velocity(self, x: ArrayLike) -> FloatArray:
        """Return the system's velocity, shape (..., d): what a picture of the policy shows."""
        return self.system.velocity(x)

    def command(self, x: ArrayLike, dt: float | FloatArray) -> FloatArray:
        """Return the velocity command, shape (..., d), in positions x, shape (..., d)."""
        states = np.asarray(x, dtype=np.float64)
        points = states.reshape(-1, self._n_dims)
        steps = np.broadcast_to(np.asarray(dt, dtype=np.float64), states.shape[:-1]).reshape(-1)
        limits = self.max_speed * steps
        moves = self.system.step(points, steps) - points
        fast = np.flatnonzero(_largest(moves) > limits)
        if len(fast):
            moves[fast] = self._slowed(points[fast], steps[fast], moves[fast], limits[fast])
        return (moves / steps[:, None]).reshape(states.shape)

    def _slowed(
        self, x: FloatArray, dt: FloatArray, moves: FloatArray, limits: FloatArray
    ) -> FloatArray:
        """Return displacements along the orbits through x that keep the limits, shape (n, d)."""
        # First the fraction of a straight step, which is all that an explicit Euler step needs;
        # a little below it, so that rounding does not carry it over the limit.
        slow, fast = np.zeros(len(x)), np.ones(len(x))
        middle = (1 - 1e-12) * limits / _largest(moves)
        best = moves.copy()
        for _ in range(BISECTIONS):
            tried = self.system.step(x, middle * dt) - x
            reached = _largest(tried)
            within = reached <= limits
            # Of a path that is too fast even at the last trial, the shortest displacement is kept.
            best[within | (slow == 0)] = tried[within | (slow == 0)]
            if (within & (reached >= (1 - 1e-9) * limits)).all():
                break
            slow, fast = np.where(within, middle, slow), np.where(within, fast, middle)
            middle = (slow + fast) / 2
        # A safety for that case alone: everything else is within its limit already.
        return best / np.maximum(_largest(best) / limits, 1.0)[:, None]

    def predict(
        self,
        observation: ArrayLike,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[FloatArray, Any]:
        """Return actions in [-1, 1], float64, and `state` as it came.

        Parameters
        ----------
        observation : array, shape (d,) or (n, d); in force mode 2 d
            The position comes first.
        state, episode_start, deterministic
            Stable-Baselines3's arguments; the policy has no memory and no noise.
        """
        values, dt = self._checked(observation)
        command = self.command(values[..., : self._n_dims], dt)
        return self._action(command, values, dt), state


class MovementPrimitivePolicy(MethodPolicy):
    """Runs a movement primitive in an environment; its state is the primitive's clock.

    The command at x is the mean velocity to where the primitive wants to be, (x_next - x) / dt,
    which the environment holds for one dt. Where a component of it exceeds the greatest speed the
    command is scaled down, and the clock runs on: the mass then lags, and catches up later.

    Give the state that `predict` returns back to the next call. Without one, and where
    `episode_start` is true, the clock starts anew at the observation.

    Parameters
    ----------
    primitive : MovementPrimitive
        Fitted.
    env, max_speed, dt
        As for `DynamicalSystemPolicy`.

    Examples
    --------
    >>> policy = MovementPrimitivePolicy(primitive, env)  # doctest: +SKIP
    >>> state = None  # doctest: +SKIP
    >>> action, state = policy.predict(observation, state)  # doctest: +SKIP
    """

    def __init__(
        self,
        primitive: MovementPrimitive,
        env: Any = None,
        *,
        max_speed: float | None = None,
        dt: float | None = None,
    ) -> None:
        super().__init__(primitive, env, max_speed=max_speed, dt=dt)
        self.primitive = primitive

    def predict(
        self,
        observation: ArrayLike,
        state: PhaseState | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[FloatArray, PhaseState]:
        """Return actions in [-1, 1], float64, and the state for the next step.

        Parameters
        ----------
        observation : array, shape (d,) or (n, d); in force mode 2 d
            The position comes first.
        state : dict or None
            What the last call returned; None starts the clock.
        episode_start : array of bool, shape (n,), optional
            Where an episode begins, and the clock with it.
        deterministic
            Stable-Baselines3's argument; the policy has no noise.
        """
        values, dt = self._checked(observation)
        x = values[..., : self._n_dims]
        if state is None:
            state = self.primitive.begin(x)
        elif episode_start is not None and np.any(begun := np.asarray(episode_start, dtype=bool)):
            again = np.broadcast_to(begun.reshape(-1), state["phase"].shape)
            state = start_again(state, self.primitive.begin(x), again)
        following, state = self.primitive.advance(x, state, dt)
        command = (following - x) / np.asarray(dt, dtype=np.float64)[..., None]
        return self._action(command, values, dt), state


def policy_of(method: Method, env: Any) -> DynamicalSystemPolicy | MovementPrimitivePolicy:
    """Return the policy that runs a fitted method, whichever its kind is, in an environment."""
    if isinstance(method, DynamicalSystem):
        return DynamicalSystemPolicy(method, env)
    if isinstance(method, MovementPrimitive):
        return MovementPrimitivePolicy(method, env)
    raise TypeError(
        f"Expected a DynamicalSystem or a MovementPrimitive, got {type(method).__name__}."
    )


def _largest(vectors: FloatArray) -> FloatArray:
    """Return the largest component by magnitude, shape (...,)."""
    return np.asarray(np.abs(vectors).max(axis=-1))
