"""Agents of Stable-Baselines3: made from settings, and read from their files without unpickling.

An agent's file is the zip that its `save` writes. Stable-Baselines3's `load` unpickles parts of it,
which runs whatever a stranger put there; here an agent is made anew from the settings, which are
JSON, and only its tensors are read (``torch.load(weights_only=True)``).
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch

from iflow_gym.baselines.residual_learning.settings import TrainingSettings


class AgentFileError(ValueError):
    """A file is no agent, or not the one that is asked for."""


def make_agent(settings: TrainingSettings, env: Any, seed: int, tensorboard: Path | None) -> Any:
    """Return an untrained agent of Stable-Baselines3 on the CPU."""
    from stable_baselines3 import PPO, SAC, TD3
    from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise

    kinds: dict[str, Any] = {"ppo": PPO, "sac": SAC, "td3": TD3}
    keywords = dict(settings.keywords)
    if settings.algorithm == "td3" and settings.action_noise > 0:
        size = env.action_space.shape[0]
        noise = NormalActionNoise(np.zeros(size), np.full(size, settings.action_noise))
        keywords["action_noise"] = VectorizedActionNoise(noise, env.num_envs)
    if settings.decay and "learning_rate" in keywords:
        rate = float(keywords["learning_rate"])
        keywords["learning_rate"] = lambda remaining: rate * remaining
    return kinds[settings.algorithm](
        "MlpPolicy",
        env,
        policy_kwargs=dict(settings.policy),
        seed=seed,
        device="cpu",
        tensorboard_log=None if tensorboard is None else str(tensorboard),
        **keywords,
    )


def read_agent(
    settings: TrainingSettings,
    path: Path,
    observation_space: gymnasium.Space[Any],
    action_space: gymnasium.Space[Any],
) -> Any:
    """Return the agent of a file, to be asked and not to be trained.

    Raises
    ------
    AgentFileError
        If the file is no agent of these settings and spaces.
    """
    env = spaces_only(observation_space, action_space, settings.num_envs)
    agent = make_agent(settings, env, 0, None)
    set_parameters(agent, path)
    return agent


def set_parameters(agent: Any, path: Path) -> None:
    """Read the tensors of an agent's file, its optimizer's too; raise AgentFileError otherwise."""
    if not path.is_file():
        raise FileNotFoundError(f"Expected the file of an agent at {path}, got none.")
    try:
        agent.set_parameters(str(path), exact_match=True, device="cpu")
    except (RuntimeError, ValueError, KeyError, AttributeError, zipfile.BadZipFile) as error:
        first = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise AgentFileError(
            f"Expected {path} to be an agent of Stable-Baselines3 with these settings and spaces, "
            f"got something else: {first}"
        ) from error


def one_thread() -> None:
    """Let torch use one thread: small networks gain nothing from more."""
    torch.set_num_threads(1)


def spaces_only(observation_space: Any, action_space: Any, num_envs: int) -> Any:
    """Return environments that have spaces and are never stepped."""
    from stable_baselines3.common.vec_env import DummyVecEnv

    class Spaces(gymnasium.Env[Any, Any]):
        def __init__(self) -> None:
            self.observation_space, self.action_space = observation_space, action_space

    return DummyVecEnv([Spaces] * num_envs)
