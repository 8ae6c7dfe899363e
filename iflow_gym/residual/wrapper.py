"""Environments whose actions are residuals: added to what a base policy commands."""

from __future__ import annotations

from typing import Any, SupportsFloat, cast

import gymnasium
import numpy as np
from gymnasium.spaces import Space
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from iflow_gym.demonstrations import FloatArray
from iflow_gym.residual.bases import BoolArray
from iflow_gym.residual.composition import SCALE, Composition, Features, starts_of


class ResidualActionWrapper(
    gymnasium.Wrapper[Features, FloatArray, FloatArray, FloatArray],
    gymnasium.utils.RecordConstructorArgs,
):
    """An environment whose action is added to a base policy's velocity command.

    Works on the point mass in either control mode, LASA, letters, the disturbed point mass and the
    drumming arm in either control mode; of a vector environment it makes a `ResidualVectorWrapper`.

    The action, `Box(-1, 1, (d,))`, is the residual velocity in `scale` greatest speeds, whatever
    the environment's own actions are. The observation, float32, is the environment's and the base's
    command, scaled to order 1: see `iflow_gym.residual.composition.Composition.features`. Rewards,
    ends and info are the environment's; ``info["base_command"]`` and ``info["command"]``, shape
    (d,) in length/s, are what the base commanded in the step and what was commanded; after a reset
    both are the base's command to come.

    Parameters
    ----------
    env : Env or VectorEnv
        Of iflow_gym, wrapped or not.
    base_policy : Method, policy or None
        What is added to: a fitted method (its policy will do), any policy with `predict` in
        velocity mode, or None for standing still, which is learning from scratch.
    scale : float
        Largest residual in `max_speed`, in (0, 1]. `max_speed` is 5 times the peak speed of
        recordings in the plane.
    stable : bool or float
        Whether the command is projected so that the base's Lyapunov function falls whatever the
        agent does (`iflow_gym.residual.shield` has what is proved); a number in (0, 1] is the
        required rate as a share of the base's slowest, True takes 0.9.

    Examples
    --------
    >>> env = ResidualActionWrapper(gym.make("iflow/Disturbed-Angle-v0"), system)  # doctest: +SKIP
    >>> PPO("MlpPolicy", env).learn(100_000)  # doctest: +SKIP
    """

    def __new__(cls, env: Any, *args: Any, **kwargs: Any) -> Any:
        """Make a wrapper of the environment's kind."""
        if isinstance(env, VectorEnv):
            return ResidualVectorWrapper(env, *args, **kwargs)
        return super().__new__(cls)

    def __init__(
        self,
        env: Any,
        base_policy: Any,
        scale: float = SCALE,
        *,
        stable: bool | float = False,
    ) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(
            self, base_policy=base_policy, scale=scale, stable=stable, _disable_deepcopy=True
        )
        gymnasium.Wrapper.__init__(self, env)
        self.composition = Composition(_task_of(env), base_policy, scale, stable)
        self.action_space = cast("Space[Any]", self.composition.action_space)
        self.observation_space = cast("Space[Any]", self.composition.observation_space)
        self._observation: FloatArray | None = None
        self._command: FloatArray = np.zeros((1, self.composition.n_dims))
        self._dt: FloatArray = np.zeros(1)
        self._memory: Any = None
        self._allowance: FloatArray | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Features, dict[str, Any]]:
        """Begin an episode; options are the environment's."""
        observation: Any
        observation, info = self.env.reset(seed=seed, options=options)
        self._memory = self._allowance = None
        seen = self._see(observation, info, begun=True)
        return seen, {**info, **_commands(self._command[0], self._command[0])}

    def step(
        self, action: FloatArray
    ) -> tuple[Features, SupportsFloat, bool, bool, dict[str, Any]]:
        """Hold the sum of the base's command and the residual for one dt."""
        if self._observation is None:
            raise gymnasium.error.ResetNeeded("Call reset() before step().")
        added = self.composition.checked(action, (self.composition.n_dims,))
        base, state, dt = self._command, self._observation, self._dt
        command = self.composition.commanded(state[None], base, added[None], dt, self._allowance)
        own = self.composition.task.command_to_action(command[0], state, float(dt[0]))
        following: Any
        following, reward, terminated, truncated, info = self.env.step(own)
        seen = self._see(following, info, begun=False)
        info = {**info, **_commands(base[0], command[0])}
        return seen, reward, terminated, truncated, info

    def _see(self, observation: FloatArray, info: dict[str, Any], *, begun: bool) -> Features:
        self._observation = np.asarray(observation, dtype=np.float64)
        self._dt = np.array([info["dt"]], dtype=np.float64)
        states = self._observation[None]
        self._command, self._memory = self.composition.base.command(
            states, self._dt, self._memory, starts_of(1, begun)
        )
        self._allowance = self.composition.allowance(
            states, self._dt, self._allowance, starts_of(1, begun)
        )
        seen: Features = self.composition.features(states, self._command)[0]
        return seen


