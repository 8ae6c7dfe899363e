"""What training sees: scaled recordings as tensors, and random numbers to choose among them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from iflow_gym.baselines.imitation_flow import frequency
from iflow_gym.demonstrations import Demonstrations, FloatArray

DRAWN_AT_ONCE = 64
"""Steps whose random numbers are drawn together: a call a model a step would cost more."""

THINNEST = 0.25
"""Least spread of a cycle along a principal axis, as a fraction of the first axis's: what lies
below it is left thin."""


@dataclass(frozen=True)
class Frame:
    """Units of one model: x = origin + matrix @ y, time in seconds per unit.

    Where motions end the origin is the goal, lengths are divided by the largest distance from it
    along an axis, and times by the mean duration. Where they repeat the origin is the mean state,
    the axes are the principal ones, scaled so that the first two become a circle of radius about 1
    (paper, sec. IV-B), and times are divided by the mean period of the recordings.
    """

    matrix: FloatArray
    time: float

    @classmethod
    def of(cls, task: Task) -> Frame:
        """Return the frame of a task's recordings."""
        if task.cyclic:
            return cls(task.principal_axes, float(np.mean(task.periods)))
        states = np.concatenate(task.centred)
        durations = np.concatenate([m.durations for m in task.motions])
        length = float(np.abs(states).max())
        return cls(length * np.eye(task.n_dims), float(durations.mean()))


@dataclass(frozen=True)
class Task:
    """What one model learns: a motion, or several that are told apart by a context."""

    motions: Sequence[Demonstrations]
    contexts: FloatArray | None = None
    """One for each motion, shape (motions, k)."""
    times: Sequence[float] | None = None
    """Seconds of a unit of time for each motion; the frame's where there are none."""

    @property
    def cyclic(self) -> bool:
        """Whether the motions repeat."""
        return self.motions[0].goal is None

    @property
    def n_recordings(self) -> int:
        """How many recordings there are in all."""
        return sum(len(motion) for motion in self.motions)

    @property
    def n_dims(self) -> int:
        """Dimension d."""
        return self.motions[0].n_dims

    @property
    def n_context(self) -> int:
        """Size k of the context."""
        return 0 if self.contexts is None else self.contexts.shape[1]

    @property
    def name(self) -> str:
        """The motions by name."""
        return ", ".join(motion.name for motion in self.motions)

    @property
    def origins(self) -> list[FloatArray]:
        """The state of each motion, shape (d,), that is the origin of its frame."""
        return [
            np.concatenate(m.positions).mean(axis=0) if self.cyclic else m.attractor
            for m in self.motions
        ]

    @property
    def shape(self) -> tuple[int, int, int, bool]:
        """What tasks must share to be trained in one batch."""
        return self.n_recordings, self.n_dims, self.n_context, self.cyclic

    @property
    def centred(self) -> list[FloatArray]:
        """The recordings relative to their origins."""
        return [p - o for m, o in zip(self.motions, self.origins, strict=True) for p in m.positions]

    @cached_property
    def principal_axes(self) -> FloatArray:
        """The principal axes as columns, (d, d), in which the motion is about a circle.

        Their lengths are sqrt(2) times the spread: the radius of a circle along its axes.
        """
        states = np.concatenate(self.centred)
        variances, axes = np.linalg.eigh(states.T @ states / len(states))  # ascending
        spreads = np.sqrt(np.maximum(variances[::-1], 0.0))
        return axes[:, ::-1] * (np.sqrt(2) * np.maximum(spreads, THINNEST * spreads[0]))

    @cached_property
    def periods(self) -> list[float]:
        """Seconds of a round of each recording: its own, or the given where it has too few."""
        inverse = np.linalg.inv(self.principal_axes).T
        steps = [(h, m.period) for m in self.motions for h in m.dt if m.period is not None]
        found = frequency.periods(
            [path @ inverse for path in self.centred], [given / h for h, given in steps]
        )
        return [
            h * samples if samples is not None else given
            for samples, (h, given) in zip(found, steps, strict=True)
        ]

    @property
    def turns(self) -> float:
        """Sense of a planar cycle in its frame: 1 counter-clockwise, -1 clockwise."""
        area = 0.0
        for path in self.scaled(Frame.of(self)):
            x, y = path[:, 0], path[:, 1]
            area += float(np.sum(x[:-1] * np.diff(y) - y[:-1] * np.diff(x)))
        return 1.0 if area >= 0 else -1.0

    def scaled(self, frame: Frame) -> list[FloatArray]:
        """Return the recordings in a frame."""
        inverse = np.linalg.inv(frame.matrix).T
        return [p @ inverse for p in self.centred]

    def steps(self, frame: Frame) -> list[float]:
        """Return the sample time of each recording in a frame; a cycle's have their own tempos."""
        steps = [h for m in self.motions for h in m.dt]
        return [h / t for h, t in zip(steps, self._times(frame), strict=True)]

    def peak_speed(self, frame: Frame) -> float:
        """Return the recordings' greatest speed, in length per unit of time."""
        speeds = [np.linalg.norm(v, axis=1).max() for m in self.motions for v in m.velocities]
        return float(max(v * t for v, t in zip(speeds, self._times(frame), strict=True)))

    def _times(self, frame: Frame) -> Sequence[float]:
        """Seconds of a unit of time for each recording."""
        if self.cyclic:
            return self.periods
        times = [frame.time] * len(self.motions) if self.times is None else self.times
        return [t for m, t in zip(self.motions, times, strict=True) for _ in range(len(m))]


