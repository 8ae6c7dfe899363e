"""Makes the picture of residuals from the leaderboard's models: `python docs/residual.py`.

docs/images/residual.png  under wind: the base, a residual, a stable residual
"""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from matplotlib.figure import Figure

import iflow_gym  # noqa: F401 (registers the environments)
from iflow_gym.baselines.imitation_flow import ImitationFlow
from iflow_gym.baselines.residual_learning.recorded import load_recorded
from iflow_gym.evaluation.rollouts import rollouts, rollouts_from_starts, scored_box
from iflow_gym.figures import save_figure
from iflow_gym.metrics import start_grid
from iflow_gym.metrics.stability import HORIZON
from iflow_gym.plotting import (
    INK,
    frame_axes,
    plot_demonstrations,
    plot_goal,
    plot_rollouts,
)
from iflow_gym.results import result_path

IMAGES = Path(__file__).parent / "images"
RESULTS = Path(__file__).parents[1] / "leaderboard" / "results"
ENVIRONMENT = "iflow/Disturbed-Sshape-v0"
STARTS_PER_AXIS = 6
ARROWS = 11


def policies() -> dict[str, Any]:
    """Return the base and what was trained on it: the leaderboard's, of seed 0."""
    found: dict[str, Any] = {}
    for title, row in (
        ("ImitationFlow", "imitation-flow"),
        ("+ residual", "imitation-flow+residual"),
        ("+ stable residual", "imitation-flow+stable-residual"),
    ):
        path = result_path(row, ENVIRONMENT, "reproduction", 0).with_suffix(".safetensors")
        load = ImitationFlow.load if row == "imitation-flow" else load_recorded
        found[title] = load(RESULTS / path)
    return found


def draw(task: Any, found: dict[str, Any]) -> Figure:
    """Draw paths from the recordings' starts, above, and from a grid of others, below."""
    demos = task.demonstrations
    figure = Figure(figsize=(10.5, 7), layout="constrained", facecolor="white")
    axes = figure.subplots(2, len(found))
    low, high = scored_box(demos)
    grid = start_grid(low, high, STARTS_PER_AXIS)
    n = round(HORIZON * float(demos.durations.max()) / demos.mean_dt)
    for column, (title, policy) in zip(axes.T, found.items(), strict=True):
        shown = rollouts_from_starts(policy, task, range(len(demos)), len(demos.positions[0]) - 1)
        envs = task.like(len(grid), horizon=n)
        first, _ = envs.reset(seed=0, options={"start": grid})
        others = rollouts(policy, [envs], first, n)
        for ax, paths, margin in zip(column, (shown, others), (0.25, 0.6), strict=True):
            frame_axes(ax, demos, margin)
            _wind(ax, task)
            plot_demonstrations(ax, demos)
            plot_rollouts(ax, list(paths))
            plot_goal(ax, demos.attractor)
            ax.set(xticks=[], yticks=[], xlabel="", ylabel="")
        column[0].set_title(title, color=INK)
    return figure


def _wind(ax: Any, task: Any) -> None:
    """Draw the wind's force on a mass at rest as arrows over the axes."""
    across, up = (np.linspace(*ends, ARROWS + 2)[1:-1] for ends in (ax.get_xlim(), ax.get_ylim()))
    points = np.stack(np.meshgrid(across, up), axis=-1).reshape(-1, 2)
    force = task.wind_force(points, np.zeros_like(points))
    ax.quiver(*points.T, *force.T, color="#b9b3a6", width=0.004, zorder=0.5)


if __name__ == "__main__":
    unwrapped = gymnasium.make(ENVIRONMENT).unwrapped
    save_figure(draw(unwrapped, policies()), IMAGES / "residual.png")
