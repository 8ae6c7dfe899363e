"""Whether the motions of a point-to-point system end at its goal, from where, and how soon.

The definitions are those of the stability table in METRICS.md. Everything here works on rollouts
that were made elsewhere, shape (n, T, d): n starts, T samples at one dt, the start the first.
The box is the demonstrations' bounding box, with the corners ``low`` and ``high`` of shape (d,).
A rollout with a sample that is not finite has diverged and did not converge; nothing warns.

Fractions are the means of the boolean functions, through ``fraction``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from iflow_gym.metrics._validation import (
    BoolArray,
    FloatArray,
    as_box,
    as_point,
    as_rollouts,
    finite_throughout,
    positive,
)

START_BOX_FACTOR = 2.0
"""The box of the starts has sides of twice the demonstrations': half a side more on every end."""
DIVERGENCE_BOX_FACTOR = 10.0
"""A rollout that leaves the box enlarged to sides of ten times has diverged."""
STARTS_PER_AXIS = {2: 16, 3: 7}
"""Starts along each axis of the grid, by dimension: 256 in 2-D, 343 in 3-D."""
TOLERANCE = 0.02
"""Tolerance of convergence, as a fraction of the box's diagonal."""
HORIZON = 5.0
"""Length of a rollout, in durations of the longest demonstration."""
FINAL_FRACTION = 0.05
"""Part of the horizon at its end for whose whole a rollout must stay where it is said to be."""
STOPPED_RADIUS = 0.25
"""A rollout has stopped if its final part stays this close to its end, in tolerances."""
PERTURBATION_TIME = 0.4
"""When the push comes, as a fraction of the demonstration's samples."""
PERTURBATION_SIZE = 0.25
"""Length of the push, as a fraction of the box's diagonal."""
LYAPUNOV_STATES = 10_000
"""States at which the Lyapunov function's derivative is tested."""


def enlarged_box(low: ArrayLike, high: ArrayLike, factor: float) -> tuple[FloatArray, FloatArray]:
    """Box with the same centre and sides of ``factor`` times the length.

    Parameters
    ----------
    low, high
        Corners of the box, shape (d,), in units of length.
    factor
        Of each side's length: 2 adds half a side on every end.

    Returns
    -------
    tuple of two arrays of shape (d,)
        Corners of the enlarged box.

    Raises
    ------
    ValueError
        If the box has a side without length, or the factor is not positive.
    """
    lower, upper = as_box(low, high)
    growth = 0.5 * (positive(factor, "factor") - 1.0) * (upper - lower)
    return lower - growth, upper + growth


def box_diagonal(low: ArrayLike, high: ArrayLike) -> float:
    """Length of the box's diagonal, the scale of every tolerance.

    Parameters
    ----------
    low, high
        Corners of the demonstrations' bounding box, shape (d,), in units of length.

    Returns
    -------
    float
        In units of length.

    Raises
    ------
    ValueError
        If the box has a side without length.
    """
    lower, upper = as_box(low, high)
    return float(np.linalg.norm(upper - lower))


def convergence_tolerance(low: ArrayLike, high: ArrayLike) -> float:
    """Distance from the goal that counts as being there: 2 % of the box's diagonal.

    Parameters
    ----------
    low, high
        Corners of the demonstrations' bounding box, shape (d,), in units of length.

    Returns
    -------
    float
        In units of length.

    Raises
    ------
    ValueError
        If the box has a side without length.
    """
    return TOLERANCE * box_diagonal(low, high)


def start_grid(low: ArrayLike, high: ArrayLike, n_per_axis: int | None = None) -> FloatArray:
    """Lay the fixed grid of starts: 16 x 16 in 2-D, 7 x 7 x 7 in 3-D.

    METRICS.md enlarges the box "by half of each side", which is half a side on every end: the grid
    spans, faces included, the box with the same centre and sides of twice the length.

    Parameters
    ----------
    low, high
        Corners of the demonstrations' bounding box, shape (d,), in units of length. The enlarging
        is done here.
    n_per_axis
        Starts along each axis, at least 2; None takes the suite's own.

    Returns
    -------
    array of shape (n_per_axis**d, d)
        Starts, the last axis fastest.

    Raises
    ------
    ValueError
        If the box has a side without length, or if the suite fixes no grid for this dimension.
    """
    lower, upper = enlarged_box(low, high, START_BOX_FACTOR)
    d = lower.size
    if n_per_axis is None:
        if d not in STARTS_PER_AXIS:
            raise ValueError(f"Expected a box in 2-D or 3-D, got {d}-D: pass n_per_axis")
        n_per_axis = STARTS_PER_AXIS[d]
    if n_per_axis < 2:
        raise ValueError(f"Expected n_per_axis of at least 2, got {n_per_axis}")
    axes = np.linspace(lower, upper, n_per_axis, axis=1)
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, d)


