"""Makes the pictures of the documentation: `python docs/pictures.py`, two minutes.

docs/images/bend.png         the README's: one latent system, bent into three motions
docs/images/conditional.png  one model of four shapes, and a context between two of them
docs/images/environment.png  a frame of an environment, with a policy's stream lines
docs/images/<method>.png     what a method does, for every page of docs/methods that shows it;
                             `python docs/pictures.py <method> ...` draws these alone
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import gymnasium as gym
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import iflow_gym  # registers the environments
from iflow_gym.baselines.imitation_flow import ConditionalImitationFlow, ImitationFlow
from iflow_gym.baselines.registry import METHODS, load_method
from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.envs.task import Push
from iflow_gym.figures import reproductions, save_figure
from iflow_gym.plotting import plot_field, plot_rollouts, plot_streamlines, view
from iflow_gym.policy import policy_of
from iflow_gym.registration import lasa_id
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


def conditional() -> None:
    """Draw one flow in five contexts: four that it learned, and one between two of them."""
    shapes = ("Angle", "Sshape", "Leaf_1", "CShape")
    motions = [load_lasa(shape) for shape in shapes]
    model = ConditionalImitationFlow().fit(motions, seed=0)
    figure = Figure(figsize=(14, 3.2), layout="constrained", dpi=100)
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(shapes) + 1)
    for ax, motion, context in zip(axes, motions, np.eye(len(shapes)), strict=False):
        system = model.at(context)
        plot_field(ax, system, motion, reproductions(system, motion))
        ax.set_title(f"context {context.astype(int).tolist()}", fontsize=9)
    between = model.at([0, 0, 0.5, 0.5])
    starts = np.concatenate([m.starts[:3] for m in motions[2:]])
    paths = list(between.rollout(starts, 2000, motions[2].mean_dt))
    plot_field(axes[-1], between, motions[2], paths)
    axes[-1].set_title("context [0, 0, 0.5, 0.5]", fontsize=9)
    for ax in axes:
        ax.set(xticks=[], yticks=[], xlabel="", ylabel="")
    figure.savefig(IMAGES / "conditional.png", bbox_inches="tight")


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


def pushed(method, shape: str, index: int, push: Push | None) -> np.ndarray:
    """Return a path of two durations through the environment, shape (T, 2)."""
    n = 2 * len(load_lasa(shape).positions[index])
    env = gym.make(lasa_id(shape), perturbation=push, horizon=n)
    policy, state = policy_of(method, env), None
    observation, _ = env.reset(seed=0, options={"demonstration": index})
    path = [observation]
    for _ in range(n):
        action, state = policy.predict(observation, state)
        observation, *_ = env.step(action)
        path.append(observation)
    return np.stack(path)


def method_sheet(name: str) -> Figure:
    """Draw a method from the recordings' starts, from elsewhere, and pushed on its way."""
    figure = Figure(figsize=(10, 3.5), layout="constrained", facecolor="white")
    axes = figure.subplots(1, 3)
    titles = ("from the recordings' starts", "from elsewhere", "pushed, and not (pale)")
    for ax, shape, title in zip(axes, ("Sshape", "Sharpc", "Angle"), titles, strict=True):
        motion = load_lasa(shape)
        method = load_method(name)().fit(motion, seed=0)
        plot_field(ax, method, motion, density=1.0)
        ax.set(xticks=[], yticks=[], xlabel="", ylabel="")
        ax.set_title(title, fontsize=10, pad=4)
        if ax is axes[0]:
            plot_rollouts(ax, reproductions(method, motion))
        elif ax is axes[1]:
            low, high = motion.bounding_box
            sides = np.linspace(low - 0.2 * (high - low), high + 0.2 * (high - low), 4)
            starts = np.stack(np.meshgrid(*sides.T), axis=-1).reshape(-1, 2)
            n = 2 * len(motion.positions[0])
            plot_rollouts(ax, method.rollout(starts, n, motion.mean_dt), linewidth=0.9)
        else:
            for k, direction in enumerate(((1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))):
                path = pushed(method, shape, k, None)
                plot_rollouts(ax, [path], color="#a9c9bc")
                path = pushed(method, shape, k, Push(direction=direction))
                plot_rollouts(ax, [path], linewidth=1.2)
    return figure


def method_sheets(names: list[str]) -> None:
    """Draw the methods whose page shows their picture, or the named ones."""
    for name in names or METHODS:
        page, method = IMAGES.parent / "methods" / f"{name}.md", load_method(name)
        if not (names or (page.is_file() and f"images/{name}.png" in page.read_text())):
            continue
        if (
            issubclass(method, DynamicalSystem)
            and method._lyapunov is not DynamicalSystem._lyapunov
        ):
            level_sets(method, ("Worm", "Angle", "Sharpc"), f"{name}.png")
        else:
            save_figure(method_sheet(name), IMAGES / f"{name}.png", dpi=100)


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
    figure.savefig(IMAGES / name, bbox_inches="tight")


if __name__ == "__main__":
    IMAGES.mkdir(exist_ok=True)
    if len(sys.argv) == 1:
        environment()
        bend()
        conditional()
    method_sheets(sys.argv[1:])
