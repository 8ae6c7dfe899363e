"""The reward of the environments, progress along the demonstrations, and their aim.

Let m = (x + x') / 2 be the middle of a step, k the demonstrations' sample nearest to m, p_k its
position, t_k the unit tangent and s_k the speed there. With w a twentieth of the diagonal of the
demonstrations' bounding box and the step's velocity u = (x' - x) / dt,

    n = (t_k + (p_k - m) / w) / ||t_k + (p_k - m) / w||,
    r = <u, n> / max(||u||, s_k).

On a demonstration n is its direction of travel; away from it n turns towards it. So r is the
share of the demonstrated speed that the mass makes good in the right direction: about 1 for a
replay, 0 for standing still, -1 for going back, and |r| <= 1 by the Cauchy-Schwarz inequality.

A motion that ends has r = 1 where x' is within the tolerance of the goal. Faster than demonstrated
pays no more than demonstrated. Outside the goal r(x, x') = -r(x', x): taking a step back costs
exactly what the step paid, whatever its length. The tails of the recordings inside the goal's
tolerance are replaced by one sample, the goal, with no tangent and the mean speed at which the
recordings enter: there n points at the goal.

A motion that repeats has no goal, and its tempo is part of it: going faster than demonstrated pays
less, r = <u, n> s_k / max(||u||, s_k)^2, in proportion to s_k / ||u||.

What no such reward can do: it is bounded, depends on (x, x') alone and gives 1 a step for a
replay, so a loop that goes forward at the demonstrated speed and back several times faster has a
positive sum (about 0.8 a step at full speed back). It never beats the replay, whose every step is
worth about 1, the maximum.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cached_property, lru_cache
from typing import ClassVar

import numpy as np

from iflow_gym.demonstrations import GOAL_TOLERANCE, Demonstrations, FloatArray
from iflow_gym.envs.dynamics import Arithmetic, Component, dot
from iflow_gym.envs.nearest import NearestSample
from iflow_gym.phases import common_phases

WIDTH = 0.05
"""w as a fraction of the diagonal: there the guide points 45 degrees off the tangent."""

SLOWEST = 1e-6
"""Samples slower than this fraction of the peak speed have no direction and are left out."""

TURNING = 0.01
"""So are, of a motion that repeats, those that are slower than this: it turns round there."""

_TINY = 1e-12
"""Keeps 0 / 0 away where the guide vanishes."""


_rewarded = ContextVar("rewarded", default=True)


@contextmanager
def without_rewards() -> Iterator[None]:
    """Let every reward be NaN within this block, which spares half of a point mass's step.

    For scoring, which looks at positions alone.
    """
    token = _rewarded.set(False)
    try:
        yield
    finally:
        _rewarded.reset(token)


class Guide(ABC):
    """The reward's field for one set of demonstrations, and how far a state is from their aim.

    `guide_for` makes and keeps it; its table is made when first needed.
    """

    measured: ClassVar[tuple[str, ...]]
    """Names of what `measures` returns, the distance from the aim first."""

    def __init__(self, demonstrations: Demonstrations) -> None:
        self._demonstrations = demonstrations
        diagonal = demonstrations.bounding_box.diagonal
        self.tolerance = GOAL_TOLERANCE * diagonal
        """Distance from the aim within which a state counts as a success."""
        self._per_width = 1 / (WIDTH * diagonal)

    @cached_property
    def _nearest(self) -> NearestSample:
        """Of each sample p / w + t, s, and then what the kind of motion adds."""
        points, tangents, speeds, more = self._samples()
        rows = np.column_stack([points * self._per_width + tangents, speeds, more])
        return NearestSample(points, rows, self._demonstrations.bounding_box)

    @abstractmethod
    def _samples(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return positions (m, d), unit tangents (m, d), speeds (m,), and more columns (m, k)."""

    @abstractmethod
    def measures(self, ops: Arithmetic[Component], x: Sequence[Component]) -> tuple[Component, ...]:
        """Return what is `measured` at a state whose first d components are a position."""

    def reward(
        self,
        ops: Arithmetic[Component],
        x: Sequence[Component],
        x_next: Sequence[Component],
        dt: Component,
        distance: Component,
    ) -> Component:
        """Return the reward of a step that ends at a distance from the aim."""
        if not _rewarded.get():
            return distance * math.nan
        d = len(x)
        middle = [(a + b) * 0.5 for a, b in zip(x, x_next, strict=True)]
        row = self._nearest.of(ops, middle)
        guide = [p - m * self._per_width for p, m in zip(row[:d], middle, strict=True)]
        step = [b - a for a, b in zip(x, x_next, strict=True)]
        shown = row[d] * dt
        pace = ops.largest(ops.root(dot(step, step)), shown)
        norm = ops.largest(ops.root(dot(guide, guide)), _TINY)
        made = dot(step, guide) / norm
        reward: Component = self._reward(ops, made, pace, shown, distance)
        return reward

    @abstractmethod
    def _reward(
        self,
        ops: Arithmetic[Component],
        made: Component,
        pace: Component,
        shown: Component,
        distance: Component,
    ) -> Component:
        """Return the reward, given <u, n> dt, the longer of step and shown step, and the latter."""