class ResidualVectorWrapper(gymnasium.vector.VectorWrapper[Features, FloatArray, NDArray[Any]]):
    """Many of `ResidualActionWrapper`, stepped together; its parameters, and its numbers.

    `env` is a batch of iflow_gym's (``vectorization_mode="vector_entry_point"``) or a
    `SyncVectorEnv` over environments of iflow_gym; for any other one, such as `AsyncVectorEnv`,
    give one of its environments as `task`, which converts commands and is not stepped.
    ``info["base_command"]`` and ``info["command"]`` have shape (n, d); in a step that begins an
    episode anew they say nothing.
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        base_policy: Any,
        scale: float = SCALE,
        *,
        stable: bool | float = False,
        task: Any = None,
    ) -> None:
        super().__init__(env)
        self.composition = Composition(
            _task_of(env) if task is None else task.unwrapped, base_policy, scale, stable
        )
        self.single_action_space = self.composition.action_space
        self.single_observation_space = self.composition.observation_space
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._next_step = env.metadata.get("autoreset_mode") == AutoresetMode.NEXT_STEP
        self._same_step = env.metadata.get("autoreset_mode") == AutoresetMode.SAME_STEP
        self._ended = starts_of(self.num_envs, False)
        self._observation: FloatArray | None = None
        self._command: FloatArray = np.zeros((self.num_envs, self.composition.n_dims))
        self._dt: FloatArray = np.zeros(self.num_envs)
        self._memory: Any = None
        self._allowance: FloatArray | None = None

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Features, dict[str, Any]]:
        """Begin episodes; options are the environment's, ``reset_mask`` among them."""
        mask = (options or {}).get("reset_mask")
        observations, info = self.env.reset(seed=seed, options=options)
        if mask is None or self._observation is None:
            begun = starts_of(self.num_envs, True)
            self._memory, self._dt = None, np.asarray(info["dt"], dtype=np.float64).copy()
            self._allowance = None
        else:
            begun = np.asarray(mask)
            self._dt = np.where(begun, info["dt"], self._dt)
        self._ended = self._ended & ~begun
        if mask is None or self._memory is None:
            seen = self._see(observations, begun)
        else:  # the clocks of those that go on have been asked for this step already
            kept, memory, allowance = self._command, self._memory, self._allowance
            seen = self._see(observations, begun)
            self._command = np.asarray(np.where(begun[:, None], self._command, kept))
            if allowance is not None and self._allowance is not None:
                self._allowance = np.where(begun, self._allowance, allowance)
            self._memory = _merged(memory, self._memory, begun)
            states = np.asarray(observations, dtype=np.float64)
            seen = self.composition.features(states, self._command)
        return seen, {**info, **_commands(self._command, self._command, begun)}

    def step(
        self, actions: FloatArray
    ) -> tuple[Features, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Hold the sums for one dt; where the last step ended, begin anew."""
        if self._observation is None:
            raise gymnasium.error.ResetNeeded("Call reset() before step().")
        n = self.num_envs
        added = self.composition.checked(actions, (n, self.composition.n_dims))
        base, states, dt = self._command, self._observation, self._dt
        command = self.composition.commanded(states, base, added, dt, self._allowance)
        own = self.composition.task.command_to_action(command, states, dt)
        observations, rewards, terminated, truncated, info = self.env.step(own)
        ended = np.asarray(terminated) | np.asarray(truncated)
        begun = self._ended if self._next_step else ended if self._same_step else ended & False
        self._dt = np.where(info.get("_dt", True), info["dt"], self._dt).astype(np.float64)
        seen = self._see(observations, begun)
        self._ended = ended if self._next_step else ended & False
        return seen, rewards, terminated, truncated, {**info, **_commands(base, command, ~begun)}

    def _see(self, observations: Any, begun: BoolArray) -> Features:
        self._observation = np.asarray(observations, dtype=np.float64)
        self._command, self._memory = self.composition.base.command(
            self._observation, self._dt, self._memory, begun
        )
        self._allowance = self.composition.allowance(
            self._observation, self._dt, self._allowance, begun
        )
        return self.composition.features(self._observation, self._command)


def _task_of(env: Any) -> Any:
    """Return what converts commands in an environment: itself, or one that it consists of."""
    task = env.unwrapped
    if not hasattr(task, "command_to_action") and getattr(task, "envs", None):
        task = task.envs[0].unwrapped
        if getattr(task, "control_mode", "") == "torque":
            raise ValueError(
                "Expected control_mode='velocity' in a vector environment, got 'torque': there a "
                "command's torques depend on the joints of the one environment that they are for."
            )
    if not hasattr(task, "command_to_action"):
        raise TypeError(
            f"Expected an environment of iflow_gym, got {type(task).__name__}: it has no "
            "command_to_action. Of a vector environment in other processes give one of its "
            "environments as task=..."
        )
    return task


def _commands(
    base: FloatArray, command: FloatArray, mask: BoolArray | None = None
) -> dict[str, Any]:
    """Return what info says of the commands, with Gymnasium's masks in a batch."""
    found = {"base_command": base.copy(), "command": command.copy()}
    if mask is None:
        return found
    return {**found, "_base_command": mask.copy(), "_command": mask.copy()}


def _merged(old: Any, new: Any, where: BoolArray) -> Any:
    """Return a memory with `new` where the mask is true and `old` elsewhere."""
    if not isinstance(old, dict):
        return new
    return {
        key: np.where(where.reshape(-1, *(1,) * (value.ndim - 1)), new[key], value)
        for key, value in old.items()
    }
