"""Rows of the table that are no competitors: what the recordings themselves score.

``nearest-demonstration`` says how far the demonstrations are from each other, which is the
human's own variability; ``replay`` plays a recording back, which is the floor.
"""

from __future__ import annotations

from typing import Any, ClassVar, Protocol

import numpy as np

from iflow_gym import metrics
from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.evaluate import FIT_COSTS, Evaluation, Policy, evaluate, motion_of
from iflow_gym.evaluation.goals import trajectory_scores


class Reference(Protocol):
    """A row that is scored without being a method."""

    name: ClassVar[str]
    title: ClassVar[str]
    uses_time: ClassVar[bool]

    def evaluate(self, env: Any, *, seed: int, protocol: str) -> Evaluation:
        """Score the row on an unwrapped environment."""


class NearestDemonstration:
    """The smallest of each distance from a scored demonstration to another one.

    The others are the rest of the set in the reproduction protocol, and the fitted set in the
    generalisation protocol. There is no rollout, so that what compares samples of equal index from
    one start (RMSE), velocities, stability and cost do not apply. The swept area is taken to
    demonstrations of the same length; without one it does not apply. Of a motion that repeats the
    distances are those between orbits, and the differences of periods.
    """

    name: ClassVar[str] = "nearest-demonstration"
    title: ClassVar[str] = "Nearest demonstration"
    uses_time: ClassVar[bool] = False

    def evaluate(self, env: Any, *, seed: int, protocol: str) -> Evaluation:
        """Score the demonstrations against each other; there is nothing random in it."""
        fitted, scored = env.unwrapped.demonstrations.split(protocol)
        motion = motion_of(env.unwrapped)
        if motion == "goal":
            rows = [_distances(shown, fitted) for shown in scored.positions]
        else:
            pairs = zip(scored.positions, scored.dt, strict=True)
            rows = [_orbit_distances(shown, dt, fitted) for shown, dt in pairs]
        known = metrics.metrics_of(motion)
        names = [m.name for m in known if any(m.name in row for row in rows)]
        per_demonstration = {name: [row.get(name) for row in rows] for name in names}
        present = {
            name: [value for value in values if value is not None]
            for name, values in per_demonstration.items()
        }
        absent = {m.name: None for m in known if m.name not in FIT_COSTS}
        means = {name: float(np.mean(values)) for name, values in present.items()}
        medians = {name: float(np.median(values)) for name, values in present.items()}
        return Evaluation({**absent, **means}, dict(medians), per_demonstration)


def _distances(shown: FloatArray, others: Demonstrations) -> dict[str, float]:
    """Return the smallest of each distance from a recording to any but itself."""
    pool = [p for p, _ in _others(shown, others)]
    least: dict[str, float] = {}
    for length in sorted({len(p) for p in pool}):
        same = [p for p in pool if len(p) == length]
        found = (
            trajectory_scores([shown] * len(same), same)
            if length == len(shown)
            else {
                "frechet": [float(metrics.frechet(shown, p)) for p in same],
                "dtw": [float(metrics.dtw(shown, p)) for p in same],
            }
        )
        found.pop("rmse", None)
        for name, values in found.items():
            smallest = min(v for v in values if v is not None)
            least[name] = min(smallest, least.get(name, np.inf))
    return least


def _orbit_distances(shown: FloatArray, dt: float, others: Demonstrations) -> dict[str, float]:
    """Return the smallest of each distance from a recording's orbit to any but its own.

    Its period is compared with the mean of the others', as a method's is.
    """
    own = metrics.period(shown, dt, about=others.period)
    found = [
        {
            "orbit_distance": metrics.orbit_distance(p, shown),
            "orbit_hausdorff": metrics.orbit_hausdorff(p, shown),
            "period": metrics.period(p, h, about=others.period),
        }
        for p, h in _others(shown, others)
    ]
    least = {
        name: min(row[name] for row in found) for name in ("orbit_distance", "orbit_hausdorff")
    }
    tempo = float(np.mean([row["period"] for row in found]))
    if np.isfinite([own, tempo]).all():  # recordings of little more than a round show none
        least["period_error"] = metrics.period_error(own, tempo)
    return least


def _others(shown: FloatArray, others: Demonstrations) -> list[tuple[FloatArray, float]]:
    """Return the other recordings with their sample times."""
    pool = [(p, dt) for p, dt in zip(others.positions, others.dt, strict=True) if p is not shown]
    if not pool:
        raise ValueError(
            "Expected at least two demonstrations to compare with each other, got one."
        )
    return pool


class Replay:
    """Plays a recording back in real time: the scored one itself, or the nearest fitted one.

    From a start it takes the fitted recording whose first sample is nearest, and commands, at time
    t, the velocity that brings the mass to where the recording is at t + dt; after its end, to its
    last sample, or where the motion repeats, to its first one and on from there. In the
    reproduction protocol that is the scored recording itself, and what is left is rounding. In the
    generalisation protocol the mass leaps to the recording as fast as the environment lets it, and
    stays on it.

    It depends on time and knows nothing of states off its recording, so that the metrics of the
    field and of stability do not apply.
    """

    name: ClassVar[str] = "replay"
    title: ClassVar[str] = "Replay"
    uses_time: ClassVar[bool] = True

    def evaluate(self, env: Any, *, seed: int, protocol: str) -> Evaluation:
        """Score the replay as any other policy."""
        fitted = env.unwrapped.demonstrations.split(protocol).fit
        return evaluate(ReplayPolicy(fitted), env, seed=seed, protocol=protocol, stability=False)


class ReplayPolicy:
    """The policy of `Replay`; its state is which recordings are played, and the step."""

    def __init__(self, recordings: Demonstrations, env: Any = None) -> None:
        self._recordings = recordings
        self._env = env

    def for_environment(self, env: Any) -> Policy:
        """Return the policy for an environment, whose dt and conversions it needs."""
        return ReplayPolicy(self._recordings, env)

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[FloatArray, Any]:
        """Return actions, shape (..., d), and the state for the next step."""
        if self._env is None:
            raise ValueError("Expected an environment to play in: call for_environment(env).")
        observations = np.asarray(observation, dtype=np.float64)
        x = np.atleast_2d(observations)[:, : self._recordings.n_dims]
        dt = np.broadcast_to(self._env.dt, len(x))
        if state is None:
            distances = np.linalg.norm(x[:, None] - self._recordings.starts, axis=-1)
            # Two recordings may begin in one place; the episode's dt then tells which is meant.
            nearest = distances <= distances.min(axis=1, keepdims=True) + 1e-12
            mismatch = np.abs(dt[:, None] - np.array(self._recordings.dt))
            state = (np.where(nearest, mismatch, np.inf).argmin(axis=1), 0)
        played, step = state
        targets = np.stack(
            [self._at(int(i), (step + 1) * h) for i, h in zip(played, dt, strict=True)]
        )
        command = ((targets - x) / dt[:, None]).reshape(
            *observations.shape[:-1], self._recordings.n_dims
        )
        action: FloatArray = self._env.command_to_action(command, observations)
        return action, (played, step + 1)

    def _at(self, index: int, time: float) -> FloatArray:
        """Return where a recording is at a time in seconds, between its samples by a line."""
        samples = self._recordings.positions[index]
        place, last = time / self._recordings.dt[index], len(samples) - 1.0
        place = min(place, last) if self._recordings.period is None else place % last
        before = min(int(place), len(samples) - 2)
        here: FloatArray = samples[before] + (place - before) * (
            samples[before + 1] - samples[before]
        )
        return here