def fraction(outcomes: ArrayLike) -> float:
    """Fraction of the rollouts for which something holds.

    Parameters
    ----------
    outcomes
        Booleans, shape (n,), as ``converged`` and ``diverged`` return them. The fraction of
        ``converged`` is also `perturbation_recovery`, where the rollouts are the pushed ones.

    Returns
    -------
    float
        In [0, 1].

    Raises
    ------
    ValueError
        If there are no outcomes, or they are not booleans.
    """
    values = np.asarray(outcomes)
    if values.dtype != np.bool_ or values.ndim != 1 or values.size == 0:
        raise ValueError(
            f"Expected booleans of shape (n,), got {values.dtype} of shape {values.shape}"
        )
    return float(values.mean())


def converged(trajectories: ArrayLike, goal: ArrayLike, tolerance: float) -> BoolArray:
    r"""Which rollouts are within the tolerance of the goal for the whole last 5 % of the horizon.

    .. math:: \lVert x_t - x^* \rVert \le \mathrm{tolerance}
        \quad \text{for all } t \ge T - \lceil 0.05\,T \rceil

    Parameters
    ----------
    trajectories
        Rollouts, shape (n, T, d), in units of length.
    goal
        x*, shape (d,).
    tolerance
        In units of length; ``convergence_tolerance`` gives the suite's.

    Returns
    -------
    array of shape (n,)
        False as well for a rollout with a sample anywhere that is not finite.

    Raises
    ------
    ValueError
        If shapes do not fit, or the tolerance is not positive.
    """
    rollouts = as_rollouts(trajectories)
    distance = _distance_to_goal(rollouts, goal)
    return _converged(rollouts, distance, positive(tolerance, "tolerance"))


def settling_time(
    trajectories: ArrayLike, goal: ArrayLike, tolerance: float, dt: float, mean_duration: float
) -> float:
    r"""Median time to enter the tolerance for good, in mean durations of the demonstrations.

    .. math:: \operatorname{median}_i \; \min \{ t\,dt : \lVert x^i_s - x^* \rVert
        \le \mathrm{tolerance} \text{ for all } s \ge t \} \;/\; \mathrm{mean\_duration}

    Parameters
    ----------
    trajectories
        Rollouts, shape (n, T, d), in units of length.
    goal
        x*, shape (d,).
    tolerance
        In units of length; ``convergence_tolerance`` gives the suite's.
    dt
        Time between samples, in s.
    mean_duration
        Mean duration of the demonstrations, in s.

    Returns
    -------
    float
        In mean durations. A start inside the tolerance that stays there takes 0. A rollout that
        does not settle counts as infinity, so that the median is infinite unless more than half of
        them do. Settled is what ``converged`` says: a rollout that comes in later than the last
        5 % of the horizon may be passing through.

    Raises
    ------
    ValueError
        If shapes do not fit, or tolerance, dt or duration are not positive.
    """
    rollouts = as_rollouts(trajectories)
    tolerance = positive(tolerance, "tolerance")
    unit = positive(dt, "dt") / positive(mean_duration, "mean_duration")
    distance = _distance_to_goal(rollouts, goal)
    inside_from_the_end = (distance <= tolerance)[:, ::-1]
    n_inside = np.logical_and.accumulate(inside_from_the_end, axis=1).sum(axis=1)
    times = (rollouts.shape[1] - n_inside) * unit
    return float(np.median(np.where(_converged(rollouts, distance, tolerance), times, np.inf)))


def spurious_attractors(trajectories: ArrayLike, goal: ArrayLike, tolerance: float) -> int:
    """Count the clusters of end states outside the tolerance that have stopped moving.

    - Stopped: every sample of the last 5 % of the horizon is within a quarter of the tolerance
      (0.5 % of the box's diagonal) of the last one. With a horizon of five durations this takes a
      speed of about a hundredth of the demonstrations', and lets a controller chatter a little.
    - Cluster: end states that are connected by hops of at most one tolerance (single linkage), so
      that a line of equilibria is one attractor. One end state alone is a cluster too.

    Parameters
    ----------
    trajectories
        Rollouts, shape (n, T, d), in units of length, with T > 20, so that the last 5 % hold two
        samples.
    goal
        x*, shape (d,).
    tolerance
        In units of length; ``convergence_tolerance`` gives the suite's.

    Returns
    -------
    int
        Rollouts that still move at the end, or are not finite, are in no cluster.

    Raises
    ------
    ValueError
        If shapes do not fit, the tolerance is not positive, or T is below 21.

    Notes
    -----
    A state that is held at the bounds of its environment has stopped, and counts: leave out the
    rollouts that `diverged`.
    """
    rollouts = as_rollouts(trajectories)
    tolerance = positive(tolerance, "tolerance")
    n_samples = rollouts.shape[1]
    if _n_final(n_samples) < 2:
        raise ValueError(
            f"Expected trajectories of at least 21 samples, to see whether they move in the last "
            f"5 %, got {n_samples}"
        )
    away = _distance_to_goal(rollouts, goal)[:, -1] > tolerance
    candidates = rollouts[away & finite_throughout(rollouts)]
    ends = candidates[:, -1]
    with np.errstate(over="ignore"):
        drift = np.linalg.norm(candidates[:, -_n_final(n_samples) :] - ends[:, None], axis=-1).max(
            axis=-1
        )
    ends = ends[drift <= STOPPED_RADIUS * tolerance]
    if len(ends) == 0:
        return 0
    return int(connected_components(cdist(ends, ends) <= tolerance, directed=False)[0])


