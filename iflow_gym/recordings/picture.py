"""A picture of recordings before and after they were cleaned."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from iflow_gym.demonstrations import FloatArray
from iflow_gym.plotting import DEMONSTRATION, GOAL, INK, PAPER
from iflow_gym.recordings.cleaning import Cleaned
from iflow_gym.recordings.raw import RawRecording

RAW = "#8a97a3"
CUT = "#c0392b"
"""Samples of which nothing is left: trimmed, missing, cut off."""

AXES = ("x", "y", "z")
COLOURS = (DEMONSTRATION, "#0b6e4f", "#3c6699", "#f2b705", "#7b4fa3", "#22303c", "#8a97a3")


def cleaning_figure(cleaned: Cleaned) -> Figure:
    """Return a figure: the paths before and after, and the speeds over time of both.

    Motions that are not planar are drawn as coordinates over time in place of paths.
    """
    demos = cleaned.demonstrations
    high = _height(cleaned)
    figure = Figure(figsize=(9.0, high + 2.64), layout="constrained", facecolor="white")
    before, after, speed_before, speed_after = figure.subplots(
        2, 2, gridspec_kw={"height_ratios": (high, 2.64)}
    ).ravel()
    n = sum(len(r) for r in cleaned.before)
    m = sum(len(r) for r in cleaned.after)
    plural = "s" if len(cleaned.before) > 1 else ""
    before.set_title(f"as recorded: {len(cleaned.before)} recording{plural}, {n} samples")
    after.set_title(f"cleaned: {m} samples")
    unit = demos.length_unit
    _paths(before, cleaned.before, unit, raw=True, kept=cleaned.after)
    _paths(after, cleaned.after, unit, raw=False)
    if demos.n_dims == 2:
        if demos.goal is not None:
            after.plot(*demos.goal, "*", color=GOAL, markersize=14, markeredgecolor=INK, zorder=7)
        low, top = _box(cleaned)
        for ax in (before, after):
            ax.set_aspect("equal")
            ax.set_xlim(low[0], top[0])
            ax.set_ylim(low[1], top[1])
    for raw in cleaned.before:
        times, speed = _raw_speed(raw)
        speed_before.plot(times, speed, color=RAW, linewidth=0.9)
    for recording, velocity in zip(cleaned.after, demos.velocities, strict=True):
        speed = np.linalg.norm(velocity, axis=1)
        speed_after.plot(recording.times, speed, color=DEMONSTRATION, linewidth=1.2, alpha=0.85)
    for ax, title in (
        (speed_before, "from sample to sample"),
        (speed_after, "as given to methods"),
    ):
        ax.set_title(f"speed, {title}")
        ax.set_xlabel("time (s)")
        ax.set_ylabel(f"speed ({unit}/s)")
        ax.set_xlim(speed_before.get_xlim())
        highest = max(a.get_ylim()[1] for a in (speed_before, speed_after))
        ax.set_ylim(0, highest)
    figure.suptitle(demos.name, color=INK)
    for ax in (before, after, speed_before, speed_after):
        ax.set_facecolor(PAPER)
        ax.title.set_fontsize("medium")
        ax.title.set_color(INK)
        ax.tick_params(colors=INK, labelsize="small", length=3)
        for spine in ax.spines.values():
            spine.set_color("#c9c5bb")
    return figure


def _box(cleaned: Cleaned) -> tuple[FloatArray, FloatArray]:
    """Return the lower and the upper corner of what is drawn, with a margin."""
    points = np.concatenate([r.positions for r in (*cleaned.before, *cleaned.after)])
    points = points[np.isfinite(points).all(axis=1)]
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.06 * float((high - low).max())
    return low - margin, high + margin


def _height(cleaned: Cleaned) -> float:
    """Return the inches of the upper row: less for a flat motion, which would leave it white."""
    if cleaned.demonstrations.n_dims != 2:
        return 3.96
    low, high = _box(cleaned)
    width, height = high - low
    return float(np.clip(0.8 + 3.9 * height / max(width, 1e-300), 1.6, 3.96))


def _paths(
    ax: Axes,
    recordings: Sequence[RawRecording],
    unit: str,
    *,
    raw: bool,
    kept: Sequence[RawRecording] = (),
) -> None:
    planar = recordings[0].n_dims == 2
    for i, r in enumerate(recordings):
        if planar:
            x, y = r.positions.T
            ax.plot(x, y, "-", color=RAW if raw else DEMONSTRATION, linewidth=0.8 if raw else 1.4)
            if raw:
                ax.plot(x, y, ".", color=RAW, markersize=2.5)
                gone = _gone(r, kept[i])
                ax.plot(x[gone], y[gone], "x", color=CUT, markersize=5, label="left out")
            else:
                ax.plot(x[0], y[0], "o", color=PAPER, markeredgecolor=DEMONSTRATION, markersize=6)
        else:
            for k, column in enumerate(r.positions.T):
                label = AXES[k] if r.n_dims <= 3 else f"x{k + 1}"
                colour = COLOURS[k % len(COLOURS)]
                ax.plot(r.times, column, color=colour, linewidth=1, label=label if i == 0 else None)
    if planar:
        ax.set_xlabel(f"x ({unit})")
        ax.set_ylabel(f"y ({unit})")
        if raw and any(_gone(r, k).any() for r, k in zip(recordings, kept, strict=True)):
            handles, labels = ax.get_legend_handles_labels()
            ax.legend(handles[:1], labels[:1], fontsize="small", frameon=False)
    else:
        ax.set_xlabel("time (s)")
        ax.set_ylabel(f"position ({unit})")
        ax.legend(fontsize="small", frameon=False)


def _gone(before: RawRecording, after: RawRecording) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Return the samples that are there in the picture, and outside the times that were kept."""
    slack = 1e-9 * max(abs(float(after.times[-1])), 1e-300)
    outside = (before.times < after.times[0] - slack) | (before.times > after.times[-1] + slack)
    return np.asarray(outside & np.isfinite(before.positions).all(axis=1))


def _raw_speed(recording: RawRecording) -> tuple[FloatArray, FloatArray]:
    """Return the middle of each step and its speed; steps that take no time are left out."""
    whole = np.isfinite(recording.times) & np.isfinite(recording.positions).all(axis=1)
    times, points = recording.times[whole], recording.positions[whole]
    steps = np.diff(times)
    forward = steps > 0
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)[forward]
    return ((times[1:] + times[:-1]) / 2)[forward], lengths / steps[forward]
