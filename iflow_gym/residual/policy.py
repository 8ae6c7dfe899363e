"""A base and an agent's residual as one policy, to be run and scored like any other."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from iflow_gym.demonstrations import FloatArray
from iflow_gym.residual.composition import SCALE, Composition, starts_of


class Memory(NamedTuple):
    """What goes from step to step."""

    base: Any
    agent: Any
    allowance: FloatArray | None
    """The shield's W."""


class ResidualPolicy:
    """Adds what an agent wants to what a base commands, in any environment of the same motion.

    `iflow_gym.evaluate.evaluate` takes it as it is, and binds it to its batches itself; to run it
    by hand, ask ``policy.for_environment(env)``.

    Parameters
    ----------
    agent : anything with ``predict(features, state, episode_start, deterministic)``
        Of Stable-Baselines3, or a `Zero`; it sees and answers what it does in
        `iflow_gym.residual.ResidualActionWrapper`.
    base_policy, scale, stable
        As there.
    demonstrations : str, optional
        sha256 of the demonstrations that the agent was trained on: other ones are refused.
    """

    def __init__(
        self,
        agent: Any,
        base_policy: Any,
        scale: float = SCALE,
        *,
        stable: bool | float = False,
        demonstrations: str | None = None,
    ) -> None:
        self.agent, self.base_policy = agent, base_policy
        self.scale, self.stable = scale, stable
        self.demonstrations = demonstrations

    def for_environment(self, env: Any) -> BoundResidualPolicy:
        """Return the policy for an environment, single or batched.

        Raises
        ------
        ValueError
            If it has other demonstrations than the agent was trained on.
        """
        task = env.unwrapped
        found = task.demonstrations.sha256
        if self.demonstrations is not None and found != self.demonstrations:
            raise ValueError(
                f"Expected the motion that the residual was trained on (demonstrations of sha256 "
                f"{self.demonstrations[:12]}), got {task.demonstrations.name!r} ({found[:12]}): "
                "train one for it, or make the environment that it belongs to."
            )
        return BoundResidualPolicy(
            self.agent, Composition(task, self.base_policy, self.scale, self.stable)
        )


class BoundResidualPolicy:
    """A `ResidualPolicy` in one environment, whose `dt` is read at every call."""

    def __init__(self, agent: Any, composition: Composition) -> None:
        self._agent, self._composition = agent, composition

    def predict(
        self,
        observation: ArrayLike,
        state: Memory | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[FloatArray, Memory]:
        """Return the environment's actions, and the state for the next step.

        Parameters
        ----------
        observation : array, shape (observation,) or (n, observation)
            The environment's own.
        state : Memory or None
            What the last call returned; None begins.
        episode_start : array of bool, shape (n,), optional
            Where an episode begins.
        deterministic : bool
            Whether the agent takes its mean action.
        """
        own = self._composition
        values = np.asarray(observation, dtype=np.float64)
        single = values.ndim == 1
        states = values[None] if single else values
        n = len(states)
        dt = np.broadcast_to(np.asarray(own.task.dt, dtype=np.float64), n)
        memory = Memory(None, None, None) if state is None else state
        begun = starts_of(n, state is None)
        if episode_start is not None:
            begun = begun | np.asarray(episode_start, dtype=bool)
        command, base = own.base.command(states, dt, memory.base, begun)
        features = own.features(states, command)
        if not np.isfinite(features).all():  # a base that ran away: the judge is to see it
            action = np.full((n, own.n_dims), np.nan)
            return (action[0] if single else action), Memory(base, memory.agent, memory.allowance)
        residual, agent = self._agent.predict(
            features, state=memory.agent, episode_start=begun, deterministic=deterministic
        )
        allowance = own.allowance(states, dt, memory.allowance, begun)
        total = own.commanded(states, command, np.asarray(residual), dt, allowance)
        action = own.task.command_to_action(total, states, dt)
        return (action[0] if single else action), Memory(base, agent, allowance)


class Zero:
    """The agent that adds nothing: the base alone.

    Parameters
    ----------
    n_dims : int
        d.
    """

    def __init__(self, n_dims: int) -> None:
        self._n_dims = n_dims

    def predict(
        self, features: Any, state: Any = None, episode_start: Any = None, deterministic: Any = True
    ) -> tuple[FloatArray, Any]:
        """Return zeros, shape (d,) or (n, d) as the features have n rows."""
        return np.zeros((*np.shape(features)[:-1], self._n_dims)), state


class Hostile:
    """The agent that wants V to rise as fast as its box allows: the worst case, at every step.

    It adds sign(grad V), the vertex of the box at which <grad V, r> is largest, and so sees what no
    learned agent does: it asks the base's Lyapunov function at the position in the features.

    Parameters
    ----------
    composition : Composition
        That it acts in.
    lyapunov : LyapunovFunction
        Of the base.
    """

    def __init__(self, composition: Composition, lyapunov: Any) -> None:
        self._composition, self._lyapunov = composition, lyapunov

    def predict(
        self, features: Any, state: Any = None, episode_start: Any = None, deterministic: Any = True
    ) -> tuple[FloatArray, Any]:
        """Return the worst residual actions, shape (n, d)."""
        x = self._composition.positions(np.asarray(features, dtype=np.float64))
        return self.at(x), state

    def at(self, x: FloatArray) -> FloatArray:
        """Return the worst residual actions at positions x, shape (n, d) both."""
        _, gradient = self._lyapunov.value_and_gradient(x)
        return np.asarray(np.sign(gradient))
