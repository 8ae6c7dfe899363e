"""Trajectories that are scored: recorded from a batch of environments, stepped by a policy.

The environment is the judge. `DynamicalSystem.rollout` is never used, because there a method would
integrate itself as finely as it likes, with no sample time to hold a command for and no greatest
speed. (A method whose flow is exact gets the same trajectory from both, as a test shows.)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from iflow_gym import metrics
from iflow_gym.demonstrations import BoundingBox, Demonstrations, FloatArray
from iflow_gym.envs.task import THINNEST_SIDE, PointMassInterface, Push
from iflow_gym.metrics.stability import PERTURBATION_SIZE, PERTURBATION_TIME, STARTS_PER_AXIS
from iflow_gym.policy import policy_of
from iflow_gym.system import Method

STARTS = 256
"""About how many starts the grid has where no other number is fixed: in 1-D, and from 4-D on."""


class Policy(Protocol):
    """What is scored: Stable-Baselines3's interface.

    A policy that needs to know the environment, its `dt` or its `command_to_action`, has a method
    `for_environment(env)`, which returns the policy to ask; `env` is a batch, or a single one for
    `step_us`.
    """

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Any, Any]:
        """Return actions and the state that the next call is given."""


def bind(policy: Any, env: Any) -> Policy:
    """Return the policy for an environment."""
    if isinstance(policy, Method):
        return policy_of(policy, env)
    own: Callable[[Any], Policy] | None = getattr(policy, "for_environment", None)
    bound: Policy = policy if own is None else own(env)
    return bound


class Batch:
    """Vector environments that step side by side, so that a policy is asked once for all.

    They may differ in what only the constructor sets, the perturbation. To a policy this is one
    environment of iflow_gym.
    """

    def __init__(self, envs: Sequence[Any]) -> None:
        self._envs = list(envs)
        self.unwrapped = self
        first = self._envs[0]
        self.num_envs = sum(env.num_envs for env in self._envs)
        self.demonstrations = first.demonstrations
        self.n_dims, self.max_speed = first.n_dims, first.max_speed
        self.single_observation_space = first.single_observation_space
        self.single_action_space = first.single_action_space
        self.observation_space = batch_space(first.single_observation_space, self.num_envs)
        self.action_space = batch_space(first.single_action_space, self.num_envs)
        ends = np.cumsum([env.num_envs for env in self._envs]).tolist()
        self._slices = [slice(e - env.num_envs, e) for e, env in zip(ends, self._envs, strict=True)]
        self.dt: FloatArray = np.concatenate([env.dt for env in self._envs])

    def command_to_action(
        self, velocity_command: ArrayLike, observation: ArrayLike, dt: Any = None
    ) -> FloatArray:
        """As the environment's, shape (n, d)."""
        steps = self.dt if dt is None else dt
        action: FloatArray = self._envs[0].command_to_action(velocity_command, observation, steps)
        return action

    def observe(self, observations: Sequence[FloatArray]) -> FloatArray:
        """Join what the environments returned, shape (n, observation)."""
        return observations[0] if len(observations) == 1 else np.concatenate(observations)

    def step(self, actions: NDArray[Any]) -> FloatArray:
        """Step all; return the observations, shape (n, observation)."""
        return self.observe(
            [env.step(actions[s])[0] for env, s in zip(self._envs, self._slices, strict=True)]
        )


def rollouts(policy: Any, envs: Sequence[Any], first: FloatArray, n_steps: int) -> FloatArray:
    """Return positions, shape (n, n_steps + 1, d), from environments that were just reset.

    `first` are the observations of the reset, shape (n, observation).
    """
    batch = Batch(envs)
    n, d = batch.num_envs, batch.n_dims
    bound_policy = bind(policy, batch)
    paths = np.empty((n_steps + 1, n, d))
    paths[0] = first[:, :d]
    runaway = np.zeros(n, dtype=np.bool_)
    episode_start = np.ones(n, dtype=np.bool_)
    observation, state = first, None
    for k in range(n_steps):
        actions, state = bound_policy.predict(
            observation, state=state, episode_start=episode_start, deterministic=True
        )
        actions = np.asarray(actions)
        if actions.shape == (n, d) and not np.isfinite(actions).all():
            runaway |= ~np.isfinite(actions).all(axis=1)
            actions = np.where(runaway[:, None], 0.0, actions)
        observation = batch.step(actions)
        paths[k + 1] = observation[:, :d]
        if k == 0:
            episode_start = np.zeros(n, dtype=np.bool_)
        if runaway.any():
            paths[k + 1, runaway] = np.nan
    return np.ascontiguousarray(paths.transpose(1, 0, 2))


def rollouts_from_starts(
    policy: Any, task: PointMassInterface, indices: Sequence[int], n_steps: int
) -> FloatArray:
    """Return positions, shape (n, n_steps + 1, d), from where demonstrations begin."""
    env = task.like(len(indices), horizon=n_steps)
    first, _ = env.reset(seed=0, options={"demonstration": np.array(indices)})
    return rollouts(policy, [env], first, n_steps)


def stability_rollouts(
    policy: Any,
    task: PointMassInterface,
    indices: Sequence[int],
    push_seeds: Sequence[int],
    n_steps: int,
    push_time: float = PERTURBATION_TIME,
) -> tuple[FloatArray, FloatArray]:
    """Return paths from the grid of starts, and pushed ones from where demonstrations begin.

    Shapes (number of starts, n_steps + 1, d) and (number of indices, n_steps + 1, d).
    """
    demos = task.demonstrations
    low, high = scored_box(demos)
    d = demos.n_dims
    per_axis = None if d in STARTS_PER_AXIS else max(2, round(STARTS ** (1 / d)))
    grid = metrics.start_grid(low, high, per_axis)
    free = task.like(len(grid), horizon=n_steps)
    push = Push(push_time, PERTURBATION_SIZE)
    pushed = task.like(len(indices), horizon=n_steps, perturbation=push)
    from_grid, _ = free.reset(seed=0, options={"start": grid})
    from_starts, _ = pushed.reset(
        seed=list(push_seeds), options={"demonstration": np.array(indices)}
    )
    first = np.concatenate([from_grid, from_starts])
    paths = rollouts(policy, [free, pushed], first, n_steps)
    return paths[: len(grid)], paths[len(grid) :]


def scored_box(demos: Demonstrations) -> BoundingBox:
    """Return the box that starts are taken from: the bounding box, where each side has a length.

    A side without one, as a straight line along an axis has, is given `THINNEST_SIDE` diagonals,
    as the environment gives it in its arena.
    """
    box = demos.bounding_box
    missing = 0.5 * THINNEST_SIDE * box.diagonal * (box.high == box.low)
    return BoundingBox(box.low - missing, box.high + missing)
