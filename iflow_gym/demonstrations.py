"""Demonstrations: recordings of one motion, the data that every method learns from.

A set holds n recordings; recording i has T_i samples in R^d at a constant sample time dt_i.
Either the recordings end at one goal (a point-to-point motion) or they repeat with a period
(a limit cycle).
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

PROTOCOLS = ("reproduction", "generalisation")
"""The splits that scores are reported on."""

GOAL_TOLERANCE = 0.02
"""Ends may lie this far from the goal, as a fraction of the bounding box's diagonal."""

LEAST_ROUND = 4
"""Samples that a round has at least."""

LEAST_ROUNDS = 0.95
"""Rounds that the longest recording of a motion that repeats has at least."""

UNEVEN_TOLERANCE = 1e-3
"""Steps in `times` may differ from their mean by this fraction of it."""


class Split(NamedTuple):
    """What to fit on and what to score on; the two may be the same set."""

    fit: Demonstrations
    score: Demonstrations


class BoundingBox(NamedTuple):
    """An axis-aligned box, each corner of shape (d,)."""

    low: FloatArray
    high: FloatArray

    @property
    def diagonal(self) -> float:
        """Length of the box's diagonal."""
        return float(np.linalg.norm(self.high - self.low))


@dataclass(frozen=True, eq=False)
class Demonstrations:
    """Recordings of one motion. Immutable; made by `from_arrays`, which checks its input.

    Attributes
    ----------
    positions, velocities : tuples of read-only float64 arrays, shape (T_i, d)
        Samples of recording i, in `length_unit` and `length_unit`/s.
    dt : tuple of float
        Sample time of each recording, in seconds.
    goal : array, shape (d,), or None
        Where a point-to-point motion ends; None for a cycle.
    period : float or None
        Duration of a round in seconds; None for a point-to-point motion.
    held_out : int
        So many of the last recordings are never fitted on, by any protocol.
    """

    positions: tuple[FloatArray, ...]
    velocities: tuple[FloatArray, ...]
    dt: tuple[float, ...]
    goal: FloatArray | None
    period: float | None = None
    name: str = "unnamed"
    length_unit: str = "m"
    source: str = "arrays"
    held_out: int = 0

    @classmethod
    def from_arrays(
        cls,
        positions: Sequence[ArrayLike],
        *,
        dt: float | Sequence[float] | None = None,
        times: Sequence[ArrayLike] | None = None,
        velocities: Sequence[ArrayLike] | None = None,
        goal: ArrayLike | None = None,
        goal_tolerance: float | None = None,
        period: float | None = None,
        resample: bool = False,
        name: str = "unnamed",
        length_unit: str = "m",
        source: str = "arrays",
        held_out: int = 0,
    ) -> Demonstrations:
        """Check recordings and make a set of demonstrations of them.

        Parameters
        ----------
        positions : sequence of n arrays, shape (T_i, d)
            The recordings; their lengths may differ, T_i >= 3.
        dt : float or sequence of n floats, seconds
            Sample time, one for all or one a recording. Give either this or `times`.
        times : sequence of n arrays, shape (T_i,), seconds
            Time stamps, increasing. They must be evenly spaced unless `resample` is set.
        velocities : sequence of n arrays, shape (T_i, d), optional
            Recorded velocities. Where absent they are estimated from the positions by central
            differences, one-sided at both ends.
        goal : array, shape (d,), optional
            Where the motion ends. By default the mean of the recordings' last samples.
        goal_tolerance : float, in `length_unit`, optional
            How far a recording may end from the goal; by default 2 % of the diagonal of the
            recordings' bounding box.
        period : float, seconds, optional
            Of a motion that goes round and round; there is no goal then. The longest recording
            lasts a round at least, and a round at least 4 samples.
        resample : bool
            Interpolate recordings with uneven `times` linearly on an even grid of as many
            samples.
        held_out : int
            So many of the last recordings are kept to test on, see `split`; fewer than there are.

        Raises
        ------
        TypeError, ValueError
            If an array is not numeric, not finite, too short, or of another shape than the
            others; if times do not increase or dt is not positive; if the ends do not meet at
            one goal. The message says what was expected, what came, and what to do.
        """
        points = [_as_samples(p, f"positions[{i}]") for i, p in enumerate(_several(positions))]
        _check_same_dimension(points)
        steps = _sample_times(points, dt, times, resample)
        speeds = None
        if velocities is not None:
            speeds = [
                _as_samples(v, f"velocities[{i}]") for i, v in enumerate(_several(velocities))
            ]
            _check_same_shapes(points, speeds)
        if times is not None and resample:
            points = [_resampled(p, t) for p, t in zip(points, times, strict=True)]
            if speeds is not None:
                speeds = [_resampled(v, t) for v, t in zip(speeds, times, strict=True)]
        if speeds is None:
            speeds = [np.gradient(p, h, axis=0) for p, h in zip(points, steps, strict=True)]
        if not any(v.any() for v in speeds):
            raise ValueError(
                "Expected recordings of a motion, got samples that are all the same."
                if velocities is None
                else "Expected velocities of a motion, got zeros throughout: leave velocities out "
                "to have them estimated."
            )
        target: FloatArray | None = None
        if period is None:
            target = _meeting_point(points, goal, goal_tolerance)
        elif goal is not None:
            raise ValueError(
                "Expected either a goal (a motion that ends) or a period (a motion that repeats), "
                "got both: drop one."
            )
        elif not (np.isfinite(period) and period > 0):
            raise ValueError(f"Expected a positive period in seconds, got {period}.")
        else:
            _check_period(period, points, steps)
        if type(held_out) is not int or not 0 <= held_out < len(points):
            raise ValueError(
                f"Expected held_out to be a whole number from 0 to {len(points) - 1}, one less "
                f"than there are recordings, got {held_out!r}."
            )
        return cls(
            positions=tuple(_frozen(p) for p in points),
            velocities=tuple(_frozen(v) for v in speeds),
            dt=tuple(steps),
            goal=None if target is None else _frozen(target),
            period=period,
            name=name,
            length_unit=length_unit,
            source=source,
            held_out=held_out,
        )

    def __len__(self) -> int:
        return len(self.positions)

    def __repr__(self) -> str:
        lengths = sorted({len(p) for p in self.positions})
        samples = f"{lengths[0]}" if len(lengths) == 1 else f"{lengths[0]}-{lengths[-1]}"
        return f"Demonstrations({self.name!r}, n={len(self)}, samples={samples}, d={self.n_dims})"

    @property
    def n_dims(self) -> int:
        """Dimension d of a sample."""
        return int(self.positions[0].shape[1])

    @property
    def attractor(self) -> FloatArray:
        """The goal, shape (d,); raises for a cycle, which has none."""
        if self.goal is None:
            raise ValueError(
                f"{self.name!r} repeats with a period of {self.period} s and has no goal; "
                "a point-to-point motion was expected."
            )
        return self.goal

    @cached_property
    def centre(self) -> FloatArray:
        """The goal, shape (d,); of a motion that repeats, the mean of its samples."""
        if self.goal is not None:
            return self.goal
        return _frozen(np.concatenate(self.positions).mean(axis=0))

    @property
    def starts(self) -> FloatArray:
        """First sample of each recording, shape (n, d)."""
        first: FloatArray = np.stack([p[0] for p in self.positions])
        return first

    @property
    def durations(self) -> FloatArray:
        """Time from the first to the last sample of each recording in seconds, shape (n,)."""
        steps = np.array([len(p) - 1 for p in self.positions], dtype=np.float64)
        durations: FloatArray = steps * np.array(self.dt)
        return durations

    @property
    def mean_dt(self) -> float:
        """Mean sample time in seconds."""
        return float(np.mean(self.dt))

    @cached_property
    def bounding_box(self) -> BoundingBox:
        """The smallest axis-aligned box around every sample."""
        samples = np.concatenate(self.positions)
        return BoundingBox(_frozen(samples.min(axis=0)), _frozen(samples.max(axis=0)))

    @cached_property
    def peak_speed(self) -> float:
        """Largest norm of a velocity, in `length_unit`/s."""
        return float(max(np.linalg.norm(v, axis=1).max() for v in self.velocities))

    def times(self, index: int) -> FloatArray:
        """Time stamps of recording `index` in seconds from its first sample, shape (T_i,)."""
        stamps: FloatArray = (
            np.arange(len(self.positions[index]), dtype=np.float64) * self.dt[index]
        )
        return stamps

    @cached_property
    def sha256(self) -> str:
        """Hash of the numbers themselves, the same on every platform."""
        digest = hashlib.sha256()
        for p, v, h in zip(self.positions, self.velocities, self.dt, strict=True):
            digest.update(np.asarray([*p.shape, h], dtype="<f8").tobytes())
            digest.update(np.ascontiguousarray(p, dtype="<f8").tobytes())
            digest.update(np.ascontiguousarray(v, dtype="<f8").tobytes())
        end = [self.period] if self.goal is None else self.goal
        digest.update(np.asarray(end, dtype="<f8").tobytes())
        if self.held_out:
            digest.update(np.asarray(self.held_out, dtype="<i8").tobytes())
        return digest.hexdigest()

    def subset(self, indices: Iterable[int]) -> Demonstrations:
        """Return the recordings at `indices`, with the same goal or period; none is held out."""
        chosen = [range(len(self))[i] for i in indices]
        if not chosen:
            raise ValueError("Expected at least one index of a recording, got none.")
        return Demonstrations(
            positions=tuple(self.positions[i] for i in chosen),
            velocities=tuple(self.velocities[i] for i in chosen),
            dt=tuple(self.dt[i] for i in chosen),
            goal=self.goal,
            period=self.period,
            name=self.name,
            length_unit=self.length_unit,
            source=self.source,
        )

    @property
    def protocols(self) -> tuple[str, ...]:
        """Names of the splits that the set has: one recording leaves none to hold out."""
        return PROTOCOLS if len(self) > 1 else PROTOCOLS[:1]

    @cached_property
    def shown(self) -> Demonstrations:
        """The recordings that are not held out."""
        return self.subset(range(len(self) - self.held_out)) if self.held_out else self

    def split(self, protocol: str = "reproduction") -> Split:
        """Return what to fit on and what to score on.

        ``"reproduction"`` fits and scores on every recording; ``"generalisation"`` fits on the
        first four sevenths (rounded; 1-4 of LASA's 7) and scores on the rest. A set with recordings
        held out is fitted on the others by both, and ``"generalisation"`` scores on those held out.
        """
        if protocol not in PROTOCOLS:
            raise ValueError(f"Expected a protocol of {PROTOCOLS}, got {protocol!r}.")
        shown = self.shown
        if protocol == "reproduction":
            return Split(shown, shown)
        if self.held_out:
            return Split(shown, self.subset(range(len(shown), len(self))))
        if len(self) < 2:
            raise ValueError(
                f"Expected at least 2 recordings for the generalisation protocol, got {len(self)}: "
                "record more, or use the reproduction protocol."
            )
        n_fit = min(max(round(len(self) * 4 / 7), 1), len(self) - 1)
        fit = self.subset(range(n_fit))
        return Split(fit._with_own_period(), self.subset(range(n_fit, len(self))))

    def _with_own_period(self) -> Demonstrations:
        """Return the set with the period of its own recordings, where they show one.

        The period of a whole set knows the tempo of the recordings that are held out.
        """
        if self.period is None:
            return self
        from iflow_gym.rounds import period_of

        try:
            found = [period_of(p, h) for p, h in zip(self.positions, self.dt, strict=True)]
        except ValueError:  # too short to show a round
            return self
        return replace(self, period=float(np.mean(found)))


