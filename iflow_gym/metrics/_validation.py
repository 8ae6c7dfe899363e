"""Checks of what enters the metrics: shapes, lengths and finiteness, each said once.

Every metric works on a batch of pairs, shape (B, T, d); a single pair of shape (T, d) is a batch of
one whose score comes back as a float.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray: TypeAlias = NDArray[np.float64]
BoolArray: TypeAlias = NDArray[np.bool_]
Scores: TypeAlias = float | FloatArray
"""A float for one pair, shape (B,) for a batch; ``float(score)`` and ``np.asarray`` take both."""


@dataclass(frozen=True)
class Pairs:
    """A validated batch of (demonstration, reproduction) pairs."""

    demonstration: FloatArray
    """Finite, shape (B, T, d)."""
    reproduction: FloatArray
    """Shape (B, S, d); a reproduction that is not finite everywhere is all zeros here."""
    finite: BoolArray
    """Which reproductions are finite everywhere, shape (B,)."""
    single: bool
    """Whether one pair of shape (T, d) came, rather than a batch."""

    def scores(self, values: FloatArray) -> Scores:
        """Return the values, shape (B,), with infinity for a reproduction that ran away.

        A value that overflows float64 on the way is infinite as well, never nan.
        """
        values = np.where(self.finite & np.isfinite(values), values, np.inf)
        return float(values[0]) if self.single else values


def as_pairs(
    demonstration: ArrayLike,
    reproduction: ArrayLike,
    *,
    quantity: str = "positions",
    dimension: int | None = None,
    hint: str = "",
    equal_lengths: bool = True,
    min_samples: int = 1,
) -> Pairs:
    """Validate two trajectories, or two batches of them, and bring them to shape (B, T, d).

    Parameters
    ----------
    demonstration, reproduction
        Shape (T, d) or (B, T, d); the reproduction may have S samples where lengths may differ.
    quantity
        What the arrays hold, for the errors: "positions" or "velocities".
    dimension
        The one d that is allowed, or None for any; ``hint`` then says what to use instead.
    equal_lengths
        Whether T and S must be equal.
    min_samples
        The least T that the metric is defined for.

    Raises
    ------
    ValueError
        If the shapes do not fit, or the demonstration is not finite everywhere.
    """
    x = np.asarray(demonstration, dtype=np.float64)
    y = np.asarray(reproduction, dtype=np.float64)
    d = "d" if dimension is None else str(dimension)
    for array in (x, y):
        wrong_dimension = dimension is not None and array.shape[-1:] != (dimension,)
        if array.ndim not in (2, 3) or 0 in array.shape or wrong_dimension:
            raise ValueError(
                f"Expected {quantity} of shape (T, {d}) or (B, T, {d}), got {array.shape}"
                + (f": {hint}" if hint and wrong_dimension and array.ndim in (2, 3) else "")
            )
    if x.ndim != y.ndim or x.shape[-1] != y.shape[-1] or x.shape[:-2] != y.shape[:-2]:
        raise ValueError(
            f"Expected demonstration and reproduction with the same batch and dimension, "
            f"got {x.shape} and {y.shape}"
        )
    if equal_lengths and x.shape != y.shape:
        raise ValueError(
            f"Expected as many samples in the reproduction as in the demonstration, got "
            f"{x.shape} and {y.shape}: roll out for {x.shape[-2]} samples, or use frechet or dtw"
        )
    if min(x.shape[-2], y.shape[-2]) < min_samples:
        raise ValueError(
            f"Expected at least {min_samples} samples, got {x.shape[-2]} and {y.shape[-2]}"
        )
    if not np.isfinite(x).all():
        raise ValueError(
            f"Expected a demonstration of finite {quantity}, got nan or infinity: the arguments "
            "are (demonstration, reproduction), in this order"
        )
    single = x.ndim == 2
    if single:
        x, y = x[None], y[None]
    finite = finite_throughout(y)
    if not finite.all():
        y = np.where(finite[:, None, None], y, 0.0)
    return Pairs(x, y, finite, single)


def finite_throughout(trajectories: FloatArray) -> BoolArray:
    """Which trajectories of a batch, shape (n, T, d), are finite at every sample, shape (n,)."""
    return np.asarray(np.isfinite(trajectories).all(axis=(1, 2)))


def as_rollouts(trajectories: ArrayLike) -> FloatArray:
    """Validate rollouts of shape (n, T, d); samples may be nan or infinite.

    Raises
    ------
    ValueError
        If the shape is another, or empty.
    """
    rollouts = np.asarray(trajectories, dtype=np.float64)
    if rollouts.ndim != 3 or 0 in rollouts.shape:
        raise ValueError(f"Expected trajectories of shape (n, T, d), got {rollouts.shape}")
    return rollouts


def as_point(point: ArrayLike, dimension: int, name: str) -> FloatArray:
    """Validate a finite point of shape (dimension,).

    Raises
    ------
    ValueError
        If the shape is another, or a coordinate is not finite.
    """
    value = np.asarray(point, dtype=np.float64)
    if value.shape != (dimension,) or not np.isfinite(value).all():
        raise ValueError(f"Expected a finite {name} of shape ({dimension},), got {point!r}")
    return value


def as_box(low: ArrayLike, high: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Validate the corners of a box, each of shape (d,), with low < high on every axis.

    Raises
    ------
    ValueError
        If the shapes differ, a bound is not finite, or a side has no length.
    """
    lower = np.asarray(low, dtype=np.float64)
    upper = np.asarray(high, dtype=np.float64)
    if lower.ndim != 1 or lower.size == 0 or lower.shape != upper.shape:
        raise ValueError(
            f"Expected the corners of a box, low and high, of shape (d,), got {lower.shape} "
            f"and {upper.shape}"
        )
    if not (np.isfinite(lower).all() and np.isfinite(upper).all() and (lower < upper).all()):
        raise ValueError(
            f"Expected finite low < high on every axis, got low={lower.tolist()} and "
            f"high={upper.tolist()}: pad a side that has no length"
        )
    return lower, upper


def positive(value: Any, name: str) -> float:
    """Validate a finite number above zero.

    Raises
    ------
    ValueError
        If it is not.
    """
    number = float(value)
    if not (np.isfinite(number) and number > 0):
        raise ValueError(f"Expected a finite {name} > 0, got {value!r}")
    return number
