"""Every metric's name, unit, direction and meaning: the one place where tables read them."""

from __future__ import annotations

import difflib
import functools
import hashlib
from dataclasses import dataclass
from importlib import resources
from typing import Literal

Motion = Literal["goal", "cycle", "drumming"]
"""Whether demonstrations end at a goal, repeat with a period, or drum, which repeats too."""


@dataclass(frozen=True)
class Metric:
    """One number of a result record."""

    name: str
    """Key in result records, and the name of the function where one computes it."""
    unit: str
    """Unit, where "length" is the demonstrations' own, and "-" is none."""
    better: Literal["lower", "higher"]
    """Which way is better."""
    family: Literal["accuracy", "stability", "cost"]
    """Table that it belongs to."""
    title: str
    """Heading in tables."""
    definition: str
    """What it is, in a sentence; the docstrings have the equations."""
    motions: tuple[Motion, ...] = ("goal", "cycle", "drumming")
    """Kinds of motion that it is a number of."""


METRICS: tuple[Metric, ...] = (
    Metric(
        "rmse",
        "length",
        "lower",
        "accuracy",
        "RMSE",
        "Root of the mean squared distance between samples of equal index.",
        motions=("goal",),
    ),
    Metric(
        "frechet",
        "length",
        "lower",
        "accuracy",
        "Fréchet",
        "Discrete Fréchet distance on the full sequences, Euclidean.",
        motions=("goal",),
    ),
    Metric(
        "dtw",
        "length",
        "lower",
        "accuracy",
        "DTW / sample",
        "Least sum of Euclidean distances over warping paths with steps (1,0), (0,1) and (1,1), "
        "without a window, divided by the demonstration's number of samples; of a motion that "
        "repeats over its first period.",
    ),
    Metric(
        "swept_area",
        "length²",
        "lower",
        "accuracy",
        "Swept area",
        "Sum over the steps of the exact, unsigned area of the tetragon between demonstration and "
        "reproduction; 2-D only.",
        motions=("goal",),
    ),
    Metric(
        "swept_surface",
        "length²",
        "lower",
        "accuracy",
        "Swept surface",
        "Sum over the steps of the surface of the tetragon between demonstration and reproduction, "
        "as the smaller of its two pairs of triangles; 3-D only.",
        motions=("goal",),
    ),
    Metric(
        "seds_error",
        "-",
        "lower",
        "accuracy",
        "SEDS error",
        "Mean over the samples of the weighted errors of direction (0.6) and relative speed (0.4) "
        "of teacher-forced velocities, as SEDS eq. (23); null for methods that depend on time.",
    ),
    Metric(
        "direction_error",
        "-",
        "lower",
        "accuracy",
        "Direction error",
        "Mean over the samples of |1 - cos| of the angle between demonstrated and teacher-forced "
        "velocity; null for methods that depend on time.",
    ),
    Metric(
        "velocity_rmse",
        "length/s",
        "lower",
        "accuracy",
        "Velocity RMSE",
        "Root of the mean squared error of teacher-forced velocities; null for methods that depend "
        "on time.",
    ),
    Metric(
        "nll_1",
        "nats",
        "lower",
        "accuracy",
        "NLL, 1 step",
        "Mean negative log-likelihood of held-out transitions over 1 sample, per dimension; null "
        "for methods without a density, and in reproduction, where nothing is held out.",
    ),
    Metric(
        "nll_10",
        "nats",
        "lower",
        "accuracy",
        "NLL, 10 steps",
        "Mean negative log-likelihood of held-out transitions over 10 samples, per dimension; null "
        "for methods without a density, and in reproduction, where nothing is held out.",
    ),
    Metric(
        "orbit_distance",
        "length",
        "lower",
        "accuracy",
        "Orbit distance",
        "Mean distance to the nearest sample between the steady orbit, the rollout's last two of "
        "eight periods, and the demonstration's samples, both ways, averaged.",
        motions=("cycle", "drumming"),
    ),
    Metric(
        "orbit_hausdorff",
        "length",
        "lower",
        "accuracy",
        "Orbit Hausdorff",
        "Hausdorff distance between the steady orbit and the demonstration's samples: half of how "
        "far its own rounds lie apart is the least there is.",
        motions=("cycle", "drumming"),
    ),
    Metric(
        "period_error",
        "-",
        "lower",
        "accuracy",
        "Period error",
        "Relative error of the period, by autocorrelation, against the mean of the "
        "demonstrations'.",
        motions=("cycle", "drumming"),
    ),
    Metric(
        "phase_rmse",
        "length",
        "lower",
        "accuracy",
        "Phase RMSE",
        "RMSE between the demonstration's rounds and the steady orbit, each round at its best "
        "shift in time.",
        motions=("cycle", "drumming"),
    ),
    Metric(
        "hit_f1",
        "-",
        "higher",
        "accuracy",
        "Hit F1",
        "F1 of the hits within 50 ms of a note of their drum in the score that the demonstration "
        "implies, one to one.",
        motions=("drumming",),
    ),
    Metric(
        "rhythm_f1",
        "-",
        "higher",
        "accuracy",
        "Rhythm F1",
        "F1 of the hits of eight rounds within 50 ms of the rhythm that the demonstrations have in "
        "common, at the performance's own tempo and start.",
        motions=("drumming",),
    ),
    Metric(
        "sequence_f1",
        "-",
        "higher",
        "accuracy",
        "Sequence F1",
        "F1 of the order of the drums alone, whenever they are hit.",
        motions=("drumming",),
    ),
    Metric(
        "timing_error",
        "ms",
        "lower",
        "accuracy",
        "Timing error",
        "Mean absolute time between matched notes and hits.",
        motions=("drumming",),
    ),
    Metric(
        "tempo_error",
        "-",
        "lower",
        "accuracy",
        "Tempo error",
        "Relative error of the median interval between successive hits of one drum.",
        motions=("drumming",),
    ),
    Metric(
        "missed",
        "-",
        "lower",
        "accuracy",
        "Missed",
        "Notes of the demonstration's score without a hit.",
        motions=("drumming",),
    ),
    Metric(
        "extra",
        "-",
        "lower",
        "accuracy",
        "Extra",
        "Hits that are no note of the demonstration's score.",
        motions=("drumming",),
    ),
    Metric(
        "tracking_rmse",
        "mm",
        "lower",
        "accuracy",
        "Tracking RMSE",
        "Root of the mean squared distance of the tip from where it was commanded to be.",
        motions=("drumming",),
    ),
    Metric(
        "converged",
        "-",
        "higher",
        "stability",
        "Converged",
        "Fraction of the starts that are within 2 % of the diagonal of the goal for the whole last "
        "5 % of the horizon.",
        motions=("goal",),
    ),
    Metric(
        "settling_time",
        "demonstration durations",
        "lower",
        "stability",
        "Settling time",
        "Median time to enter the tolerance for good, divided by the mean duration of the "
        "demonstrations; a start that does not settle takes infinitely long.",
        motions=("goal",),
    ),
    Metric(
        "spurious_attractors",
        "-",
        "lower",
        "stability",
        "Spurious attractors",
        "Clusters of end states outside the tolerance that have stopped moving.",
        motions=("goal",),
    ),
    Metric(
        "attraction",
        "-",
        "higher",
        "stability",
        "Attraction",
        "Fraction of the starts whose distance to the demonstrations' samples stays within 5 % of "
        "the diagonal over the last of eight periods; of the arm, the last of four, from 100 "
        "starts that it can reach.",
        motions=("cycle", "drumming"),
    ),
    Metric(
        "diverged",
        "-",
        "lower",
        "stability",
        "Diverged",
        "Fraction of the starts that leave the box enlarged 10 times, or are not finite.",
    ),
    Metric(
        "perturbation_recovery",
        "-",
        "higher",
        "stability",
        "Perturbation recovery",
        "Fraction of rollouts, pushed once at 40 % of the way by 25 % of the diagonal in a seeded "
        "random direction, that still converge, or are attracted. The arm is pushed twice, by a "
        "displacement and by a force half way, and has two periods to be back.",
    ),
    Metric(
        "lyapunov_violation",
        "-",
        "lower",
        "stability",
        "Lyapunov violation",
        "Fraction of 10 000 states, drawn uniformly from the enlarged box, where the method's own "
        "Lyapunov function does not decrease; null for methods that have none.",
    ),
    Metric(
        "fit_seconds",
        "s",
        "lower",
        "cost",
        "Fit, wall",
        "Wall time of the fit.",
    ),
    Metric(
        "fit_cpu_seconds",
        "s",
        "lower",
        "cost",
        "Fit, CPU",
        "User and system time of the fit, over all threads of the process.",
    ),
    Metric(
        "n_parameters",
        "-",
        "lower",
        "cost",
        "Parameters",
        "Number of fitted parameters, as the method counts them.",
    ),
    Metric(
        "step_us",
        "µs",
        "lower",
        "cost",
        "Step",
        "Median wall time of a call of the policy with a single state, on one thread.",
    ),
    Metric(
        "peak_memory_mb",
        "MB",
        "lower",
        "cost",
        "Peak memory",
        "Rise of the resident memory during the fit above its level at the start, 10^6 bytes; what "
        "a batch of fits took together is shared.",
    ),
)
"""All metrics that are numbers, in the order of their tables. A method's guarantee is a word,
`iflow_gym.system.Guarantee`."""

