"""Pictures of planar motions: streamlines, demonstrations, rollouts.

Every function draws on the matplotlib `Axes` that it is given; none touches pyplot's state, so
they work in threads, servers and notebooks alike.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from iflow_gym.demonstrations import Demonstrations, FloatArray

Field = Callable[[FloatArray], FloatArray]
"""Velocities, shape (n, 2), of positions, shape (n, 2)."""

INK = "#22303c"
DEMONSTRATION = "#e4572e"
ROLLOUT = "#0b6e4f"
GOAL = "#f2b705"
PAPER = "#fbfaf7"

SPEEDS = LinearSegmentedColormap.from_list(
    "speeds", ["#dfe5ec", "#bccbdd", "#8eaccc", "#5f88b5", "#3c6699"]
)
"""Slow is pale, fast is deep."""

MARGIN = 0.25
"""Pictures show the demonstrations' bounding box and this fraction of its longer side around it."""


def view(demonstrations: Demonstrations, margin: float = MARGIN) -> tuple[FloatArray, FloatArray]:
    """Return the corners, each shape (2,), of a square around the demonstrations.

    Raises
    ------
    ValueError
        If the demonstrations are not planar.
    """
    if demonstrations.n_dims != 2:
        raise ValueError(
            f"Expected demonstrations in the plane to draw, got {demonstrations.n_dims} dimensions."
        )
    box = demonstrations.bounding_box
    centre = (box.low + box.high) / 2
    half = (0.5 + margin) * float((box.high - box.low).max())
    return centre - half, centre + half


def plot_streamlines(
    ax: Axes,
    velocity: Field,
    low: ArrayLike,
    high: ArrayLike,
    *,
    resolution: int = 50,
    density: float = 1.3,
    linewidth: float = 0.9,
    arrowsize: float = 0.8,
) -> None:
    """Draw the streamlines of a planar field, coloured by speed.

    Parameters
    ----------
    ax : matplotlib Axes
    velocity : callable, (n, 2) -> (n, 2)
        For instance `DynamicalSystem.velocity`. Where it is not finite nothing is drawn.
    low, high : arrays, shape (2,)
        Corners of the drawn region.
    resolution : int
        Grid points a side at which the field is asked.
    density, linewidth, arrowsize : float
        As in `Axes.streamplot`.

    Notes
    -----
    The colour is log(1 + speed / median speed), from nothing to the 98th percentile: a field that
    grows with distance would otherwise be pale near the demonstrations.
    """
    (left, bottom), (right, top) = np.asarray(low, float), np.asarray(high, float)
    x, y = np.linspace(left, right, resolution), np.linspace(bottom, top, resolution)
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    flow = np.asarray(velocity(grid.reshape(-1, 2)), dtype=np.float64).reshape(grid.shape)
    speed = np.linalg.norm(flow, axis=-1)
    finite = np.isfinite(speed)
    if not finite.any() or not (speed[finite] > 0).any():
        return
    typical = float(np.median(speed[finite & (speed > 0)]))
    shade = np.log1p(np.where(finite, speed, 0.0) / typical)
    u, v = (np.ma.masked_array(flow[..., k], mask=~finite) for k in range(2))
    ax.streamplot(
        x,
        y,
        u,
        v,
        color=shade,
        cmap=SPEEDS,
        norm=Normalize(0.0, float(np.percentile(shade[finite], 98))),
        density=density,
        linewidth=linewidth,
        arrowsize=arrowsize,
        arrowstyle="-|>",
        zorder=1,
    )


def plot_demonstrations(
    ax: Axes, demonstrations: Demonstrations, *, linewidth: float = 1.6, alpha: float = 0.7
) -> None:
    """Draw planar recordings as lines, with a ring where each begins."""
    for path in demonstrations.positions:
        ax.plot(
            path[:, 0],
            path[:, 1],
            color=DEMONSTRATION,
            linewidth=linewidth,
            alpha=alpha,
            solid_capstyle="round",
            zorder=3,
        )
    starts = demonstrations.starts
    ax.scatter(
        starts[:, 0],
        starts[:, 1],
        s=(4 * linewidth) ** 2 / 2,
        facecolors=PAPER,
        edgecolors=DEMONSTRATION,
        linewidths=0.7 * linewidth,
        zorder=4,
    )