class GoalGuide(Guide):
    """Along a motion that ends, to its goal."""

    measured = ("distance_to_goal",)

    def __init__(self, demonstrations: Demonstrations) -> None:
        super().__init__(demonstrations)
        self._goal: list[float] = demonstrations.attractor.tolist()

    def measures(self, ops: Arithmetic[Component], x: Sequence[Component]) -> tuple[Component, ...]:
        """Return the distance from the goal."""
        offset = [a - g for a, g in zip(x, self._goal, strict=False)]
        return (ops.root(dot(offset, offset)),)

    def _reward(
        self,
        ops: Arithmetic[Component],
        made: Component,
        pace: Component,
        shown: Component,
        distance: Component,
    ) -> Component:
        """Return 1 at the goal."""
        share = ops.largest(ops.smallest(made / pace, 1.0), -1.0)
        return ops.select(distance <= self.tolerance, 1.0, share)

    def _samples(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        demos = self._demonstrations
        goal = demos.attractor
        points, velocities, entries = [], [], []
        for p, v in zip(demos.positions, demos.velocities, strict=True):
            outside = np.flatnonzero(np.linalg.norm(p - goal, axis=1) > self.tolerance)
            moving = np.linalg.norm(v, axis=1) > SLOWEST * demos.peak_speed
            end = int(outside[-1]) + 1 if len(outside) else 0
            points.append(p[:end][moving[:end]])
            velocities.append(v[:end][moving[:end]])
            entries.append(float(np.linalg.norm(v[max(end - 1, 0)])))
        path, flow = np.concatenate(points), np.concatenate(velocities)
        speeds = np.linalg.norm(flow, axis=1)
        arrival = max(float(np.mean(entries)), SLOWEST * demos.peak_speed)
        return (
            np.concatenate([path, goal[None]]),
            np.concatenate([flow / speeds[:, None], np.zeros_like(goal)[None]]),
            np.append(speeds, arrival),
            np.empty((len(path) + 1, 0)),
        )


class CycleGuide(Guide):
    """Round a motion that repeats, on its orbit and at its tempo.

    The phase is that of the nearest sample, in rounds from 0 to 1 (see `iflow_gym.phases`), and the
    distance from the orbit that from the same sample: in the plane off by the size of a cell of the
    table at most, and beyond the box enlarged by half of each side only a direction, not a measure.
    """

    measured = ("distance_to_orbit", "phase")

    def measures(self, ops: Arithmetic[Component], x: Sequence[Component]) -> tuple[Component, ...]:
        """Return the distance from the orbit and the phase."""
        d = self._demonstrations.n_dims
        position = list(x[:d])
        row = self._nearest.of(ops, position)
        offset = [a - p for a, p in zip(position, row[d + 2 :], strict=True)]
        return ops.root(dot(offset, offset)), row[d + 1]

    def _reward(
        self,
        ops: Arithmetic[Component],
        made: Component,
        pace: Component,
        shown: Component,
        distance: Component,
    ) -> Component:
        """Return what pays most at the demonstrated tempo."""
        return ops.largest(ops.smallest(made * shown / (pace * pace), 1.0), -1.0)

    def _samples(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        demos = self._demonstrations
        points, flow = np.concatenate(demos.positions), np.concatenate(demos.velocities)
        rounds = np.concatenate(common_phases(demos)) % 1.0
        speeds = np.linalg.norm(flow, axis=1)
        moving = speeds > TURNING * demos.peak_speed
        points, speeds = points[moving], speeds[moving]
        more = np.column_stack([rounds[moving], points])
        return points, flow[moving] / speeds[:, None], speeds, more


@lru_cache(maxsize=64)
def guide_for(demonstrations: Demonstrations) -> Guide:
    """Return the guide of a set of demonstrations, made at the first call."""
    return (GoalGuide if demonstrations.period is None else CycleGuide)(demonstrations)
