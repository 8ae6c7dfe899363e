"""The demonstrations as transitions of the drumming environment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from iflow_gym.envs.drumming.env import DrummingEnv

KEYS: Final = (
    "observations",
    "actions",
    "next_observations",
    "rewards",
    "terminals",
    "timeouts",
)
"""D4RL's."""


def transitions(env: DrummingEnv, split: str, part: str) -> dict[str, NDArray[Any]]:
    """Play the demonstrations of a split's part; see `DrummingEnv.get_dataset`.

    `env` is not stepped: one like it is made, without its perturbation and horizon.
    """
    parts = env.demonstrations.split(split)
    if part not in parts._fields:
        raise ValueError(f"Expected part {' or '.join(parts._fields)}, got {part!r}.")
    demos = getattr(parts, part)
    player = env.like()
    rows: dict[str, list[Any]] = {key: [] for key in KEYS}
    for index, positions in enumerate(env.demonstrations.positions):
        if not any(positions is p for p in demos.positions):
            continue
        observation, _ = player.reset(options={"demonstration": index})
        for following in positions[1:]:
            velocity = (following - observation[:3]) / player.dt
            action = player.command_to_action(velocity, observation)
            arrived, reward, terminal, timeout, _ = player.step(action)
            transition = (observation, action, arrived, reward, terminal, timeout)
            for key, value in zip(KEYS, transition, strict=True):
                rows[key].append(value)
            observation = arrived
    return {key: np.array(values) for key, values in rows.items()}
