"""Golden rollouts: a hash per environment id that moves when a score might.

A change that moves a hash changes what an id means: bump its -vN, then write the new hashes with

    python tests/golden/environments.py

Each rollout is played in every control mode that the id has, pushed, from a random start, with
actions within and beyond the box. Observations and rewards are rounded to 6 decimals before
hashing: arithmetic is the same bits wherever IEEE 754 is, and what is not (exp, the normal numbers
of generators) differs far below that.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import gymnasium
import numpy as np

import iflow_gym
from iflow_gym.datasets.lasa import SHAPES
from iflow_gym.datasets.letters import LETTERS
from iflow_gym.envs.task import Push
from iflow_gym.registration import POINT_MASS_ID, disturbed_id, lasa_id, letter_id

PATH = Path(__file__).with_suffix(".json")
STEPS = 300


def own_demonstrations(n_dims: int = 2) -> iflow_gym.Demonstrations:
    """Make spirals into a goal (in one dimension: ways straight there), of 200 samples."""
    turn = 4 if n_dims > 1 else 1
    t = np.linspace(0.0, 1.0, 200)[:, None]
    phases = np.arange(n_dims) * np.pi / 2
    radius = (1 - t) ** 2 * (1 + 2 * t)
    paths = [
        scale * radius * np.cos(turn * t + phases) + np.arange(n_dims) for scale in (1.0, 1.1, 0.9)
    ]
    return iflow_gym.Demonstrations.from_arrays(paths, dt=[0.01, 0.012, 0.009], name="spiral")


def arguments(env_id: str) -> dict[str, object]:
    """Return what an id needs besides its name."""
    return {"demonstrations": own_demonstrations()} if env_id == POINT_MASS_ID else {}


DISTURBED = [disturbed_id(shape) for shape in ("Angle", "Sshape", "Multi_Models_2")]
"""Some of the shapes: the plant and the wind are the same for all."""

IDS = [POINT_MASS_ID, *map(lasa_id, SHAPES), *map(letter_id, LETTERS)]


def rollout_hash(env_id: str) -> str:
    """Return the hash of an id's rollouts."""
    digest = hashlib.sha256()
    for mode in ("force",) if env_id in DISTURBED else ("velocity", "force"):
        push = Push(fraction=0.2)
        env = gymnasium.make(env_id, control_mode=mode, perturbation=push, **arguments(env_id))
        rng = np.random.default_rng(1)
        observation, info = env.reset(seed=7)
        measured = env.unwrapped.task.guide.measured
        rows = [[*observation, 0.0, *(info[key] for key in measured)]]
        for _ in range(STEPS):
            action = 1.5 * rng.uniform(-1, 1, env.unwrapped.n_dims) ** 3
            observation, reward, _, truncated, info = env.step(action)
            rows.append([*observation, reward, *(info[key] for key in measured)])
            if truncated:
                observation, _ = env.reset()
        digest.update((np.round(np.array(rows), 6) + 0.0).astype("<f8").tobytes())
    return digest.hexdigest()


if __name__ == "__main__":
    PATH.write_text(json.dumps({i: rollout_hash(i) for i in (*IDS, *DISTURBED)}, indent=1) + "\n")
