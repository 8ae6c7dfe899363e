"""A Gymnasium vector environment as a VecEnv of Stable-Baselines3: environments as one array.

The two differ in when an episode begins anew. Stable-Baselines3 wants the first observation of the
new episode in the step that ends the old one, and the old one's last observation under
``infos[i]["terminal_observation"]``; so this adapter resets where an episode ended, within the same
step, by ``reset(options={"reset_mask": mask})``, and the vector environment never does it itself.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnv


class ArrayVecEnv(VecEnv):
    """A vector environment whose `reset` takes a mask, for Stable-Baselines3.

    Of iflow_gym those made with ``vectorization_mode="vector_entry_point"`` do, and Gymnasium's
    `SyncVectorEnv` and `AsyncVectorEnv` with ``autoreset_mode=AutoresetMode.DISABLED``.
    Observations are float32.

    Parameters
    ----------
    env : VectorEnv
    reward_scale : float
        What rewards are multiplied by for the agent; the episodes' statistics are of those that the
        environment gave.

    Attributes
    ----------
    cpu_seconds, wall_seconds : float
        Spent in the environment so far, resets included.
    n_steps : int
        Steps of single environments so far.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], reward_scale: float = 1.0) -> None:
        if not isinstance(env, VectorEnv):
            raise TypeError(f"Expected a gymnasium VectorEnv, got {type(env).__name__}.")
        mode = env.metadata.get("autoreset_mode")
        masked = mode == AutoresetMode.DISABLED or hasattr(env.unwrapped, "_checked_mask")
        if not masked:
            raise ValueError(
                "Expected a vector environment that resets under a mask, got one with "
                f"autoreset_mode={mode}: make it with vectorization_mode='vector_entry_point', or "
                "with vector_kwargs={'autoreset_mode': AutoresetMode.DISABLED}."
            )
        self.env = env
        self._scale = reward_scale
        self.render_mode = None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._actions: Any = None
        self._seed_of_reset: int | None = None
        self._returns = np.zeros(env.num_envs)
        self._lengths = np.zeros(env.num_envs, dtype=np.int64)
        self.cpu_seconds = self.wall_seconds = 0.0
        self.n_steps = 0
        self._began = time.perf_counter()

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the next reset."""
        self._seed_of_reset = seed
        return [None if seed is None else seed + i for i in range(self.num_envs)]

    def reset(self) -> Any:
        """Begin an episode in each environment."""
        with self._timed():
            observations, _ = self.env.reset(seed=self._seed_of_reset)
        self._seed_of_reset = None
        self._returns[:] = 0
        self._lengths[:] = 0
        self.reset_infos = [{} for _ in range(self.num_envs)]
        return np.asarray(observations, dtype=np.float32)

    def step_async(self, actions: Any) -> None:
        """Keep the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> Any:
        """Step all; where an episode ends the observation is the next one's first."""
        with self._timed():
            observations, rewards, terminated, truncated, _ = self.env.step(self._actions)
            done = np.asarray(terminated) | np.asarray(truncated)
            infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
            self._returns += rewards
            self._lengths += 1
            self.n_steps += self.num_envs
            last = np.asarray(observations, dtype=np.float32)
            if done.any():
                elapsed = round(time.perf_counter() - self._began, 6)
                for i in np.flatnonzero(done).tolist():
                    infos[i]["terminal_observation"] = last[i].copy()
                    infos[i]["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
                    infos[i]["episode"] = {
                        "r": float(self._returns[i]), "l": int(self._lengths[i]), "t": elapsed
                    }  # fmt: skip
                first, _ = self.env.reset(options={"reset_mask": done})
                last = np.where(done[:, None], np.asarray(first, dtype=np.float32), last)
                self._returns[done] = 0
                self._lengths[done] = 0
        return last, np.asarray(self._scale * rewards, dtype=np.float32), done, infos

    def _timed(self) -> _Clock:
        return _Clock(self)

    def close(self) -> None:
        """Close the vector environment."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the whole vector environment, for each index."""
        value = getattr(self, attr_name, None) if attr_name == "render_mode" else None
        if attr_name != "render_mode":
            value = getattr(self.env, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse: the environments are one."""
        raise NotImplementedError("The environments are one array: make another vector env.")

    def env_method(
        self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any
    ) -> list[Any]:
        """Refuse: the environments are one."""
        raise NotImplementedError("The environments are one array: call venv.env in its place.")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Return whether episodes are recorded, which they are, for `Monitor`; False for others."""
        from stable_baselines3.common.monitor import Monitor

        return [wrapper_class is Monitor for _ in self._get_indices(indices)]


class _Clock:
    """Adds the time that passes within it to a `ArrayVecEnv`'s."""

    def __init__(self, owner: ArrayVecEnv) -> None:
        self._owner = owner

    def __enter__(self) -> None:
        self._cpu, self._wall = time.process_time(), time.perf_counter()

    def __exit__(self, *_: object) -> None:
        self._owner.cpu_seconds += time.process_time() - self._cpu
        self._owner.wall_seconds += time.perf_counter() - self._wall
