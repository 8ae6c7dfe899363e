"""Reinforcement learning on top of a learned motion, with and without its guarantee."""

# %% [markdown]
# # Residual reinforcement learning
#
# A field that was learned from demonstrations knows the way, and nothing of the machine that goes
# it. Here the machine is four times as heavy as its controller believes, in a wind. An agent
# learns what to add to the field's command; once with a free hand, once behind a shield that keeps
# the field's Lyapunov function falling, whatever the agent does.
#
# The picture first. *Left:* the mean reward a step while the two learn, beside the field alone.
# *Right:* the worst agent one can think of, which always pushes up V: with a free hand it keeps the
# mass from the goal, behind the shield it cannot.
#
# ![Learning curves, and the worst agent with and without the shield](images/residual_rl.png)

# %%
import os
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from matplotlib.figure import Figure
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from iflow_gym import Demonstrations
from iflow_gym.baselines.imitation_flow import ImitationFlow
from iflow_gym.baselines.residual_learning.tasks import returns_of
from iflow_gym.baselines.residual_learning.vec_env import ArrayVecEnv
from iflow_gym.evaluation.rollouts import rollouts_from_starts
from iflow_gym.plotting import plot_field
from iflow_gym.residual import ResidualActionWrapper, ResidualPolicy
from iflow_gym.residual.composition import Composition, lyapunov_of
from iflow_gym.residual.policy import Hostile

N_STEPS = int(os.environ.get("EXAMPLE_STEPS", 300))  # of the field's training
N_SAMPLES = int(os.environ.get("EXAMPLE_SAMPLES", 30_000))  # of the agents'; a preset takes 10^6
IMAGES = Path(os.environ.get("EXAMPLE_IMAGES", Path(__file__).parent / "images"))
ID, SCALE, N_ENVS = "iflow/Disturbed-Angle-v0", 0.1, 32
torch.set_num_threads(1)  # the networks are small: more threads would wait for each other

# %% [markdown]
# ## The base
#
# Learned from the recordings as always. On this plant it is late, and off the way.

# %%
task = gym.make(ID).unwrapped
base = ImitationFlow(n_steps=N_STEPS).fit(task.demonstrations, seed=0)
print(base.guarantee.kind)

# %% [markdown]
# ## The agents
#
# 32 environments step as one array. `ResidualActionWrapper` adds the agent's velocity, of up to
# `SCALE` greatest speeds, to the base's command. The reward of a step is how well the recording is
# kept at its own time, 1 at best. As long as an agent does no harm the shield takes nothing off,
# and the two learn alike.


# %%
class Curve(BaseCallback):
    """Notes how good the mean action is, from every recording's start, now and then."""

    def __init__(self, stable: bool) -> None:
        super().__init__()
        self.stable, self.samples, self.rewards = stable, [], []

    def _on_rollout_start(self) -> None:
        if len(self.samples) * N_SAMPLES / 3 <= self.num_timesteps:
            self.note()

    def _on_training_end(self) -> None:
        self.note()

    def note(self) -> None:
        """Play an episode from each start."""
        self.samples.append(self.num_timesteps)
        returns = returns_of(self.model, ID, base, SCALE, self.stable)
        self.rewards.append(float(returns.mean()))

    def _on_step(self) -> bool:
        return True


curves = {}
for title, stable in (("free residual", False), ("shielded residual", True)):
    envs = gym.make_vec(ID, N_ENVS, vectorization_mode="vector_entry_point")
    wrapped = ResidualActionWrapper(envs, base, scale=SCALE, stable=stable)
    agent = PPO(
        "MlpPolicy",
        ArrayVecEnv(wrapped),
        n_steps=128,
        batch_size=1024,
        learning_rate=1e-3,
        gamma=0.995,
        use_sde=True,
        policy_kwargs={"net_arch": {"pi": [], "vf": [64, 64]}, "log_std_init": -2.0},
        seed=0,
        device="cpu",
    )
    curves[title] = curve = Curve(stable)
    agent.learn(N_SAMPLES, callback=curve)
    print(f"{title}: from {curve.rewards[0]:.3f} to {curve.rewards[-1]:.3f} a step")

# %% [markdown]
# ## The worst agent
#
# It adds the gradient of V, as much as it may, at every step. On the mass that does what it is told
# the proof holds for every agent and every dt: behind the shield V falls at every step, at a
# quarter of the base's own rate at least, and so the path ends at the goal, if late. (Every 20th
# sample of the recordings: 50 ms to 80 ms a step, so that 20 durations are soon computed.)

# %%
fine = task.demonstrations
coarse = Demonstrations.from_arrays(
    [path[::20] for path in fine.positions], dt=[20 * dt for dt in fine.dt], name="Angle"
)
plain = gym.make("iflow/PointMass-v0", demonstrations=coarse).unwrapped


def attacked(stable: bool) -> np.ndarray:
    """Return paths from the recordings' starts under the worst agent, shape (7, T, 2)."""
    agent = Hostile(Composition(plain, base, SCALE, stable), lyapunov_of(base))
    policy = ResidualPolicy(agent, base, SCALE, stable=stable)
    return rollouts_from_starts(policy, plain, range(len(coarse)), n_steps=1000)


attacks = {title: attacked(stable) for title, stable in zip(curves, (False, True), strict=True)}
for title, paths in attacks.items():
    left = np.linalg.norm(paths[:, -1] - coarse.goal, axis=1)
    height = base.lyapunov(paths)
    rises = int((np.diff(height, axis=1) > 1e-12 * height[:, :1]).sum())  # beyond rounding
    print(f"{title}, worst agent: {left.max():.1f} mm from the goal; V rose in {rises} steps")

# %% [markdown]
# ## The picture

# %%
figure = Figure(figsize=(13, 4.4), layout="constrained", facecolor="white")
learning, *worst = figure.subplots(1, 3)
for (title, curve), colour in zip(curves.items(), ("#d55e00", "#0072b2"), strict=True):
    learning.plot(curve.samples, curve.rewards, "o-", color=colour, label=title)
alone = next(iter(curves.values())).rewards[0]
learning.axhline(alone, color="#4d4d4d", linestyle="--", label="before learning")
learning.set(xlabel="samples", ylabel="mean reward a step", title="what is learned")
learning.legend(frameon=False)
for ax, (title, paths) in zip(worst, attacks.items(), strict=True):
    plot_field(ax, base, fine, list(paths), linewidth=1.2)
    ax.set_title(f"worst agent, {title}")
IMAGES.mkdir(exist_ok=True)
figure.savefig(IMAGES / "residual_rl.png", dpi=100)
print("saved", IMAGES / "residual_rl.png")
