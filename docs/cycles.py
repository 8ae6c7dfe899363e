"""Makes the pictures of limit cycles: `python docs/cycles.py`, two minutes.

docs/images/cycles.png          the four letters as learned, made and, with a mirror, recorded
docs/images/classification.png  telling letters apart when they are larger, smaller, faster, slower
"""

import os
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from iflow_gym import Demonstrations
from iflow_gym.baselines.imitation_flow import ImitationFlow
from iflow_gym.classification import TrajectoryClassifier, varied
from iflow_gym.datasets.letters import LETTERS, load_letter
from iflow_gym.datasets.recorded import MIRROR_VARIABLE, load_recorded_letter
from iflow_gym.figures import reproductions, save_figure
from iflow_gym.plotting import INK, plot_field

IMAGES = Path(__file__).parent / "images"

CHANGES = np.geomspace(0.5, 2.0, 13)
"""Factors of size and of tempo."""


def fitted(motions: dict[str, Demonstrations]) -> dict[str, ImitationFlow]:
    """Return a model of each motion, trained together."""
    systems = ImitationFlow().fit_many(list(motions.values()), seeds=[0] * len(motions))
    return dict(zip(motions, systems, strict=True))


def cycles(rows: dict[str, tuple[dict[str, Demonstrations], dict[str, ImitationFlow]]]) -> Figure:
    """Draw the fields of the letters, a row for each source."""
    figure = Figure(figsize=(13, 3.4 * len(rows)), layout="constrained", facecolor="white")
    axes = figure.subplots(len(rows), len(LETTERS), squeeze=False)
    for line, (source, (motions, systems)) in zip(axes, rows.items(), strict=True):
        for ax, letter in zip(line, LETTERS, strict=True):
            motion = motions[letter]
            shown = motion.subset(range(min(3, len(motion))))
            plot_field(ax, systems[letter], shown, reproductions(systems[letter], shown))
            ax.set(xticks=[], yticks=[], xlabel="", ylabel="")
            ax.set_title(f"{letter}, {source}", fontsize=10, color=INK)
    return figure


def classification(
    models: dict[str, ImitationFlow],
    shown: dict[str, Demonstrations],
    unseen: dict[str, Demonstrations],
) -> Figure:
    """Draw the share of unseen demonstrations that are told right, against size and tempo."""
    figure = Figure(figsize=(9, 3.2), layout="constrained", facecolor="white")
    axes = figure.subplots(1, 2, sharey=True)
    classifiers = {
        "as they are": TrajectoryClassifier(models),
        "place, size and tempo removed": TrajectoryClassifier(models, shown),
    }
    for ax, change in zip(axes, ("scale", "tempo"), strict=True):
        for (label, classifier), style in zip(classifiers.items(), ("o-", "s--"), strict=True):
            right = []
            for factor in CHANGES:
                changed = {k: varied(m, **{change: float(factor)}) for k, m in unseen.items()}
                counts = classifier.confusion(changed)
                right.append(100 * np.trace(counts) / counts.sum())
            ax.plot(CHANGES, right, style, label=label, markersize=4)
        ax.set_xscale("log")
        ax.set_xticks([0.5, 0.7, 1, 1.4, 2], ["0.5", "0.7", "1", "1.4", "2"])
        ax.minorticks_off()
        ax.set_xlabel({"scale": "size", "tempo": "tempo"}[change] + " of the unseen demonstrations")
        ax.grid(color="#e6e2d8")
    axes[0].set_ylabel("told right (%)")
    axes[0].set_ylim(0, 104)
    axes[0].legend(fontsize=8, frameon=False, loc="lower center")
    return figure


if __name__ == "__main__":
    splits = {letter: load_letter(letter).split("generalisation") for letter in LETTERS}
    shown = {letter: split.fit for letter, split in splits.items()}
    unseen = {letter: split.score for letter, split in splits.items()}
    models = fitted(shown)
    save_figure(classification(models, shown, unseen), IMAGES / "classification.png")
    sources = {"made": (shown, models)}
    if MIRROR_VARIABLE in os.environ:
        recorded = {letter: load_recorded_letter(letter) for letter in LETTERS}
        sources["recorded"] = (recorded, fitted(recorded))
    save_figure(cycles(sources), IMAGES / "cycles.png")