def diverged(trajectories: ArrayLike, low: ArrayLike, high: ArrayLike) -> BoolArray:
    """Which rollouts leave the box enlarged ten times, at any time, or are not finite.

    Parameters
    ----------
    trajectories
        Rollouts, shape (n, T, d), in units of length.
    low, high
        Corners of the demonstrations' bounding box, shape (d,). The enlarging, to sides of ten
        times the length about the same centre, is done here.

    Returns
    -------
    array of shape (n,)
        A rollout that comes back has diverged all the same.

    Raises
    ------
    ValueError
        If shapes do not fit, or the box has a side without length.
    """
    rollouts = as_rollouts(trajectories)
    lower, upper = enlarged_box(low, high, DIVERGENCE_BOX_FACTOR)
    as_point(lower, rollouts.shape[-1], "low")
    inside = (rollouts >= lower) & (rollouts <= upper)  # nan compares false
    return ~np.asarray(inside.all(axis=(1, 2)))


def uniform_states(
    low: ArrayLike, high: ArrayLike, n: int = LYAPUNOV_STATES, *, rng: np.random.Generator
) -> FloatArray:
    """States of `lyapunov_violation`, drawn uniformly from the box that the starts span.

    Parameters
    ----------
    low, high
        Corners of the demonstrations' bounding box, shape (d,), in units of length. The enlarging
        is done here, as in ``start_grid``.
    n
        Number of states.
    rng
        Source of the states: the same seed gives every method the same states.

    Returns
    -------
    array of shape (n, d)
        States, in units of length.

    Raises
    ------
    ValueError
        If the box has a side without length, or n is below 1.
    """
    lower, upper = enlarged_box(low, high, START_BOX_FACTOR)
    if n < 1:
        raise ValueError(f"Expected n of at least 1, got {n}")
    return rng.uniform(lower, upper, size=(n, lower.size))


def lyapunov_violation(
    derivatives: ArrayLike, states: ArrayLike, goal: ArrayLike | None = None
) -> float:
    r"""Fraction of states where the Lyapunov function does not decrease.

    .. math:: \frac{1}{n} \#\{ i : \dot V(x_i) = \nabla V(x_i)^\top f(x_i) \ge 0 \}

    Parameters
    ----------
    derivatives
        dV/dt along the system at the states, shape (n,), in units of V per second.
    states
        States x_i, shape (n, d), in units of length; ``uniform_states`` draws the suite's.
    goal
        x*, shape (d,). dV/dt is zero there by definition, so that a state that is exactly x* is
        left out, of the numerator and of n. None for a motion that repeats.

    Returns
    -------
    float
        In [0, 1]. A derivative that is nan is a violation: it is not below zero.

    Raises
    ------
    ValueError
        If shapes do not fit, or no state but the goal is left.
    """
    points = np.asarray(states, dtype=np.float64)
    slopes = np.asarray(derivatives, dtype=np.float64)
    if points.ndim != 2 or slopes.shape != points.shape[:1]:
        raise ValueError(
            f"Expected derivatives of shape (n,) at states of shape (n, d), got {slopes.shape} "
            f"and {points.shape}"
        )
    if goal is None:
        return fraction(~(slopes < 0))
    elsewhere = (points != as_point(goal, points.shape[1], "goal")).any(axis=1)
    if not elsewhere.any():
        raise ValueError(f"Expected states other than the goal, got {len(points)} at the goal")
    return fraction(~(slopes[elsewhere] < 0))


def _n_final(n_samples: int) -> int:
    """Count the samples in the last 5 %: ceil(0.05 T), which is at least one."""
    return int(np.ceil(FINAL_FRACTION * n_samples))


def _distance_to_goal(rollouts: FloatArray, goal: ArrayLike) -> FloatArray:
    """Distance of every sample, shape (n, T); nan or infinity where it is not finite."""
    centre = as_point(goal, rollouts.shape[-1], "goal")
    with np.errstate(over="ignore", invalid="ignore"):
        offset = rollouts - centre
        result: FloatArray = np.sqrt(np.einsum("nti,nti->nt", offset, offset))
    return result


def _converged(rollouts: FloatArray, distance: FloatArray, tolerance: float) -> BoolArray:
    final = distance[:, -_n_final(rollouts.shape[1]) :]
    return np.asarray((final <= tolerance).all(axis=1)) & finite_throughout(rollouts)
