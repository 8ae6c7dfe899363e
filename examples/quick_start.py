"""Learn a handwritten S from seven recordings, look at the field, run it, push it, score it."""

# %% [markdown]
# # Quick start
#
# Learn a handwritten S from seven recordings, look at what was learned, run it, push it, score it.
#
# The picture first. *Left:* the field that was learned, the recordings in orange, and paths from
# anywhere in green. *Right:* the same system in the environment, pushed half way.
#
# ![The learned field, and pushed rollouts](images/quick_start.png)

# %%
import os
from pathlib import Path

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

import iflow_gym
from iflow_gym.baselines.imitation_flow import ImitationFlow
from iflow_gym.envs.task import Push
from iflow_gym.plotting import plot_field

N_STEPS = int(os.environ.get("EXAMPLE_STEPS", 600))  # of training; None is the default, 4500
IMAGES = Path(os.environ.get("EXAMPLE_IMAGES", Path(__file__).parent / "images"))

# %% [markdown]
# ## Demonstrations
#
# An environment hands out the recordings of its motion. The state is the pen's position in mm.

# %%
env = gym.make("iflow/LASA-Sshape-v0")
demonstrations = env.unwrapped.demonstrations
print(demonstrations, "ends at", demonstrations.goal)

# %% [markdown]
# ## Learning
#
# ImitationFlow bends a stable linear system until its paths are the recordings. Whatever the
# training came to, the result ends at the goal from everywhere: the guarantee is `proved`.

# %%
system = ImitationFlow(n_steps=N_STEPS).fit(demonstrations, seed=0)
print(system.guarantee.kind)
print(system.guarantee.reason)

# %% [markdown]
# ## Asking it
#
# A velocity for any state, and whole paths in closed form, many at once. The Lyapunov function
# falls along each of them.

# %%
rng = np.random.default_rng(0)
low, high = demonstrations.bounding_box
starts = rng.uniform(low - 10, high + 10, size=(12, 2))
paths = system.rollout(starts, n_steps=1500, dt=demonstrations.mean_dt)  # (12, 1501, 2)
print("velocity at the first start, mm/s:", system.velocity(starts[0]).round(1))
print("V falls along all paths:", bool((np.diff(system.lyapunov(paths), axis=1) < 0).all()))

# %% [markdown]
# ## Running it
#
# `DynamicalSystemPolicy` turns states into actions. The environment pushes the pen once by a
# quarter of the recordings' size. A field has no clock, so it goes on from wherever it is.


# %%
def run(push: Push | None, demonstration: int) -> np.ndarray:
    """Return the path of an episode of two durations, shape (T, 2)."""
    horizon = 2 * len(demonstrations.positions[demonstration])
    env = gym.make("iflow/LASA-Sshape-v0", perturbation=push, horizon=horizon)
    policy = iflow_gym.DynamicalSystemPolicy(system, env)
    observation, info = env.reset(seed=0, options={"demonstration": demonstration})
    path = [observation]
    for _ in range(horizon):
        action, _ = policy.predict(observation)
        observation, *_, info = env.step(action)
        path.append(observation)
    print(f"ended {info['distance_to_goal']:.2f} mm from the goal")
    return np.stack(path)


pushes = [Push(fraction=0.4, size=0.25, direction=(a, b)) for a, b in ((1, 0.5), (-1, -1), (0, 1))]
pushed = [run(push, demonstration=k) for k, push in enumerate(pushes)]

# %% [markdown]
# ## Its score
#
# Rollouts from every recording's start, from a grid of starts and with pushes, in the
# environment. Lengths are mm. More training steps bring the distances down (2.4 mm at 4500).

# %%
scores = env.unwrapped.score(system, seed=0)
for name in ("rmse", "frechet", "converged", "perturbation_recovery", "lyapunov_violation"):
    print(f"{name:22} {scores[name]:.3g}")

# %% [markdown]
# ## The picture

# %%
figure = Figure(figsize=(9, 4.6), layout="constrained", facecolor="white")
left, right = figure.subplots(1, 2)
plot_field(left, system, demonstrations, paths)
left.set_title("the field, and paths from anywhere")
plot_field(right, system, demonstrations, pushed)
right.set_title("in the environment, pushed")
IMAGES.mkdir(exist_ok=True)
figure.savefig(IMAGES / "quick_start.png", dpi=100)
print("saved", IMAGES / "quick_start.png")
