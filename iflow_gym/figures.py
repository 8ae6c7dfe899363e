"""Figures that compare methods: boxes over shapes, one number against another, sheets of fields.

The functions take plain numbers and fitted systems and return matplotlib figures, made without
pyplot. `save_figure` writes them so that the same figure gives the same bytes.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from matplotlib.transforms import Bbox
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.plotting import DEMONSTRATION, GOAL, INK, PAPER, ROLLOUT, plot_field

PALETTE = (
    "#0072b2",  # blue
    "#009e73",  # green
    "#d55e00",  # vermilion
    "#cc79a7",  # purple
    "#e69f00",  # orange
    "#56b4e9",  # sky
    "#806000",  # brown, for yellow, which is too pale for points on white
    "#4d4d4d",  # grey
    "#882255",  # wine
    "#44aa99",  # teal
    "#332288",  # indigo
    "#999933",  # olive
)
"""Okabe and Ito's colours, which colour-blind readers can tell apart, and four of Tol's for more
methods than they are."""

REFERENCE_COLOUR = "#8a8578"

USES_TIME = "none, uses time"
"""What a method that follows a clock has in place of a kind of guarantee."""

MARKERS = {"proved": "o", "verified": "s", "sampled": "^", "none": "X", USES_TIME: "D"}
"""Marker of each kind of guarantee."""

KEPT_COLOURS = (GOAL, INK, DEMONSTRATION, ROLLOUT, PAPER, "white", *PALETTE)
"""Colours that a PNG's palette holds exactly, however few pixels have them."""

TOLERABLE_DECADES = 0.7
"""Scores that span more decades than this get a logarithmic axis."""


@dataclass(frozen=True)
class MethodStyle:
    """How a method looks in every figure."""

    title: str
    """Its name as people write it."""
    colour: str
    marker: str
    guarantee: str
    """Kind of its guarantee, what the marker stands for."""


def method_styles(
    methods: Mapping[str, tuple[str, str]], order: Sequence[str] = ()
) -> dict[str, MethodStyle]:
    """Return a style for each method.

    Parameters
    ----------
    methods
        Name to title and kind of guarantee.
    order
        Names that keep their colours whichever methods are there: the registry's. Others follow,
        sorted by name; beyond the palette's colours repeat.
    """
    names = [*order, *sorted(set(methods) - set(order))]
    colours = dict(zip(names, itertools.cycle(PALETTE), strict=False))
    return {
        name: MethodStyle(title, colours[name], MARKERS.get(kind, MARKERS["none"]), kind)
        for name, (title, kind) in methods.items()
    }


# Numbers ------------------------------------------------------------------------------------


def box_figure(
    panels: Mapping[str, Mapping[str, ArrayLike]],
    styles: Mapping[str, MethodStyle],
    references: Mapping[str, float] | None = None,
    *,
    reference_label: str = "",
) -> Figure:
    """Return a figure of horizontal boxes, a panel for each metric, a box for each method.

    Parameters
    ----------
    panels
        Label of the metric to method to scores, shape (n,), one for each shape. What is not finite
        cannot be drawn: the panel says how many.
    styles
        Method to its style; methods are drawn in this order, the first on top.
    references
        Label of the metric to a value that a dashed line marks.
    reference_label
        What that line is, in the legend.

    Notes
    -----
    Boxes span the quartiles, whiskers reach the last point within 1.5 interquartile ranges, and
    every point is drawn over its box, spread in a fixed order so that the figure is reproducible.
    """
    n_columns = min(2, len(panels))
    n_rows = math.ceil(len(panels) / n_columns)
    height = 0.75 + 0.42 * len(styles)
    figure = Figure(figsize=(9.0, height * n_rows + 0.4), layout="constrained", facecolor="white")
    axes = figure.subplots(n_rows, n_columns, squeeze=False, sharey=True)
    for ax in axes.flat[len(panels) :]:
        ax.set_visible(False)
    for ax, (label, scores) in zip(axes.flat, panels.items(), strict=False):
        _boxes(ax, label, scores, styles)
        if references and label in references:
            ax.axvline(references[label], color=REFERENCE_COLOUR, linestyle="--", linewidth=1.2)
    if references and reference_label:
        line = Line2D([], [], color=REFERENCE_COLOUR, linestyle="--", linewidth=1.2)
        figure.legend(
            [line], [reference_label], loc="outside lower center", frameon=False, fontsize=9
        )
    return figure


