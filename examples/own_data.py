"""From a CSV file of recordings to a policy: reading, checking, learning, comparing, keeping it."""

# %% [markdown]
# # Your own data
#
# From a CSV file of recordings to a policy: reading, checking, learning, comparing two methods,
# and keeping the one that always arrives in a file.
#
# The picture first. *Left:* the recordings, with uneven samples. *Middle:* a Gaussian mixture
# regression learned from them, *right:* ImitationFlow, both from starts around the recordings.
#
# ![The recordings, and two systems learned from them](images/own_data.png)

# %%
import csv
import os
import tempfile
from pathlib import Path

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

import iflow_gym
from iflow_gym import Demonstrations
from iflow_gym.baselines.gmr import GMR
from iflow_gym.baselines.imitation_flow import ImitationFlow
from iflow_gym.plotting import plot_field

N_STEPS = int(os.environ.get("EXAMPLE_STEPS", 300))  # of training; None is the default, 4500
IMAGES = Path(os.environ.get("EXAMPLE_IMAGES", Path(__file__).parent / "images"))
FOLDER = Path(tempfile.mkdtemp())

# %% [markdown]
# ## A file
#
# Somebody led a tool over an obstacle and down to a socket, five times: columns are the
# recording's number, the time in s, x and y in m. (This cell makes the file up, so that the
# example needs none; yours comes from a robot or a tracker.)

# %%
rng = np.random.default_rng(1)
with open(FOLDER / "reach.csv", "w", newline="") as file:
    rows = csv.writer(file)
    rows.writerow(["recording", "time", "x", "y"])
    for recording in range(5):
        n = int(rng.integers(140, 220))  # recordings differ in length,
        time = np.sort(rng.uniform(0, 1, n - 2))  # and samples come unevenly
        time = np.concatenate([[0], time, [1]])
        way = 10 * time**3 - 15 * time**4 + 6 * time**5  # rest to rest
        side, height = rng.normal(0, 0.02, 2)
        x = -0.6 * (1 - way) + side * (1 - way)
        y = (0.35 + height) * np.sin(np.pi * way) * (1 - 0.3 * way) + 0.1 * (1 - way)
        for row in zip(time * rng.uniform(1.8, 2.4), x, y, strict=True):
            rows.writerow([recording, *row])

# %% [markdown]
# ## Reading it
#
# `Demonstrations` checks what comes in, and says what is wrong with it. Samples that are uneven in
# time are refused, unless `resample=True` allows to interpolate them.

# %%
table = np.genfromtxt(FOLDER / "reach.csv", delimiter=",", skip_header=1)
table = table[np.isfinite(table).all(axis=1)]  # an empty cell is nan: a lost sample goes
groups = [table[table[:, 0] == k] for k in np.unique(table[:, 0])]
arrays = {"times": [g[:, 1] for g in groups], "name": "reach", "length_unit": "m"}
try:
    Demonstrations.from_arrays([g[:, 2:] for g in groups], **arrays)
except ValueError as error:
    print("refused:", error)
motion = Demonstrations.from_arrays([g[:, 2:] for g in groups], **arrays, resample=True)
print(motion, "ends at", motion.goal.round(3), "after", motion.durations.round(2), "s")

# %% [markdown]
# ## Learning it twice
#
# A Gaussian mixture regression, which is fast and promises nothing, and ImitationFlow.

# %%
systems = [GMR().fit(motion, seed=0), ImitationFlow(n_steps=N_STEPS).fit(motion, seed=0)]

# %% [markdown]
# ## Comparing them
#
# `iflow/PointMass-v0` is the environment of any demonstrations. Lengths are m here.

# %%
env = gym.make("iflow/PointMass-v0", demonstrations=motion)
for system in systems:
    scores = env.unwrapped.score(system, seed=0)
    print(
        f"{system.title:14} guarantee {system.guarantee.kind:6}  Fréchet {scores['frechet']:.3f} m"
        f"  converged from {scores['converged']:.0%} of 256 starts"
    )

# %% [markdown]
# ## Keeping it
#
# A model file holds numbers and JSON, nothing that could be executed. It has the goal and the
# settings; to run it in your own loop a greatest speed and a sample time are all it takes.

# %%
system = systems[1]
system.save(FOLDER / "reach.safetensors")
again = ImitationFlow.load(FOLDER / "reach.safetensors")
policy = iflow_gym.DynamicalSystemPolicy(again, max_speed=2.0, dt=0.01)
state = np.array([-0.7, 0.3])
for _ in range(300):  # your loop: measure the state, command a velocity
    velocity = policy.command(state, 0.01)  # m/s
    state = state + 0.01 * velocity
print("after 3 s at", state.round(4))

# %% [markdown]
# `system.export("reach.onnx")` writes the step for ONNX Runtime, which needs nothing of this
# package: see [real time](../docs/real-time.md).
#
# ## The picture

# %%
low, high = motion.bounding_box
sides = np.linspace(low - 0.15, high + 0.15, 4)
starts = np.stack(np.meshgrid(*sides.T), axis=-1).reshape(-1, 2)
n = int(2 * motion.durations.max() / 0.01)
figure = Figure(figsize=(13, 4.6), layout="constrained", facecolor="white")
recorded, *learned = figure.subplots(1, 3)
plot_field(recorded, None, motion)
recorded.set_title("recordings")
for ax, system in zip(learned, systems, strict=True):
    plot_field(ax, system, motion, system.rollout(starts, n, 0.01), linewidth=1.2)
    ax.set_title(f"{system.title}: {system.guarantee.kind}")
IMAGES.mkdir(exist_ok=True)
figure.savefig(IMAGES / "own_data.png", dpi=100)
print("saved", IMAGES / "own_data.png")
