"""Compares the letters with the recorded ones: `python docs/letters.py`, half a minute.

Draws docs/images/letters.png and writes the table in docs/letters.md. Needs the authors'
recordings: a network, or IFLOW_GYM_RECORDED.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter1d
from scipy.signal import butter, filtfilt

from iflow_gym import Demonstrations
from iflow_gym.baselines.orbit_field import OrbitField
from iflow_gym.datasets.letters import DT, LETTERS, load_letter
from iflow_gym.datasets.recorded import load_recorded_letter
from iflow_gym.figures import save_figure
from iflow_gym.metrics import orbit_distance, orbit_hausdorff
from iflow_gym.rounds import period_of, phases

DOCS = Path(__file__).parent
FAST = 8.0  # Hz: above this, what a hand does is not meant
SMOOTHING = 2.0  # samples: curvature needs second derivatives
CURVATURES = (2.0, 40.0)  # times height: where the power law is fitted
COLOURS = ("#4477aa", "#ee6677", "#228833")


class Measures(NamedTuple):
    """How a letter was traced; lengths in % of its height, speeds in heights a second."""

    period: float
    tempo_within: float
    tempo_between: float
    rounds_apart: float
    rounds_apart_most: float
    speed: float
    slow: float
    fast: float
    flutter: float
    slope: float
    orbit_distance: float
    orbit_hausdorff: float


ROWS = {
    "duration of a round (s)": ("period", "{:.2f}"),
    "tempo within a recording: deviation of the duration (%)": ("tempo_within", "{:.1f}"),
    "tempo from recording to recording: deviation (%)": ("tempo_between", "{:.0f}"),
    "distance from round to round, mean (% of height)": ("rounds_apart", "{:.1f}"),
    "distance from round to round, 95th percentile (%)": ("rounds_apart_most", "{:.1f}"),
    "mean speed (heights a second)": ("speed", "{:.1f}"),
    "5th percentile of the speed (of the mean)": ("slow", "{:.2f}"),
    "95th percentile of the speed (of the mean)": ("fast", "{:.2f}"),
    "speed's fluctuation above 8 Hz (% of the mean)": ("flutter", "{:.0f}"),
    "slope of log speed against log curvature": ("slope", "{:.2f}"),
    "mean orbit to a recording, mean (% of the diagonal)": ("orbit_distance", "{:.2f}"),
    "mean orbit to a recording, Hausdorff (% of the diagonal)": ("orbit_hausdorff", "{:.1f}"),
}


def scaled(positions: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return recordings, all scaled alike to a mean height of 100, around the origin."""
    samples = np.concatenate(positions)
    centre = (samples.min(axis=0) + samples.max(axis=0)) / 2
    height = np.mean([np.ptp(p[:, 1]) for p in positions])
    return [(p - centre) * 100 / height for p in positions]


def measure(positions: Sequence[np.ndarray]) -> Measures:
    """Measure recordings of one letter, 100 high."""
    each = np.array([_measure(p) for p in positions])
    means = each.mean(axis=0)
    between = 100 * np.std(np.log(each[:, 0])) if len(each) > 1 else np.nan
    return Measures(means[0], means[1], between, *means[2:], *_from_mean_orbit(positions))


def _from_mean_orbit(positions: Sequence[np.ndarray]) -> tuple[float, float]:
    """Return how far recordings are from the orbit that is their mean."""
    motion = Demonstrations.from_arrays(
        list(positions), dt=DT, period=float(np.mean([period_of(p, DT) for p in positions]))
    )
    system, n = OrbitField().fit(motion, seed=0), round(motion.period / DT)
    begin = system.rollout(positions[0][0], 5 * n, DT)[-1]
    orbit = system.rollout(begin, 10 * n, DT / 10)
    size = motion.bounding_box.diagonal / 100
    return (
        float(np.mean([orbit_distance(orbit, p) for p in positions])) / size,
        float(np.mean([orbit_hausdorff(orbit, p) for p in positions])) / size,
    )


def _measure(p: np.ndarray) -> tuple[float, ...]:
    index, phase = np.arange(len(p)), phases(p, DT)
    recurs = phase <= phase[-1] - 1
    durations = DT * (np.interp(phase[recurs] + 1, phase, index) - index[recurs])
    apart = []
    for i in index[recurs][::3]:
        # The path around a round later: the nearest point of it, at whatever phase.
        window = (phase > phase[i] + 0.6) & (phase < phase[i] + 1.4)
        apart.append(_distance(p[i], p[window]))
    velocity = np.gradient(p, DT, axis=0)
    speed = np.linalg.norm(velocity, axis=1)
    flutter = filtfilt(*butter(2, FAST * 2 * DT, "high"), speed)[8:-8].std()
    return (
        durations.mean(),
        100 * durations.std() / durations.mean(),
        float(np.mean(apart)),
        float(np.percentile(apart, 95)),
        speed.mean() / 100,
        np.percentile(speed, 5) / speed.mean(),
        np.percentile(speed, 95) / speed.mean(),
        100 * flutter / speed.mean(),
        power_law_slope(p, 100.0),
    )