def _boxes(
    ax: Axes, label: str, scores: Mapping[str, ArrayLike], styles: Mapping[str, MethodStyle]
) -> None:
    """Draw the boxes of one metric."""
    drawn: list[FloatArray] = []
    for place, (method, style) in enumerate(styles.items()):
        values = np.asarray(scores.get(method, ()), dtype=np.float64)
        finite = values[np.isfinite(values)]
        drawn.append(finite)
        if len(finite):
            ax.boxplot(
                finite,
                positions=[place],
                orientation="horizontal",
                widths=0.55,
                showfliers=False,
                patch_artist=True,
                boxprops={"facecolor": style.colour + "33", "edgecolor": style.colour},
                whiskerprops={"color": style.colour},
                capprops={"color": style.colour},
                medianprops={"color": style.colour, "linewidth": 2.2},
            )
            # The golden ratio's multiples spread evenly however many there are.
            spread = (np.arange(len(finite)) * 0.618034) % 1.0 - 0.5
            ax.plot(
                finite, place + 0.36 * spread, "o", color=style.colour, markersize=3.0, alpha=0.6,
                markeredgewidth=0, zorder=3,
            )  # fmt: skip
        if missing := len(values) - len(finite):
            ax.annotate(
                f"+ {missing} not finite or failed", (1.0, place), xytext=(-4, 11), ha="right",
                va="center", xycoords=("axes fraction", "data"), textcoords="offset points",
                fontsize=7.5, color=INK,
            )  # fmt: skip
    ax.set_yticks(range(len(styles)), [style.title for style in styles.values()])
    ax.set_ylim(len(styles) - 0.45, -0.55)
    ax.set_title(label, fontsize=10, color=INK, loc="left")
    _scale(ax.xaxis, np.concatenate([*drawn, np.empty(0)]))
    clean(ax, grid="x")


@dataclass(frozen=True)
class Point:
    """A method in a figure of one number against another."""

    method: str
    x: float
    y: float
    x_interval: tuple[float, float] | None = None
    y_interval: tuple[float, float] | None = None


