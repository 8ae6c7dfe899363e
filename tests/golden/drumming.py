"""Golden rollouts of the drumming arm: a hash that moves when a score might.

A change that moves it changes what the id means: bump its -vN, then write the new hash with

    python tests/golden/drumming.py

A rollout replays half of a demonstration (two strokes) and goes on with random actions, pushed
with a force; positions, forces and rewards are rounded to 5 decimals before hashing. MuJoCo's
arithmetic may change from version to version, so the file says which one it is for.
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


def rollout_hash() -> str:
    """Return the hash of the rollouts, one in either control mode."""
    digest = hashlib.sha256()
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
        digest.update((np.round(np.array(rows), 5) + 0.0).astype("<f8").tobytes())
    return digest.hexdigest()


if __name__ == "__main__":
    content = {"mujoco": mujoco.__version__, "sha256": rollout_hash()}
    PATH.write_text(json.dumps(content, indent=1) + "\n")