def _distance(point: np.ndarray, path: np.ndarray) -> float:
    steps = np.diff(path, axis=0)
    along = ((point - path[:-1]) * steps).sum(axis=1) / np.maximum((steps**2).sum(axis=1), 1e-12)
    nearest = path[:-1] + np.clip(along, 0, 1)[:, None] * steps
    return float(np.linalg.norm(nearest - point, axis=1).min())


def power_law_slope(positions: np.ndarray, height: float) -> float:
    """Return the slope of log speed against log curvature of a smoothed recording."""
    smooth = gaussian_filter1d(positions, SMOOTHING, axis=0)
    v = np.gradient(smooth, DT, axis=0)
    a = np.gradient(v, DT, axis=0)
    speed = np.linalg.norm(v, axis=1)
    curvature = np.abs(v[:, 0] * a[:, 1] - v[:, 1] * a[:, 0]) / speed**3 * height
    used = (curvature > CURVATURES[0]) & (curvature < CURVATURES[1])
    used[:6] = used[-6:] = False
    return float(np.polyfit(np.log(curvature[used]), np.log(speed[used]), 1)[0])


def table(measured: dict[str, tuple[Measures, Measures]]) -> str:
    """Return the table of recorded and made letters, side by side, in Markdown."""
    head = "| | " + " | ".join(f"{x} recorded | {x} made" for x in measured) + " |\n"
    rows = head + "| --- |" + " ---: |" * (2 * len(measured)) + "\n"
    for label, (name, form) in ROWS.items():
        values = [getattr(m, name) for pair in measured.values() for m in pair]
        cells = ["–" if np.isnan(v) else form.format(v) for v in values]
        rows += f"| {label} | " + " | ".join(cells) + " |\n"
    return rows


def picture(letters: dict[str, tuple[list[np.ndarray], list[np.ndarray]]]) -> Figure:
    """Draw all rounds of the recorded letters, as many recordings of ours, and speeds."""
    figure = Figure(figsize=(11, 8.7), layout="constrained", facecolor="white")
    axes = figure.subplots(4, len(letters), height_ratios=(3, 3, 1.2, 1.2))
    for column, (letter, pair) in zip(axes.T, letters.items(), strict=True):
        top = max(
            np.percentile(np.linalg.norm(np.diff(p[0], axis=0), axis=1), 99.5) / DT for p in pair
        )
        for k, (kind, recordings) in enumerate(zip(("recorded", "made"), pair, strict=True)):
            ax, below = column[k], column[k + 2]
            for p, colour in zip(recordings, COLOURS, strict=False):
                ax.plot(*p.T, color=colour, linewidth=0.8)
            ax.plot(*recordings[0][::3].T, ".", color=COLOURS[0], markersize=2.5)
            ax.set(xlim=(-66, 66), ylim=(-62, 62), aspect="equal", xticks=[], yticks=[])
            ax.set_title(f"{letter}, {kind}", fontsize=10)
            speed = np.linalg.norm(np.gradient(recordings[0], DT, axis=0), axis=1)
            phase = phases(recordings[0], DT)
            below.plot(phase, speed / 100, color=COLOURS[0], linewidth=0.8)
            below.set(xlim=(0, 3), ylim=(0, 1.1 * top / 100))
            below.set_title(f"speed, {kind}", fontsize=8, pad=3)
            below.tick_params(labelsize=7)
            below.spines[["top", "right"]].set_visible(False)
        column[3].set_xlabel("rounds", fontsize=8)
    for ax in axes[2:, 0]:
        ax.set_ylabel("heights / s", fontsize=8)
    return figure


def compare() -> dict[str, tuple[Measures, Measures]]:
    """Return the measures of each letter, recorded and made."""
    return {letter: (measure(theirs), measure(ours)) for letter, (theirs, ours) in pairs().items()}


def pairs() -> dict[str, tuple[list[np.ndarray], list[np.ndarray]]]:
    """Return the recorded and the made recordings of each letter, 100 high."""
    return {
        letter: (
            scaled(load_recorded_letter(letter).positions),
            scaled(load_letter(letter).positions),
        )
        for letter in LETTERS
    }


def with_table(page: str, rows: str) -> str:
    """Return the page with its table replaced."""
    start, end = "<!-- written by docs/letters.py -->\n", "<!-- end -->"
    return re.sub(f"(?<={start}).*?(?={end})", lambda _: rows, page, flags=re.S)


if __name__ == "__main__":
    shown = {x: (theirs, ours[: len(theirs)]) for x, (theirs, ours) in pairs().items()}
    save_figure(picture(shown), DOCS / "images" / "letters.png", dpi=100)
    page = DOCS / "letters.md"
    page.write_text(with_table(page.read_text(), table(compare())))