class Recordings:
    """The recordings of m tasks with n recordings each, as padded tensors, points last.

    Positions and times are in the tasks' frames.

    Attributes
    ----------
    lengths : Tensor, shape (m, n)
        Samples of each recording.
    steps : Tensor, shape (m, n)
        Time of a sample.
    context : Tensor, shape (m, k, n), or None
    centre, half : Tensors, shape (m, d, 1)
        Of the box of all samples.
    frame : Tensor, shape (m, d, d)
        The frames' matrices.
    peak_speed : Tensor, shape (m, 1)
        The recordings' greatest speed, in length per unit of time.
    flat : Tensor, shape (m, d, n stride)
        All samples, those of a recording from a multiple of `stride` on.
    """

    def __init__(self, tasks: Sequence[Task], device: torch.device) -> None:
        frames = [Frame.of(task) for task in tasks]
        self.n_models, self.n_recordings = len(tasks), tasks[0].n_recordings
        self.n_dims, self.cyclic, self.device = tasks[0].n_dims, tasks[0].cyclic, device
        shown = [task.scaled(frame) for task, frame in zip(tasks, frames, strict=True)]
        lengths = np.array([[len(p) for p in paths] for paths in shown])
        self.stride = int(lengths.max())
        padded = np.zeros((*lengths.shape, self.stride, self.n_dims), dtype=np.float32)
        for m, paths in enumerate(shown):
            for i, path in enumerate(paths):
                padded[m, i, : len(path)] = path
        speeds = [[task.peak_speed(frame)] for task, frame in zip(tasks, frames, strict=True)]

        def tensor(array: object) -> Tensor:
            return torch.as_tensor(np.asarray(array, dtype=np.float32), device=device)

        self.lengths = torch.as_tensor(lengths, device=device)
        self.steps = tensor([t.steps(f) for t, f in zip(tasks, frames, strict=True)])
        self.peak_speed, self.frame = tensor(speeds), tensor([f.matrix for f in frames])
        self.flat = tensor(np.moveaxis(padded, 3, 1)).flatten(2).contiguous()
        low = tensor([np.concatenate(paths).min(0) for paths in shown])[..., None]
        high = tensor([np.concatenate(paths).max(0) for paths in shown])[..., None]
        self.centre, self.half = (low + high) / 2, (high - low) / 2
        self.context = None
        if tasks[0].n_context:
            self.context = tensor([_contexts(task) for task in tasks])

    def at(self, recordings: Tensor, samples: Tensor) -> Tensor:
        """Positions, shape (m, d, q), of samples (m, q) of recordings (m, q)."""
        index = recordings * self.stride + samples
        return torch.gather(self.flat, 2, index[:, None].expand(-1, self.n_dims, -1))

    def context_of(self, recordings: Tensor) -> Tensor | None:
        """Contexts, shape (m, k, q), of recordings (m, q)."""
        if self.context is None:
            return None
        return torch.gather(
            self.context, 2, recordings[:, None].expand(-1, self.context.shape[1], -1)
        )


def _contexts(task: Task) -> FloatArray:
    """Return the context of each recording, shape (k, n)."""
    contexts: Sequence[FloatArray] = [] if task.contexts is None else list(task.contexts)
    rows = [np.tile(c, (len(m), 1)) for m, c in zip(task.motions, contexts, strict=True)]
    return np.concatenate(rows).T


class Draws:
    """Uniform numbers for a step, a model at a time, so that none depends on its neighbours."""

    def __init__(
        self, rngs: Sequence[np.random.Generator], per_step: int, device: torch.device
    ) -> None:
        self._rngs, self._per_step, self._device = rngs, per_step, device
        self._step, self._used = DRAWN_AT_ONCE, 0
        self._numbers = torch.empty(0)

    def new_step(self) -> None:
        """Go on to the next step's numbers."""
        self._step, self._used = self._step + 1, 0
        if self._step >= DRAWN_AT_ONCE:
            shape = (DRAWN_AT_ONCE, self._per_step)
            numbers: NDArray[np.float32] = np.stack(
                [rng.random(shape, dtype=np.float32) for rng in self._rngs], axis=1
            )
            self._numbers = torch.as_tensor(numbers, device=self._device)
            self._step = 0

    def uniform(self, *shape: int) -> Tensor:
        """Numbers in [0, 1) of shape (m, *shape), not used before."""
        size = math.prod(shape)
        taken = self._numbers[self._step][:, self._used : self._used + size]
        if taken.shape[1] < size:
            raise RuntimeError(f"Expected at most {self._per_step} numbers a step.")
        self._used += size
        return taken.view(-1, *shape)
