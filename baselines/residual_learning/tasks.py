"""The environments that an agent is trained and evaluated in."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

from iflow_gym.baselines.residual_learning.vec_env import ArrayVecEnv
from iflow_gym.demonstrations import FloatArray
from iflow_gym.residual.wrapper import ResidualActionWrapper, ResidualVectorWrapper


def batch_of(env_id: str, num_envs: int, **arguments: Any) -> VectorEnv[Any, Any, Any]:
    """Return environments of an id that step together and never begin anew by themselves.

    As one array where the suite has that, else one after the other in this process.
    """
    if gymnasium.spec(env_id).vector_entry_point is not None:
        return gymnasium.make_vec(env_id, num_envs, "vector_entry_point", **arguments)
    return gymnasium.make_vec(
        env_id,
        num_envs,
        "sync",
        vector_kwargs={"autoreset_mode": AutoresetMode.DISABLED},
        **arguments,
    )


def residual_vec_env(
    env_id: str,
    num_envs: int,
    base_policy: Any,
    scale: float,
    stable: bool | float,
    reward_scale: float = 1.0,
) -> ArrayVecEnv:
    """Return what Stable-Baselines3 trains in."""
    batch = batch_of(env_id, num_envs)
    return ArrayVecEnv(
        ResidualVectorWrapper(batch, base_policy, scale, stable=stable), reward_scale
    )


def returns_of(
    agent: Any, env_id: str, base_policy: Any, scale: float, stable: bool | float
) -> FloatArray:
    """Return the mean reward a step of one episode from each recording's start, shape (n,).

    The agent takes its mean action; only the recordings that are shown count. A replay gets about
    1, standing still 0 (`iflow_gym.envs.guide`).
    """
    task: Any = gymnasium.make(env_id).unwrapped
    indices = range(len(task.demonstrations.shown))
    if gymnasium.spec(env_id).vector_entry_point is None:
        env = ResidualActionWrapper(task, base_policy, scale, stable=stable)
        return np.array([_episode(agent, env, i) for i in indices])
    n = len(indices)
    envs = ResidualVectorWrapper(batch_of(env_id, n), base_policy, scale, stable=stable)
    lengths = np.array([len(task.demonstrations.positions[i]) - 1 for i in indices])
    observations, _ = envs.reset(seed=0, options={"demonstration": np.array(indices)})
    sums = np.zeros(n)
    for k in range(int(lengths.max())):
        actions, _ = agent.predict(observations, deterministic=True)
        observations, rewards, _, _, _ = envs.step(actions)
        sums += np.where(k < lengths, rewards, 0.0)
    return np.asarray(sums / lengths)


def _episode(agent: Any, env: Any, index: int) -> float:
    observation, _ = env.reset(seed=0, options={"demonstration": index})
    total, count, truncated = 0.0, 0, False
    while not truncated:
        action, _ = agent.predict(observation, deterministic=True)
        observation, reward, _, truncated, _ = env.step(action)
        total, count = total + float(reward), count + 1
    return total / count