FILES: dict[Motion, tuple[str, ...]] = {
    "goal": ("_validation.py", "accuracy.py", "cost.py", "stability.py"),
    "cycle": ("_validation.py", "accuracy.py", "cost.py", "cycles.py", "stability.py"),
    "drumming": (
        "_validation.py",
        "accuracy.py",
        "cost.py",
        "cycles.py",
        "drumming.py",
        "stability.py",
    ),
}
"""Files of this package that compute the metrics of a motion."""


def metrics_of(motion: Motion) -> tuple[Metric, ...]:
    """Metrics that are numbers of a motion.

    Parameters
    ----------
    motion
        "goal", "cycle" or "drumming".

    Returns
    -------
    tuple of Metric
        In the order of their tables.
    """
    return tuple(metric for metric in METRICS if motion in metric.motions)


def get_metric(name: str) -> Metric:
    """Look up a metric by its name.

    Parameters
    ----------
    name
        Key in result records.

    Returns
    -------
    Metric
        The one of that name.

    Raises
    ------
    KeyError
        If there is none; the message suggests the nearest names.
    """
    by_name = {metric.name: metric for metric in METRICS}
    if name not in by_name:
        near = difflib.get_close_matches(name, by_name) or sorted(by_name)
        raise KeyError(f"Expected the name of a metric, got {name!r}: did you mean {near}?")
    return by_name[name]


@functools.cache
def metrics_hash(motion: Motion) -> str:
    """Fingerprint of the code that computes the metrics of a motion, for result records.

    Returns
    -------
    str
        SHA-256, in hexadecimal, over the names and the text of the `FILES`, with line feeds as line
        endings. Two records with the same hash mean the same by every number; comments and
        docstrings, which are the definitions, count too.
    """
    digest = hashlib.sha256()
    folder = resources.files(__package__)
    for name in FILES[motion]:
        text = (folder / name).read_bytes().replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        digest.update(name.encode() + b"\0" + text + b"\0")
    return digest.hexdigest()