def scatter_figure(
    points: Sequence[Point],
    styles: Mapping[str, MethodStyle],
    *,
    x_label: str,
    y_label: str,
    x_log: bool = False,
    y_log: bool = False,
    y_limits: tuple[float, float] | None = None,
    references: Mapping[str, float] | None = None,
) -> Figure:
    """Return a figure of a labelled point for each method; what is not finite is left out.

    Parameters
    ----------
    points
        With 95 % intervals where there are any.
    styles
        Method to its style; the marker says the kind of guarantee, and the legend which is which.
    x_label, y_label
        With units.
    x_log, y_log
        Logarithmic axes.
    y_limits
        Of the y axis; by the data where None.
    references
        Label to a value of x that a dashed vertical line marks.
    """
    figure = Figure(figsize=(7.0, 4.4), layout="constrained", facecolor="white")
    ax = figure.add_subplot()
    if x_log:
        ax.set_xscale("log")
    if y_log:
        ax.set_yscale("log")
    kept = [p for p in points if math.isfinite(p.x) and math.isfinite(p.y)]
    for p in kept:
        style = styles[p.method]
        for interval, horizontal in ((p.x_interval, True), (p.y_interval, False)):
            if interval is not None and all(math.isfinite(end) for end in interval):
                line = (interval, (p.y, p.y)) if horizontal else ((p.x, p.x), interval)
                ax.plot(*line, color=style.colour, linewidth=1.4, alpha=0.55, zorder=2)
        ax.plot(
            [p.x], [p.y], style.marker, color=style.colour, markersize=10, markeredgecolor="white",
            markeredgewidth=1.0, zorder=4, clip_on=False,
        )  # fmt: skip
    marks: list[Artist] = []
    for label, value in (references or {}).items():
        marks.append(
            ax.axvline(value, color=REFERENCE_COLOUR, linestyle="--", linewidth=1.2, zorder=1)
        )
        marks.append(
            ax.annotate(
                label, (value, 0.02), xycoords=("data", "axes fraction"), rotation=90, fontsize=8,
                xytext=(-4, 0), textcoords="offset points", ha="right", va="bottom",
                color=REFERENCE_COLOUR,
            )
        )  # fmt: skip
    ax.set_xlabel(x_label, color=INK)
    ax.set_ylabel(y_label, color=INK)
    if y_limits is not None:
        ax.set_ylim(*y_limits)
    ax.margins(x=0.12, y=0.14)
    for axis, is_log in ((ax.xaxis, x_log), (ax.yaxis, y_log)):
        if is_log:
            plain_log_ticks(axis)
    clean(ax, grid="both")
    kinds = [k for k in MARKERS if any(styles[p.method].guarantee == k for p in kept)]
    handles = [
        Line2D([], [], marker=MARKERS[k], linestyle="none", color=INK, markersize=7) for k in kinds
    ]
    if handles:
        figure.legend(
            handles,
            [f"guarantee: {k}" for k in kinds],
            loc="outside lower center",
            ncols=len(kinds),
            frameon=False,
            fontsize=9,
        )
    _place_labels(figure, ax, kept, styles, marks)
    return figure


def _place_labels(
    figure: Figure,
    ax: Axes,
    points: Sequence[Point],
    styles: Mapping[str, MethodStyle],
    marks: Sequence[Artist],
) -> None:
    """Write names beside points, each at the first of several places where nothing is yet.

    `marks` is what else is drawn that no name is to cross.
    """
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()  # the layout, and with it every position in pixels, is known from here on
    figure.set_layout_engine("none")
    renderer = canvas.get_renderer()
    pixels = figure.dpi / 72
    frame = ax.get_window_extent(renderer)
    taken = [mark.get_window_extent(renderer).padded(2 * pixels) for mark in marks]
    for p in points:
        (left, right), (low, high) = p.x_interval or (p.x, p.x), p.y_interval or (p.y, p.y)
        for reach, ends in (
            (7, [(p.x, p.y)] * 2),
            (2, [(left, p.y), (right, p.y)]),
            (2, [(p.x, low), (p.x, high)]),
        ):
            corners = ax.transData.transform(ends)
            if np.isfinite(corners).all():
                taken.append(
                    Bbox.from_extents(
                        *(corners[0] - reach * pixels), *(corners[1] + reach * pixels)
                    )
                )
    directions = [(1, 0), (0, 1), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)]
    for p in points:
        x, y, style = p.x, p.y, styles[p.method]
        for distance, (aside, up) in itertools.product((10, 20, 34, 50, 70), directions):
            text = ax.annotate(
                style.title,
                (x, y),
                xytext=(distance * aside, distance * up),
                textcoords="offset points",
                ha=("right", "center", "left")[aside + 1],
                va=("top", "center", "bottom")[up + 1],
                fontsize=9.5,
                color=INK,
                arrowprops=(
                    None
                    if distance <= 10 and not (aside and up)  # beyond, it may seem another's
                    else {"arrowstyle": "-", "color": style.colour, "linewidth": 0.8, "shrinkB": 6}
                ),
            )
            # Of the letters: the annotation's own extent would hold the line to the point, too.
            text.update_positions(renderer)
            box = Text.get_window_extent(text, renderer).padded(2.5 * pixels)
            inside = frame.containsx(box.x0) and frame.containsx(box.x1)
            inside &= frame.containsy(box.y0) and frame.containsy(box.y1)
            if inside and not any(box.overlaps(other) for other in taken):
                taken.append(box)
                break
            text.remove()
        else:
            ax.annotate(
                style.title, (x, y), xytext=(10, 0), textcoords="offset points", va="center",
                fontsize=9.5, color=INK,
            )  # fmt: skip


