"""Several arms that a policy moves side by side: what scores are taken from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from iflow_gym.demonstrations import FloatArray
from iflow_gym.metrics.drumming import Hit

if TYPE_CHECKING:
    from iflow_gym.envs.drumming.env import DrummingEnv


class Arms:
    """A batch of arms with the interface that `iflow_gym.evaluation` asks of one.

    For reinforcement learning `gymnasium.make_vec` makes vector environments that begin anew by
    themselves; here every arm is stepped to the horizon once, and what it hit is kept.

    Attributes
    ----------
    hits : list of lists of Hit
        Of each arm since the reset.
    targets : list of arrays, shape (n, 3)
        Where the arms were commanded to be at the end of each step, in m.
    """

    def __init__(self, envs: Sequence[DrummingEnv]) -> None:
        self._envs = list(envs)
        first = self._envs[0]
        self.num_envs = len(self._envs)
        self.demonstrations = first.demonstrations
        self.n_dims, self.max_speed = first.n_dims, first.max_speed
        self.single_observation_space = first.observation_space
        self.single_action_space = first.action_space
        self.observation_space = batch_space(first.observation_space, self.num_envs)
        self.action_space = batch_space(first.action_space, self.num_envs)
        self.dt: FloatArray = np.full(self.num_envs, first.dt)
        self.hits: list[list[Hit]] = []
        self.targets: list[FloatArray] = []

    def reset(
        self, *, seed: int | Sequence[int], options: dict[str, Any]
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Begin; options hold an array with an entry for each arm, seeds count up from one."""
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else list(seed)
        self.hits = [[] for _ in self._envs]
        self.targets = []
        observations = []
        for i, env in enumerate(self._envs):
            own = {key: values[i] for key, values in options.items()}
            if "demonstration" in own:
                own["demonstration"] = int(own["demonstration"])
            observations.append(env.reset(seed=seeds[i], options=own)[0])
        return np.stack(observations), {}

    def command_to_action(
        self, velocity_command: ArrayLike, observation: ArrayLike, dt: Any = None
    ) -> FloatArray:
        """Return the actions of velocity commands, shape (n, 3) both; in torque mode (n, 7)."""
        commands, states = np.asarray(velocity_command), np.asarray(observation)
        return np.stack(
            [
                env.command_to_action(command, state)
                for env, command, state in zip(self._envs, commands, states, strict=True)
            ]
        )

    def step(self, actions: NDArray[Any]) -> tuple[FloatArray, None, None, None, dict[str, Any]]:
        """Step every arm; observations have shape (n, observation)."""
        observations, targets = [], []
        for env, action, hits in zip(self._envs, actions, self.hits, strict=True):
            observation, _, _, _, info = env.step(action)
            observations.append(observation)
            targets.append(info["target"])
            hits.extend(info["hits"])
        self.targets.append(np.stack(targets))
        return np.stack(observations), None, None, None, {}
