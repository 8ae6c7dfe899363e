"""``iflow-gym plot``: a motion, and what a model makes of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from iflow_gym.cli.console import (
    PIPE,
    UsageError,
    check_picture,
    only_one_pipe,
    progress,
    save_picture,
    say,
)
from iflow_gym.recordings.columns import shown

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from iflow_gym.demonstrations import Demonstrations, FloatArray
    from iflow_gym.system import Method

WIDE = 0.6
"""Room around the demonstrations, of their longer side, where the grid's starts have to be seen."""

ROUNDS = 3
"""Of a motion that repeats, in a rollout."""

SETTLED = 1.5
"""A rollout of a motion that ends lasts so many times the longest demonstration."""


@dataclass(frozen=True)
class Plot:
    """Draw demonstrations, and the field and the rollouts of a model.

    Planar motions are drawn in the plane, others as coordinates over time.

        iflow-gym plot reach.safetensors -o reach.png
        iflow-gym plot reach.safetensors --model policy.safetensors -o field.png
        iflow-gym plot reach.safetensors --model policy.safetensors --grid 6 -o field.png
    """

    motion: Annotated[Positional[str], arg(metavar="MOTION")]
    """Demonstrations, or an environment; - reads standard input."""
    output: Annotated[str, arg(metavar="PICTURE", aliases=["-o"])]
    """Picture to write: .png, .svg or .pdf; - is a PNG on standard output."""
    model: Annotated[str | None, shown("MODEL")] = None
    """Model whose field and rollouts to draw."""
    method: Annotated[str | None, shown("MODULE:CLASS")] = None
    """module:Class of a model whose method is one's own."""
    grid: Annotated[int, arg(metavar="N")] = 0
    """Roll out from so many starts a side as well, on twice the demonstrations' box (planar)."""
    size: Annotated[float, arg(metavar="INCHES")] = 5.0
    """Inches a side."""

    def run(self) -> int:
        """Draw."""
        from iflow_gym.cli.motions import check_match, load_model_file, load_motion

        only_one_pipe(self.motion, self.model or "")
        check_picture(self.output)
        if self.method is not None and self.model is None:
            raise UsageError("Expected the model whose method --method names (--model), got none.")
        if not 0 <= self.grid <= 40:
            raise UsageError(f"Expected a grid of 0 to 40 starts a side, got {self.grid}.")
        if not 1 <= self.size <= 40:
            raise UsageError(f"Expected a size of 1 to 40 inches, got {self.size}.")
        demos, _ = load_motion(self.motion)
        method = None
        if self.model is not None:
            method, record = load_model_file(self.model, self.method)
            check_match(method, record, demos)
        elif self.grid:
            raise UsageError("Expected a model to roll out from a grid (--model), got none.")
        if self.grid and demos.n_dims != 2:
            raise UsageError(f"Expected a planar motion for --grid, got {demos.n_dims} dimensions.")
        with progress("Drawing"):
            save_picture(figure_of(demos, method, self.grid, self.size), self.output)
        if self.output != PIPE:
            say(f"Written to {self.output}.")
        return 0


def figure_of(
    demos: Demonstrations, method: Method | None, grid: int = 0, size: float = 5.0
) -> Figure:
    """Return a figure of demonstrations and of a model's rollouts from their starts."""
    import numpy as np
    from matplotlib.figure import Figure

    from iflow_gym.plotting import (
        INK,
        PAPER,
        ROLLOUT,
        field_figure,
        frame_axes,
        plot_demonstrations,
        plot_goal,
        plot_rollouts,
        plot_streamlines,
        view,
    )
    from iflow_gym.system import DynamicalSystem

    dt = demos.mean_dt
    seconds = (
        SETTLED * float(demos.durations.max()) if demos.period is None else ROUNDS * demos.period
    )
    paths: list[FloatArray] = []
    if method is not None:
        model: Any = method
        paths = list(model.rollout(demos.starts, round(seconds / dt), dt))
    if demos.n_dims != 2:
        return _over_time(demos, paths, size)
    if not (grid and method is not None):
        return field_figure(method, demos, paths, size=size)
    figure = Figure(figsize=(size, size), layout="constrained", facecolor="white")
    ax = figure.add_subplot()
    frame_axes(ax, demos, WIDE)
    if isinstance(method, DynamicalSystem):
        plot_streamlines(ax, method.velocity, *view(demos, WIDE))
    box = demos.bounding_box
    centre, half = (box.low + box.high) / 2, box.high - box.low
    axes = [np.linspace(c - h, c + h, grid) for c, h in zip(centre, half, strict=True)]
    starts = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    from_grid = model.rollout(starts, round(seconds / dt), dt)
    plot_rollouts(ax, from_grid, linewidth=0.6)
    ax.plot(*starts.T, "o", color=PAPER, markeredgecolor=ROLLOUT, markersize=3, zorder=4)
    plot_demonstrations(ax, demos)
    plot_rollouts(ax, paths)
    if demos.goal is not None:
        plot_goal(ax, demos.goal)
    ax.set_title(demos.name, color=INK, fontsize="medium")
    return figure


def _over_time(demos: Demonstrations, paths: list[FloatArray], size: float) -> Figure:
    """Return a figure of each coordinate over time."""
    import numpy as np
    from matplotlib.figure import Figure

    from iflow_gym.plotting import DEMONSTRATION, INK, PAPER, ROLLOUT

    d = demos.n_dims
    figure = Figure(figsize=(1.6 * size, 0.4 * size * d), layout="constrained", facecolor="white")
    for k, ax in enumerate(np.atleast_1d(figure.subplots(d, 1, sharex=True))):
        for i, path in enumerate(demos.positions):
            label = "demonstrations" if i == k == 0 else None
            ax.plot(demos.times(i), path[:, k], color=DEMONSTRATION, alpha=0.7, label=label)
        for i, path in enumerate(paths):
            times = np.arange(len(path)) * demos.mean_dt
            label = "model" if i == k == 0 else None
            ax.plot(times, path[:, k], color=ROLLOUT, linewidth=1.2, label=label)
        if demos.goal is not None:
            ax.axhline(demos.goal[k], color="#c9c5bb", linewidth=0.8, zorder=0)
        name = "xyz"[k] if d <= 3 else f"x{k + 1}"
        ax.set_ylabel(f"{name} ({demos.length_unit})", color=INK)
        ax.set_facecolor(PAPER)
        ax.tick_params(colors=INK, labelsize="small", length=3)
    ax.set_xlabel("time (s)", color=INK)
    figure.axes[0].set_title(demos.name, color=INK, fontsize="medium")
    figure.axes[0].legend(fontsize="small", frameon=False)
    return figure
