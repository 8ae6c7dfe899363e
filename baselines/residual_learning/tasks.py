"""The environments that an agent is trained and evaluated in."""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import gymnasium
import numpy as np
from gymnasium.envs.registration import load_env_creator
from gymnasium.vector import AutoresetMode, VectorEnv

from iflow_gym.baselines.residual_learning.settings import Reward
from iflow_gym.baselines.residual_learning.vec_env import ArrayVecEnv
from iflow_gym.demonstrations import FloatArray
from iflow_gym.envs.hit_reward import HitReward, Stroke
from iflow_gym.envs.point_mass_vector import PointMassVectorEnv
from iflow_gym.residual.wrapper import ResidualActionWrapper, ResidualVectorWrapper


def batch_of(
    env_id: str, num_envs: int, reward: Reward = "environment", **arguments: Any
) -> VectorEnv[Any, Any, Any]:
    """Return environments of an id that step together and never begin anew by themselves.

    As one array where the suite has that, else one after the other in this process.
    """
    if _one_array(env_id):
        if reward == "hits":
            raise ValueError(
                f"Expected an environment with drums for reward='hits', got {env_id!r}: choose a "
                "preset with reward='environment'."
            )
        return gymnasium.make_vec(env_id, num_envs, "vector_entry_point", **arguments)
    return gymnasium.make_vec(
        env_id,
        num_envs,
        "sync",
        vector_kwargs={"autoreset_mode": AutoresetMode.DISABLED},
        wrappers=[HitReward] if reward == "hits" else None,
        **arguments,
    )


def _one_array(env_id: str) -> bool:
    """Whether the suite steps many environments of an id as one array, in this process."""
    point = gymnasium.spec(env_id).vector_entry_point
    made: Any = load_env_creator(point) if isinstance(point, str) else point
    return isinstance(made, type) and issubclass(made, PointMassVectorEnv)


def residual_vec_env(
    env_id: str,
    num_envs: int,
    base_policy: Any,
    scale: float,
    stable: bool | float,
    reward_scale: float = 1.0,
    reward: Reward = "environment",
) -> ArrayVecEnv:
    """Return what Stable-Baselines3 trains in."""
    batch = batch_of(env_id, num_envs, reward)
    return ArrayVecEnv(
        ResidualVectorWrapper(batch, base_policy, scale, stable=stable), reward_scale
    )


def returns_of(
    agent: Any,
    env_id: str,
    base_policy: Any,
    scale: float,
    stable: bool | float,
    reward: Reward = "environment",
) -> FloatArray:
    """Return the mean reward a step of one episode from each recording's start, shape (n,).

    The agent takes its mean action; only the recordings that are shown count. By the environment's
    reward a replay gets about 1, standing still 0 (`iflow_gym.envs.guide`).
    """
    task: Any = gymnasium.make(env_id).unwrapped
    indices = range(len(task.demonstrations.shown))
    if not _one_array(env_id):
        own = HitReward(task) if reward == "hits" else task
        env = ResidualActionWrapper(own, base_policy, scale, stable=stable)
        return np.array([_episode(agent, env, i).reward for i in indices])
    n = len(indices)
    envs = ResidualVectorWrapper(batch_of(env_id, n, reward), base_policy, scale, stable=stable)
    lengths = np.array([len(task.demonstrations.positions[i]) - 1 for i in indices])
    observations, _ = envs.reset(seed=0, options={"demonstration": np.array(indices)})
    sums = np.zeros(n)
    for k in range(int(lengths.max())):
        actions, _ = agent.predict(observations, deterministic=True)
        observations, rewards, _, _, _ = envs.step(actions)
        sums += np.where(k < lengths, rewards, 0.0)
    return np.asarray(sums / lengths)


def performance(
    agent: Any, env_id: str, base_policy: Any, scale: float, stable: bool | float
) -> dict[str, float]:
    """Return what a record holds of the rewards: `iflow_gym.results.Result.returns`.

    `mean`, `least` and `greatest` over the recordings of the environment's own reward a step. Where
    there are drums also `hits`, the mean by `HitReward`, and of all strokes `stroke_force`, the
    mean force in N, and `stroke_error`, the mean distance in s from when they were due; a stroke
    of a drum that was not due counts in neither, nor does what does not happen: see the metrics.
    """
    task: Any = gymnasium.make(env_id).unwrapped
    if not hasattr(task, "score_of"):
        return _spread(returns_of(agent, env_id, base_policy, scale, stable))
    env = ResidualActionWrapper(HitReward(task), base_policy, scale, stable=stable)
    episodes = [_episode(agent, env, i) for i in range(len(task.demonstrations.shown))]
    found = _spread(np.array([episode.progress for episode in episodes]))
    found["hits"] = float(np.mean([episode.reward for episode in episodes]))
    due = [s for episode in episodes for s in episode.strokes if s.error is not None]
    if due:
        found["stroke_force"] = float(np.mean([s.hit.force for s in due]))
        found["stroke_error"] = float(np.mean([abs(cast("float", s.error)) for s in due]))
    return found


class _Episode(NamedTuple):
    reward: float
    """Mean a step."""
    progress: float
    """Mean a step of the environment's own reward, where another one wraps it; else 0."""
    strokes: list[Stroke]


def _episode(agent: Any, env: Any, index: int) -> _Episode:
    observation, _ = env.reset(seed=0, options={"demonstration": index})
    total, progress, count, truncated = 0.0, 0.0, 0, False
    strokes: list[Stroke] = []
    while not truncated:
        action, _ = agent.predict(observation, deterministic=True)
        observation, reward, _, truncated, info = env.step(action)
        total, count = total + float(reward), count + 1
        progress += info.get("progress", 0.0)
        strokes += info.get("strokes", ())
    return _Episode(total / count, progress / count, strokes)


def _spread(returns: FloatArray) -> dict[str, float]:
    return {
        "mean": float(returns.mean()),
        "least": float(returns.min()),
        "greatest": float(returns.max()),
    }