# Fields -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FieldPanel:
    """One picture of a sheet."""

    title: str
    demonstrations: Demonstrations
    system: Any = None
    """Fitted, or None where there is none: `note` then says why."""
    note: str = ""


def confusion_figure(matrices: Mapping[str, ArrayLike], labels: Sequence[str]) -> Figure:
    """Return a confusion matrix for each method, side by side.

    Parameters
    ----------
    matrices
        Title of the method to counts, shape (n, n): how many of class i were taken for class j.
    labels
        Names of the n classes.
    """
    size = 0.55 * len(labels) + 0.8
    figure = Figure(
        figsize=(size * len(matrices) + 0.4, size + 0.5), layout="constrained", facecolor="white"
    )
    axes = figure.subplots(1, len(matrices), squeeze=False)[0]
    for ax, (title, matrix) in zip(axes, matrices.items(), strict=True):
        counts = np.asarray(matrix)
        shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
        ax.imshow(shares, cmap="Blues", vmin=0, vmax=1.25)
        for i, j in np.ndindex(counts.shape):
            ax.text(
                j, i, str(counts[i, j]), ha="center", va="center", fontsize=10,
                color="white" if shares[i, j] > 0.6 else INK if counts[i, j] else "#b5afa2",
            )  # fmt: skip
        right = np.trace(counts) / counts.sum()
        ax.set_title(f"{title}: {100 * right:.1f} %", fontsize=10, color=INK)
        ax.set_xticks(range(len(labels)), labels)
        ax.set_yticks(range(len(labels)), labels)
        ax.set_xlabel("taken for", color=INK)
        ax.tick_params(colors=INK, length=0)
        for spine in ax.spines.values():
            spine.set_visible(False)
    axes[0].set_ylabel("is", color=INK)
    return figure


def reproductions(system: Any, demonstrations: Demonstrations) -> list[FloatArray]:
    """Return the system's own rollout from each demonstration's start, as long as it is.

    Of a motion that repeats four rollouts of three periods instead, from outside and from inside.
    """
    if demonstrations.period is not None:
        low, high = demonstrations.bounding_box
        middle, half = (low + high) / 2, (high - low) / 2
        starts = middle + half * np.array([[1.4, 1.3], [-1.4, 1.3], [-1.4, -1.3], [1.4, -1.3]])
        n_steps = round(3 * demonstrations.period / demonstrations.mean_dt)
        return [system.rollout(start, n_steps, demonstrations.mean_dt) for start in starts]
    return [
        system.rollout(path[0], len(path) - 1, dt)
        for path, dt in zip(demonstrations.positions, demonstrations.dt, strict=True)
    ]


def field_sheet(panels: Sequence[FieldPanel], *, n_columns: int = 6, size: float = 2.2) -> Figure:
    """Return a sheet of fields with their demonstrations and reproductions.

    Parameters
    ----------
    panels
        Row by row.
    n_columns
        Panels in a row.
    size
        Side of a panel in inches.
    """
    n_columns = min(n_columns, len(panels))
    n_rows = math.ceil(len(panels) / n_columns)
    figure = Figure(
        figsize=(size * n_columns, (size + 0.25) * n_rows + 0.35),
        layout="constrained",
        facecolor="white",
    )
    axes = figure.subplots(n_rows, n_columns, squeeze=False)
    for ax in axes.flat[len(panels) :]:
        ax.set_visible(False)
    for ax, panel in zip(axes.flat, panels, strict=False):
        made = None if panel.system is None else reproductions(panel.system, panel.demonstrations)
        plot_field(ax, panel.system, panel.demonstrations, made, linewidth=size / 2.2)
        ax.set_title(panel.title, fontsize=9, color=INK)
        ax.set_xlabel("")
        ax.set_ylabel("")
        ax.set_xticks([])
        ax.set_yticks([])
        if panel.note:
            ax.text(
                0.5, 0.04, panel.note, transform=ax.transAxes, ha="center", fontsize=8, color=INK
            )
    handles = [
        Line2D([], [], color=DEMONSTRATION, linewidth=2),
        Line2D([], [], color=ROLLOUT, linewidth=2),
        Line2D(
            [], [], color=GOAL, marker="*", markersize=11, linestyle="none", markeredgecolor=INK
        ),
    ]
    figure.legend(
        handles,
        ["demonstrations", "reproductions", "goal"],
        loc="outside lower center",
        ncols=3,
        frameon=False,
        fontsize=9,
    )
    return figure


