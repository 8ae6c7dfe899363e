"""Makes the pictures of the documentation: `python docs/pictures.py`, a minute and a half.

docs/images/bend.png         the README's: one latent system, bent into three motions
docs/images/environment.png  a frame of an environment, with a policy's stream lines
docs/images/seds.png         level sets of SEDS's V over its stream lines, and where it fails
docs/images/clf-dm.png       level sets of CLF-DM's V over its stream lines
"""

from collections.abc import Sequence
from pathlib import Path

import gymnasium as gym
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import iflow_gym  # registers the environments
from iflow_gym.baselines.clf_dm import CLFDM
from iflow_gym.baselines.imitation_flow import ImitationFlow
from iflow_gym.baselines.seds import SEDS
from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.figures import reproductions, save_figure
from iflow_gym.plotting import plot_field, plot_streamlines, view
from iflow_gym.system import DynamicalSystem

IMAGES = Path(__file__).parent / "images"
SHAPES = ("Sshape", "GShape", "Sharpc")


def bend() -> None:
    """Draw the latent system and what the flow makes of it, with paths from beside the data."""
    motions = [load_lasa(shape) for shape in SHAPES]
    systems = ImitationFlow().fit_many(motions, seeds=[0] * len(SHAPES))
    figure = Figure(figsize=(13, 3.6), layout="constrained", dpi=110)
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(SHAPES) + 1)
    latent = systems[0]._latent
    corner = np.array([1.5, 1.5])
    plot_streamlines(axes[0], lambda z: z @ latent.drift.T, -corner, corner)
    axes[0].plot(0, 0, "o", color="black", markersize=7)
    axes[0].set_title("latent system, $dz = A z\\,dt$")
    for ax, motion, system in zip(axes[1:], motions, systems, strict=True):
        starts = np.random.default_rng(3).uniform(*motion.bounding_box, size=(8, 2))
        plot_field(ax, system, motion, list(system.rollout(starts, 2000, motion.mean_dt)))
        ax.set_title(f"$y = h(z)$ for {motion.name}")
    for ax in axes:
        ax.set(xticks=[], yticks=[], xlabel="", ylabel="")
        ax.set_aspect("equal")
    figure.savefig(IMAGES / "bend.png", bbox_inches="tight")


def environment() -> None:
    """Draw a frame of the environment half way through an episode."""
    motion = load_lasa("Sshape")
    system = ImitationFlow(n_steps=600).fit(motion, seed=0)
    env = gym.make("iflow/LASA-Sshape-v0", policy=system, render_mode="rgb_array")
    policy = iflow_gym.DynamicalSystemPolicy(system, env)
    observation, _ = env.reset(seed=0, options={"start": [-6.0, 20.0]})
    for _ in range(600):
        action, _ = policy.predict(observation)
        observation, *_ = env.step(action)
    frame = env.render()
    figure = Figure(figsize=(frame.shape[1] / 100, frame.shape[0] / 100), dpi=100)
    FigureCanvasAgg(figure)
    figure.figimage(frame)
    figure.savefig(IMAGES / "environment.png")


def level_sets(method: type[DynamicalSystem], shapes: Sequence[str], name: str) -> None:
    """Draw level sets of V over the stream lines, with the reproductions of the recordings."""
    figure = Figure(figsize=(4.4 * len(shapes), 4.5), layout="constrained", dpi=110)
    FigureCanvasAgg(figure)
    for ax, shape in zip(figure.subplots(1, len(shapes)), shapes, strict=True):
        motion = load_lasa(shape)
        system = method().fit(motion, seed=0)
        plot_field(ax, system, motion, reproductions(system, motion))
        low, high = view(motion)
        axes = [np.linspace(a, b, 200) for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*axes), axis=-1)
        # Levels that share the picture out evenly: V is flat along a motion and steep beside it.
        height = np.asarray(system.lyapunov(grid))
        levels = np.quantile(height, np.linspace(0, 1, 26)[1:-1])
        ax.contour(*axes, height, levels, colors="#4d4d4d", linewidths=0.7, alpha=0.75, zorder=2)
        ax.set_title(motion.name)
    save_figure(figure, IMAGES / name, dpi=110)


def seds() -> None:
    """Draw SEDS on a motion that it can make, one it makes roughly, and one it cannot make."""
    level_sets(SEDS, ("Worm", "Angle", "Sharpc"), "seds.png")


def clf_dm() -> None:
    """Draw CLF-DM on the same motions."""
    level_sets(CLFDM, ("Worm", "Angle", "Sharpc"), "clf-dm.png")


if __name__ == "__main__":
    IMAGES.mkdir(exist_ok=True)
    seds()
    clf_dm()
    environment()
    bend()