def _several(arrays: Sequence[ArrayLike]) -> Sequence[ArrayLike]:
    """Reject one bare array, which would be read as T recordings of one sample each."""
    shape = getattr(arrays, "shape", ())
    if len(shape) == 2:
        raise ValueError(
            f"Expected a sequence of recordings, got one array of shape {shape}: "
            "put it into a list, [array]."
        )
    if len(arrays) == 0:
        raise ValueError("Expected at least one recording, got none.")
    return arrays


def _as_samples(array: ArrayLike, label: str) -> FloatArray:
    try:
        samples = np.array(array, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise TypeError(f"Expected {label} to be an array of numbers, got {error}.") from error
    if samples.ndim != 2 or samples.shape[1] == 0:
        raise ValueError(
            f"Expected {label} of shape (samples, dimensions), got {samples.shape}"
            + (
                "; a 1-D motion has shape (samples, 1): use array[:, None]."
                if samples.ndim == 1
                else "."
            )
        )
    if len(samples) < 3:
        raise ValueError(
            f"Expected {label} to have at least 3 samples, got {len(samples)}: "
            "a recording this short has no velocity."
        )
    bad = ~np.isfinite(samples).all(axis=1)
    if bad.any():
        raise ValueError(
            f"Expected {label} to be finite, got {int(bad.sum())} samples with NaN or infinity, "
            f"the first at index {int(bad.argmax())}: remove or interpolate them."
        )
    return samples


def _check_same_dimension(points: list[FloatArray]) -> None:
    dims = [p.shape[1] for p in points]
    if len(set(dims)) > 1:
        raise ValueError(f"Expected recordings of one dimension, got dimensions {dims}.")


def _check_same_shapes(points: list[FloatArray], speeds: list[FloatArray]) -> None:
    expected, came = [p.shape for p in points], [v.shape for v in speeds]
    if expected != came:
        raise ValueError(
            f"Expected velocities of the positions' shapes {expected}, got {came}: "
            "leave velocities out to have them estimated."
        )


def _sample_times(
    points: list[FloatArray],
    dt: float | Sequence[float] | None,
    times: Sequence[ArrayLike] | None,
    resample: bool,
) -> list[float]:
    if (dt is None) == (times is None):
        raise ValueError(
            "Expected either dt (seconds a sample) or times (a time stamp a sample), got "
            + ("neither." if dt is None else "both.")
        )
    if times is not None:
        if len(times) != len(points):
            raise ValueError(
                f"Expected times for {len(points)} recordings, got {len(times)} arrays."
            )
        return [
            _even_step(t, len(p), resample, i)
            for i, (t, p) in enumerate(zip(times, points, strict=True))
        ]
    if resample:
        raise ValueError("Expected times with resample=True, got dt: samples are even already.")
    steps = np.atleast_1d(np.array(dt, dtype=np.float64))
    if steps.ndim != 1 or len(steps) not in (1, len(points)):
        raise ValueError(
            f"Expected one dt, or one for each of {len(points)} recordings, got {len(steps)}."
        )
    if not (np.isfinite(steps).all() and (steps > 0).all()):
        raise ValueError(f"Expected dt > 0 in seconds, got {dt}.")
    return [float(h) for h in np.broadcast_to(steps, len(points))]


def _even_step(times: ArrayLike, n_samples: int, resample: bool, index: int) -> float:
    t = np.asarray(times, dtype=np.float64)
    if t.shape != (n_samples,):
        raise ValueError(f"Expected times[{index}] of shape ({n_samples},), got {t.shape}.")
    steps = np.diff(t)
    if not np.isfinite(t).all() or (steps <= 0).any():
        at = int(np.argmax(~(steps > 0)))
        raise ValueError(
            f"Expected times[{index}] to increase, got {t[at]} then {t[at + 1]} at sample {at + 1}."
        )
    mean = float(t[-1] - t[0]) / (n_samples - 1)
    if not resample and np.abs(steps - mean).max() > UNEVEN_TOLERANCE * mean:
        raise ValueError(
            f"Expected times[{index}] to be evenly spaced, got steps from {steps.min():.6g} to "
            f"{steps.max():.6g} s: pass resample=True to interpolate on an even grid."
        )
    return mean


def _resampled(samples: FloatArray, times: ArrayLike) -> FloatArray:
    t = np.asarray(times, dtype=np.float64)
    even = np.linspace(t[0], t[-1], len(t))
    return np.stack([np.interp(even, t, column) for column in samples.T], axis=1)


def _meeting_point(
    points: list[FloatArray], goal: ArrayLike | None, tolerance: float | None
) -> FloatArray:
    ends = np.stack([p[-1] for p in points])
    target = ends.mean(axis=0) if goal is None else np.asarray(goal, dtype=np.float64)
    if target.shape != ends[0].shape or not np.isfinite(target).all():
        raise ValueError(f"Expected a finite goal of shape {ends[0].shape}, got {goal!r}.")
    samples = np.concatenate(points)
    diagonal = float(np.linalg.norm(samples.max(axis=0) - samples.min(axis=0)))
    if diagonal == 0:
        raise ValueError("Expected recordings of a motion, got samples that are all the same.")
    allowed = GOAL_TOLERANCE * diagonal if tolerance is None else float(tolerance)
    if not (np.isfinite(allowed) and allowed >= 0):
        raise ValueError(f"Expected a finite goal_tolerance >= 0, got {tolerance}.")
    distances = np.linalg.norm(ends - target, axis=1)
    if distances.max() > allowed:
        raise ValueError(
            f"Expected the recordings to end within {allowed:.4g} of the goal "
            f"{np.array2string(target, precision=4)}, got ends up to {distances.max():.4g} away "
            f"(recording {int(distances.argmax())}): shift them to end at one goal, pass "
            f"goal_tolerance={_rounded_up(distances.max())} to accept the spread, or period=... if "
            "the motion repeats."
        )
    return target


def _check_period(period: float, points: list[FloatArray], steps: list[float]) -> None:
    longest = max(len(p) * h for p, h in zip(points, steps, strict=True))
    if not LEAST_ROUND * max(steps) <= period <= longest / LEAST_ROUNDS:
        raise ValueError(
            f"Expected a period of {LEAST_ROUND} samples at least, {LEAST_ROUND * max(steps):g} s, "
            f"and at most what the longest recording lasts, {longest:g} s, got {period:g} s: check "
            "the units of period and dt (both seconds), or find it by iflow_gym.rounds.period_of."
        )


def _rounded_up(value: float) -> float:
    """Return the next number of two digits above a positive value: the advice has to suffice."""
    digit = 10.0 ** (np.floor(np.log10(value)) - 1)
    return float(f"{(np.floor(value / digit) + 1) * digit:.3g}")


def _frozen(array: FloatArray) -> FloatArray:
    array = np.array(array, dtype=np.float64)
    array.setflags(write=False)
    return array
