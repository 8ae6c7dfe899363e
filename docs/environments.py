"""Makes the pictures of the environments' pages: `python docs/environments.py`, half a minute.

docs/images/lasa.png               the recordings of the thirty shapes
docs/images/letters-recorded.png   the letters of ImitationFlow's authors
docs/images/drumming-recorded.png  their drumming, over the drums of the environment
docs/images/disturbed.png          a policy on the nominal plant, and on the disturbed one

The recordings of the authors need a network, or IFLOW_GYM_RECORDED.
"""

import math
from pathlib import Path

import gymnasium
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle

import iflow_gym
from iflow_gym.baselines.imitation_flow import ImitationFlow
from iflow_gym.datasets.lasa import MULTI_MODELS, SINGLE_MOTIONS, load_lasa
from iflow_gym.datasets.letters import LETTERS
from iflow_gym.datasets.recorded import load_recorded_letter
from iflow_gym.envs.disturbed import DisturbedLASAEnv
from iflow_gym.envs.drumming.recorded import DrummingRecordedEnv
from iflow_gym.envs.lasa import LASAEnv
from iflow_gym.figures import save_figure
from iflow_gym.plotting import (
    DEMONSTRATION,
    INK,
    frame_axes,
    plot_demonstrations,
    plot_goal,
    plot_rollouts,
)

IMAGES = Path(__file__).parent / "images"


def sheet(motions: list[iflow_gym.Demonstrations], columns: int, size: float) -> Figure:
    """Draw sets of demonstrations beside each other."""
    rows = math.ceil(len(motions) / columns)
    figure = Figure(figsize=(columns * size, rows * size * 1.12), layout="constrained")
    figure.set_facecolor("white")
    for ax, motion in zip(figure.subplots(rows, columns).flat, motions, strict=True):
        frame_axes(ax, motion, 0.08)
        plot_demonstrations(ax, motion, linewidth=1.0)
        if motion.goal is not None:
            plot_goal(ax, motion.goal, size=9)
        ax.set(xticks=[], yticks=[], xlabel="", ylabel="")
        ax.set_title(motion.name.removeprefix("LASA-"), color=INK, fontsize=8, pad=3)
    return figure


def drumming() -> Figure:
    """Draw the recorded drumming from above, and how high the tip is."""
    env = DrummingRecordedEnv()
    figure = Figure(figsize=(9, 3.4), layout="constrained", facecolor="white")
    above, beside = figure.subplots(1, 2, width_ratios=(1, 1.7))
    for path, dt in zip(env.demonstrations.positions, env.demonstrations.dt, strict=True):
        above.plot(-path[:, 1], path[:, 0], color=DEMONSTRATION, linewidth=0.7, alpha=0.7)
        time = np.arange(len(path)) * dt
        beside.plot(time, path[:, 2], color=DEMONSTRATION, linewidth=0.7, alpha=0.7)
    for drum, colour in zip(env.drums, ("#0072b2", "#44aa99"), strict=True):
        x, y, z = drum.head
        above.add_patch(Circle((-y, x), drum.radius, color=colour, alpha=0.25, linewidth=0))
        beside.axhline(z, color=colour, linewidth=1.2, label=f"head of the {drum.name} drum")
    above.set(xlabel="-y (m): to the right", ylabel="x (m): away from the arm", aspect="equal")
    above.autoscale_view()
    beside.set(xlabel="time (s)", ylabel="height of the tip (m)")
    beside.legend(frameon=False, loc="upper right", fontsize="small", ncols=2)
    low, high = beside.get_ylim()
    beside.set_ylim(low, high + 0.15 * (high - low))
    return figure


def disturbed(shape: str = "Sshape") -> Figure:
    """Draw what becomes of a policy on a plant that is heavier than it is told, in wind."""
    motion = load_lasa(shape)
    system = ImitationFlow().fit(motion, seed=0)
    figure = Figure(figsize=(8.4, 4.2), layout="constrained", facecolor="white")
    plants = (
        ("told the truth: `LASA`", LASAEnv(shape, control_mode="force")),
        ("heavier than told, in wind: `Disturbed`", DisturbedLASAEnv(shape)),
    )
    for ax, (title, env) in zip(figure.subplots(1, 2), plants, strict=True):
        frame_axes(ax, motion)
        if isinstance(env, DisturbedLASAEnv):
            sides = (np.linspace(*ends, 13)[1:-1] for ends in (ax.get_xlim(), ax.get_ylim()))
            points = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
            force = env.wind_force(points, np.zeros_like(points))
            ax.quiver(*points.T, *force.T, color="#b9b3a6", width=0.004, zorder=0.5)
        policy = iflow_gym.DynamicalSystemPolicy(system, env)
        paths = []
        for index in range(len(motion)):
            observation, _ = env.reset(options={"demonstration": index})
            path, truncated = [observation[:2]], False
            while not truncated:
                action, _ = policy.predict(observation)
                observation, _, _, truncated, _ = env.step(action)
                path.append(observation[:2])
            paths.append(np.stack(path))
        plot_demonstrations(ax, motion)
        plot_rollouts(ax, paths)
        plot_goal(ax, motion.attractor)
        ax.set(xticks=[], yticks=[], xlabel="", ylabel="")
        ax.set_title(title.replace("`", ""), color=INK, fontsize=10)
    return figure


if __name__ == "__main__":
    gymnasium.logger.min_level = gymnasium.logger.ERROR
    shapes = [load_lasa(shape) for shape in (*SINGLE_MOTIONS, *MULTI_MODELS)]
    save_figure(sheet(shapes, 6, 1.6), IMAGES / "lasa.png")
    letters = [load_recorded_letter(letter) for letter in LETTERS]
    save_figure(sheet(letters, 4, 2.2), IMAGES / "letters-recorded.png")
    save_figure(drumming(), IMAGES / "drumming-recorded.png")
    save_figure(disturbed(), IMAGES / "disturbed.png")
