"""Golden rollouts of the drumming arm: numbers that move when a score might.

A change that moves them changes what the id means: bump its -vN, then write the new ones with

    python tests/golden/drumming.py

A rollout replays half of a demonstration (two strokes) and goes on with random actions, pushed
with a force. On one machine all of it is the same bits, which `rollout_hash` is of. Another
processor rounds other sums, and no digit would be safe to hash: what is kept are the tip's
positions every `EVERY` steps, to be met within `TOLERANCE`. MuJoCo's arithmetic may change from
version to version, so the file says which one it is for.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import gymnasium
import mujoco
import numpy as np

import iflow_gym  # noqa: F401  (registers the ids)
from iflow_gym.envs.drumming.arguments import ForcePush
from iflow_gym.registration import DRUMMING_ID

PATH = Path(__file__).with_suffix(".json")
REPLAYED, RANDOM = 450, 100
EVERY = 25
TOLERANCE = 1e-4
"""Metres."""


def rollouts() -> np.ndarray:
    """Return tip, forces and reward of the rollouts, one in either control mode."""
    found = []
    for mode in ("velocity", "torque"):
        push = ForcePush(fraction=0.3)
        env = gymnasium.make(
            DRUMMING_ID, control_mode=mode, perturbation=push, observe=("tip", "force")
        )
        base = env.unwrapped
        observation, _ = env.reset(seed=7, options={"demonstration": 1})
        path, rng = base.demonstrations.positions[1], np.random.default_rng(1)
        rows = [[*observation, 0.0]]
        for k in range(REPLAYED + RANDOM):
            if k < REPLAYED:
                velocity = (path[k + 1] - observation[:3]) / base.dt
                action = base.command_to_action(velocity, observation)
            else:
                action = rng.uniform(-1, 1, env.action_space.shape)
            observation, reward, *_ = env.step(action)
            rows.append([*observation, reward])
        found.append(rows)
    return np.array(found)


def rollout_hash() -> str:
    """Return the hash of the rollouts."""
    return hashlib.sha256(rollouts().astype("<f8").tobytes()).hexdigest()


def positions() -> np.ndarray:
    """Return the tip's positions every `EVERY` steps, (2, n, 3)."""
    return rollouts()[:, ::EVERY, :3]


if __name__ == "__main__":
    content = {"mujoco": mujoco.__version__, "tip": np.round(positions(), 5).tolist()}
    PATH.write_text(json.dumps(content) + "\n")
