"""Figures of `iflow_gym.statistics`: mean ranks with a critical difference, score profiles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from iflow_gym.figures import REFERENCE_COLOUR, MethodStyle, clean, plain_log_ticks
from iflow_gym.plotting import INK
from iflow_gym.statistics import Profile, RankComparison


def rank_figure(comparison: RankComparison, styles: Sequence[MethodStyle]) -> Figure:
    """Return Demšar's diagram: methods at their mean ranks, bars over what cannot be told apart.

    Parameters
    ----------
    comparison
        From `compare_ranks`.
    styles
        Of the methods, in the comparison's order.

    Notes
    -----
    Demšar 2006, figure 1; rank 1, the best, is on the left.
    """
    ranks = comparison.mean_ranks
    n = len(ranks)
    order = np.argsort(ranks, kind="stable")
    n_left = (n + 1) // 2
    first_name = 0.75 + 0.34 * len(comparison.groups)
    depth = first_name + 0.55 * (n_left - 1)
    figure = Figure(
        figsize=(7.0, 1.15 + 0.36 * (depth + 0.7)), layout="constrained", facecolor="white"
    )
    ax = figure.add_subplot()
    reach = max(n - 1, 1) * 0.42  # room for names on either side
    ax.set_xlim(1 - reach, n + reach)
    ax.set_ylim(-depth - 0.4, 1.9)
    ax.axis("off")
    ax.plot([1, n], [0, 0], color=INK, linewidth=1.2)
    for rank in range(1, n + 1):
        ax.plot([rank, rank], [0, 0.14], color=INK, linewidth=1.2)
        ax.text(rank, 0.24, str(rank), ha="center", va="bottom", fontsize=9, color=INK)
    difference = min(comparison.critical_difference, n - 1)
    ax.plot([1, 1 + difference], [1.35, 1.35], color=REFERENCE_COLOUR, linewidth=2)
    for end in (1, 1 + difference):
        ax.plot([end, end], [1.25, 1.45], color=REFERENCE_COLOUR, linewidth=1.5)
    ax.text(
        1 + difference / 2, 1.5, f"critical difference {comparison.critical_difference:.2f}",
        ha="center", va="bottom", fontsize=9, color=INK,
    )  # fmt: skip
    for level, group in enumerate(comparison.groups):
        ends = np.array([ranks[list(group)].min() - 0.05, ranks[list(group)].max() + 0.05])
        ax.plot(
            ends, [-0.3 - 0.34 * level] * 2, color=INK, linewidth=4.5, alpha=0.75,
            solid_capstyle="round", zorder=3,
        )  # fmt: skip
    for place, i in enumerate(order):
        left = place < n_left
        height = -first_name - 0.55 * (place if left else n - 1 - place)
        side = 1 - 0.06 * reach if left else n + 0.06 * reach
        style = styles[i]
        ax.plot([ranks[i]] * 2 + [side], [0, height, height], color=style.colour, linewidth=1.3)
        ax.plot([ranks[i]], [0], style.marker, color=style.colour, markersize=6.5, zorder=4,
                markeredgecolor="white", markeredgewidth=0.7)  # fmt: skip
        mean = f"{ranks[i]:.2f}"
        ax.text(
            side + (-0.03 if left else 0.03) * reach, height,
            f"{style.title} {mean}" if left else f"{mean} {style.title}",
            ha="right" if left else "left", va="center", fontsize=9.5, color=INK,
        )  # fmt: skip
    return figure


def profile_figure(
    profiles: Mapping[str, Profile], styles: Mapping[str, MethodStyle], *, x_label: str, x_log: bool
) -> Figure:
    """Return the fraction of cells that reach each threshold, a curve for each method.

    Parameters
    ----------
    profiles
        By method, from `performance_profile`.
    styles
        Method to its style, in the order of the legend.
    x_label
        Of the thresholds, with their unit.
    x_log
        Whether their axis is logarithmic.
    """
    figure = Figure(figsize=(7.0, 4.2), layout="constrained", facecolor="white")
    ax = figure.add_subplot()
    if x_log:
        ax.set_xscale("log")
    dashes = ("-", (0, (5, 1.6)), (0, (1.5, 1.2)), (0, (5, 1.4, 1.4, 1.4)))
    shown = [name for name in styles if name in profiles]
    for place, name in enumerate(shown):
        profile, colour = profiles[name], styles[name].colour
        percent = [100 * values for values in (profile.fraction, profile.low, profile.high)]
        ax.fill_between(
            profile.thresholds, percent[1], percent[2], color=colour, alpha=0.10, linewidth=0
        )
        ax.plot(
            profile.thresholds, percent[0], color=colour, linewidth=1.9,
            linestyle=dashes[place % len(dashes)], label=styles[name].title,
        )  # fmt: skip
    ax.set_ylim(-2, 102)
    if shown:
        at = profiles[shown[0]].thresholds
        ax.set_xlim(float(at[0]), float(at[-1]))
    if x_log:
        plain_log_ticks(ax.xaxis)
    ax.set_xlabel(x_label, color=INK)
    ax.set_ylabel("cells that are as good (%)", color=INK)
    clean(ax, grid="both")
    if shown:
        figure.legend(loc="outside right upper", frameon=False, fontsize=9, handlelength=3.2)
    return figure