# Files --------------------------------------------------------------------------------------


def save_figure(figure: Figure, path: str | os.PathLike[str], *, dpi: int = 150) -> Path:
    """Write a figure as SVG or PNG, by the path's suffix; the same figure gives the same bytes.

    An SVG holds no date, and ids that do not change from run to run. A PNG has a palette of 256
    colours, which makes a sheet of fields a third as large and is not seen.
    """
    target = Path(path)
    if target.suffix == ".svg":
        with mpl.rc_context({"svg.hashsalt": "iflow-gym"}):
            figure.savefig(target, metadata={"Date": None, "Creator": "iflow-gym"})
        return target
    if target.suffix != ".png":
        raise ValueError(f"Expected a path that ends in .svg or .png, got {target}.")
    figure.set_dpi(dpi)
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    _save_with_palette(np.asarray(canvas.buffer_rgba())[..., :3], target)
    return target


def _save_with_palette(pixels: NDArray[np.uint8], target: Path) -> None:
    """Write pixels, shape (height, width, 3), with the palette of their commonest colours.

    Each pixel gets the nearest colour; Pillow's own search is approximate and tints white.
    """
    from PIL import Image

    kept = np.array([to_rgb(name) for name in KEPT_COLOURS]) * 255
    common = Image.fromarray(pixels).quantize(256 - len(kept)).getpalette() or []
    palette = np.vstack([np.rint(kept), np.reshape(common, (-1, 3))])[:256]
    packed = pixels.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], dtype=np.uint32)
    colours, which = np.unique(packed, return_inverse=True)
    unpacked = np.stack([colours >> 16, (colours >> 8) & 255, colours & 255], axis=1)
    nearest = np.asarray(cKDTree(palette).query(unpacked)[1], dtype=np.uint8)
    indexed = Image.fromarray(nearest[which.reshape(packed.shape)])
    indexed.putpalette(palette.astype(np.uint8).tobytes())
    indexed.save(target, optimize=True)


# Axes ---------------------------------------------------------------------------------------


def _scale(axis: Any, values: FloatArray) -> None:
    """Make an axis logarithmic where the values call for it."""
    positive = values[values > 0]
    if len(positive) < len(values) or not len(values):
        return
    if math.log10(positive.max() / positive.min()) > TOLERABLE_DECADES:
        axis.axes.set_xscale("log")
        plain_log_ticks(axis)


def plain_log_ticks(axis: Any) -> None:
    """Label 1, 2 and 5 of each decade as plain numbers; powers of ten where there are many."""
    low, high = axis.get_view_interval()
    decades = math.log10(high / low)
    axis.set_major_locator(
        LogLocator(subs=(1.0, 2.0, 5.0) if decades < 2.5 else (1.0,), numticks=12)
    )
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def clean(ax: Axes, *, grid: str) -> None:
    """Give axes the look of all figures: pale grid lines along "x", "y" or "both", no box."""
    ax.set_axisbelow(True)
    ax.grid(axis=grid, color="#e6e2d8", linewidth=0.8)  # type: ignore[arg-type]
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        ax.spines[side].set_color("#b5afa2")
    ax.tick_params(colors=INK, length=3)