def plot_rollouts(
    ax: Axes, paths: Iterable[ArrayLike], *, linewidth: float = 1.6, color: str = ROLLOUT
) -> None:
    """Draw planar paths, each shape (T, 2), with a dot at the end; more columns are left out."""
    for path in paths:
        points = np.asarray(path, dtype=np.float64)
        x, y = points[:, 0], points[:, 1]
        ax.plot(x, y, color=color, linewidth=linewidth, solid_capstyle="round", zorder=5)
        ax.plot(x[-1:], y[-1:], "o", color=color, markersize=2.5 * linewidth, zorder=6)


def plot_goal(ax: Axes, goal: ArrayLike, *, size: float = 15.0) -> None:
    """Draw a star at the goal, shape (2,); `size` in points."""
    x, y = np.asarray(goal, dtype=np.float64)
    ax.plot(
        [x], [y], "*", color=GOAL, markersize=size, markeredgecolor=INK, markeredgewidth=0.8,
        zorder=7,
    )  # fmt: skip


def frame_axes(ax: Axes, demonstrations: Demonstrations, margin: float = MARGIN) -> None:
    """Give the axes equal aspect, the demonstrations' view, and their unit."""
    low, high = view(demonstrations, margin)
    ax.set_aspect("equal")
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(low[1], high[1])
    ax.set_facecolor(PAPER)
    ax.set_xlabel(f"x ({demonstrations.length_unit})", color=INK)
    ax.set_ylabel(f"y ({demonstrations.length_unit})", color=INK)
    ax.tick_params(colors=INK, labelsize="small", length=3)
    for spine in ax.spines.values():
        spine.set_color("#c9c5bb")


def plot_field(
    ax: Axes,
    system: Any,
    demonstrations: Demonstrations,
    rollouts: Iterable[ArrayLike] | None = None,
    *,
    linewidth: float = 1.6,
    density: float = 1.3,
) -> None:
    """Draw a system's streamlines, the demonstrations, rollouts and the goal on one Axes.

    Parameters
    ----------
    ax : matplotlib Axes
    system : DynamicalSystem or None
        Anything with `velocity`; what has none, and None, leaves the streamlines out.
    demonstrations : Demonstrations
        Planar.
    rollouts : iterable of arrays, shape (T, 2), optional
    linewidth, density : float
        Scale of the drawing; a panel of many needs less of both.
    """
    frame_axes(ax, demonstrations)
    field: Field | None = getattr(system, "velocity", None)
    if field is not None:
        low, high = view(demonstrations)
        plot_streamlines(
            ax,
            field,
            low,
            high,
            density=density,
            linewidth=0.55 * linewidth,
            arrowsize=0.5 * linewidth,
        )
    plot_demonstrations(ax, demonstrations, linewidth=linewidth)
    if rollouts is not None:
        plot_rollouts(ax, rollouts, linewidth=linewidth)
    if demonstrations.goal is not None:
        plot_goal(ax, demonstrations.goal, size=9 * linewidth)


def field_figure(
    system: Any,
    demonstrations: Demonstrations,
    rollouts: Iterable[ArrayLike] | None = None,
    *,
    size: float = 5.0,
) -> Figure:
    """Return a square figure, `size` inches a side, of what `plot_field` draws."""
    figure = Figure(figsize=(size, size), layout="constrained", facecolor="white")
    ax = figure.add_subplot()
    plot_field(ax, system, demonstrations, rollouts)
    ax.set_title(demonstrations.name, color=INK, fontsize="medium")
    return figure
