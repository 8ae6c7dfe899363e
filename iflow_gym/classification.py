"""Which motion a trajectory is: argmax_k p(tau | k) over models that have a density.

Urain et al., "ImitationFlow", IROS 2020, sec. IV-C. Every model's density is in the recordings'
coordinates and their time, so those of different models compare, whatever units each has inside.

A trajectory that is larger, elsewhere or faster than the demonstrations is unlikely under all
models. `Pose` is a trajectory's place, size and tempo; with the demonstrations' own, each model
sees the trajectory moved, scaled and timed as its demonstrations are, and its density is carried
back: the change of variables x' = c_k + r (x - c) adds d log r for every sample.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.rounds import period_of


class TrajectoryDensity(Protocol):
    """A fitted model with a density of trajectories, such as `ImitationFlow`."""

    def trajectory_log_prob(
        self, x: ArrayLike, dt: float, *, stride: int = 1, initial: bool = False
    ) -> float:
        """Return the log density of a trajectory x, shape (T, d), sampled every dt seconds."""


@dataclass(frozen=True)
class Pose:
    """Place, size and tempo of a motion.

    Attributes
    ----------
    place : array, shape (d,)
        The mean of its samples where it repeats, its end where it ends.
    size : float
        Root of the mean squared distance of its samples from there.
    time : float
        Seconds of a round where it repeats, of the whole where it ends.
    """

    place: FloatArray
    size: float
    time: float

    @classmethod
    def of(cls, positions: ArrayLike, dt: float, *, cyclic: bool) -> Pose:
        """Return the pose of a trajectory, shape (T, d), sampled every dt seconds.

        Raises ValueError for one that stays in one place, and where `cyclic` for one in which no
        round can be told: see `iflow_gym.rounds`.
        """
        path = np.asarray(positions, dtype=np.float64)
        place = path.mean(axis=0) if cyclic else path[-1]
        size = float(np.sqrt(np.mean(np.sum((path - place) ** 2, axis=1))))
        if not size > 0:
            raise ValueError("Expected a trajectory that moves, got samples that are all the same.")
        time = period_of(path, dt) if cyclic else dt * (len(path) - 1)
        return cls(place, size, time)

    @classmethod
    def of_demonstrations(cls, demonstrations: Demonstrations) -> Pose:
        """Return the mean pose of recordings; sizes and times are geometric means."""
        poses = [
            cls.of(path, dt, cyclic=demonstrations.goal is None)
            for path, dt in zip(demonstrations.positions, demonstrations.dt, strict=True)
        ]
        sizes, times = ([getattr(pose, name) for pose in poses] for name in ("size", "time"))
        place: FloatArray = np.mean([pose.place for pose in poses], axis=0)
        return cls(
            place, float(np.exp(np.mean(np.log(sizes)))), float(np.exp(np.mean(np.log(times))))
        )


class TrajectoryClassifier:
    """Tells motions apart by the densities of one model each.

    Parameters
    ----------
    models : mapping of str to TrajectoryDensity
        One fitted model for each class, all of one dimension.
    demonstrations : mapping of str to Demonstrations, optional
        Those that the models were fitted on. Where given, place, size and tempo of a trajectory
        are removed before it is scored.
    horizon : float
        Seconds of a transition, rounded to whole samples: p(tau | k) is the product of the
        transitions over it. The shortest is one sample.
    """

    def __init__(
        self,
        models: Mapping[str, TrajectoryDensity],
        demonstrations: Mapping[str, Demonstrations] | None = None,
        *,
        horizon: float = 0.0,
    ) -> None:
        if not models:
            raise ValueError("Expected at least one model, got none.")
        if demonstrations is not None and set(demonstrations) != set(models):
            raise ValueError(
                f"Expected demonstrations of {sorted(models)}, got {sorted(demonstrations)}."
            )
        if not 0 <= horizon < np.inf:
            raise ValueError(f"Expected a finite horizon >= 0 in seconds, got {horizon}.")
        self.models, self.horizon = dict(models), float(horizon)
        self.names = list(self.models)
        self._cyclic = False
        self._poses: dict[str, Pose] | None = None
        if demonstrations is not None:
            kinds = {motion.goal is None for motion in demonstrations.values()}
            if len(kinds) > 1:
                raise ValueError("Expected motions that all end or all repeat, got both.")
            self._cyclic = kinds.pop()
            self._poses = {k: Pose.of_demonstrations(demonstrations[k]) for k in self.names}

    def log_probs(self, positions: ArrayLike, dt: float) -> FloatArray:
        """Return log p(tau | k) of a trajectory (T, d), sampled every dt seconds, for each class.

        Where poses are removed it is the density of the trajectory given its own pose.
        """
        path = np.asarray(positions, dtype=np.float64)
        if self._poses is None:
            return np.array([self._score(model, path, dt) for model in self.models.values()])
        own = Pose.of(path, dt, cyclic=self._cyclic)
        scores = []
        for name, model in self.models.items():
            pose = self._poses[name]
            ratio = pose.size / own.size
            moved = pose.place + ratio * (path - own.place)
            step = dt * pose.time / own.time
            n_scored = -(-len(path) // self._stride(dt))
            jacobian = path.shape[1] * n_scored * np.log(ratio)
            scores.append(self._score(model, moved, step, self._stride(dt)) + jacobian)
        return np.array(scores)

    def predict(self, positions: ArrayLike, dt: float) -> str:
        """Return the class under which a trajectory (T, d) is likeliest."""
        return self.names[int(np.argmax(self.log_probs(positions, dt)))]

    def confusion(self, labelled: Mapping[str, Demonstrations]) -> NDArray[np.int64]:
        """Return how many recordings of each class (rows) were taken for each (columns)."""
        counts = np.zeros((len(self.names), len(self.names)), dtype=np.int64)
        for i, name in enumerate(self.names):
            for path, dt in zip(labelled[name].positions, labelled[name].dt, strict=True):
                counts[i, self.names.index(self.predict(path, dt))] += 1
        return counts

    def accuracy(self, labelled: Mapping[str, Demonstrations]) -> float:
        """Return the fraction of recordings that were taken for their own class.

        With `varied` it gives the curve over size or tempo.
        """
        counts = self.confusion(labelled)
        return float(np.trace(counts) / counts.sum())

    def _stride(self, dt: float) -> int:
        return max(1, round(self.horizon / dt))

    def _score(
        self, model: TrajectoryDensity, path: FloatArray, dt: float, stride: int | None = None
    ) -> float:
        stride = self._stride(dt) if stride is None else stride
        return model.trajectory_log_prob(path, dt, stride=stride, initial=True)


def varied(
    demonstrations: Demonstrations, *, scale: float = 1.0, tempo: float = 1.0
) -> Demonstrations:
    """Return recordings that repeat, larger by `scale` about their mean and faster by `tempo`."""
    if not (0 < scale < np.inf and 0 < tempo < np.inf):
        raise ValueError(f"Expected a finite scale and tempo > 0, got {scale} and {tempo}.")
    if demonstrations.period is None:
        raise ValueError(f"Expected recordings that repeat, {demonstrations.name!r} end at a goal.")
    centre = np.concatenate(demonstrations.positions).mean(axis=0)
    return Demonstrations.from_arrays(
        [centre + scale * (path - centre) for path in demonstrations.positions],
        velocities=[scale * tempo * v for v in demonstrations.velocities],
        dt=[dt / tempo for dt in demonstrations.dt],
        period=demonstrations.period / tempo,
        name=demonstrations.name,
        length_unit=demonstrations.length_unit,
        source=demonstrations.source,
        held_out=demonstrations.held_out,
    )
