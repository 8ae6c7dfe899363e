"""What is scored of every motion: teacher-forced velocities, likelihoods, Lyapunov, cost."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import cycle
from typing import Any

import numpy as np

from iflow_gym import metrics
from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.evaluation.rollouts import bind, scored_box
from iflow_gym.system import DynamicalSystem

TRANSITIONS = (1, 10)
"""Samples k between the two ends of a transition whose likelihood is taken."""

TIMED_CALLS = 300
"""Calls of the policy that `step_us` is the median of."""

NUDGE = 1e-6
"""How far a state is moved along the field to see V change, as a fraction of the diagonal."""

Scores = dict[str, "float | None"]
PerDemonstration = dict[str, "list[float | None]"]


def teacher_forced(system: DynamicalSystem, scored: Demonstrations) -> PerDemonstration:
    """Return the scores of the field at the demonstrations' own samples."""
    predicted = [system.velocity(p) for p in scored.positions]
    functions: dict[str, Callable[[Any, Any], Any]] = {
        "seds_error": metrics.seds_error,
        "direction_error": metrics.direction_error,
        "velocity_rmse": metrics.velocity_rmse,
    }
    return {name: each(f, scored.velocities, predicted) for name, f in functions.items()}


def likelihood(system: DynamicalSystem, scored: Demonstrations) -> PerDemonstration:
    """Return the negative log-likelihood of the demonstrations' transitions, where there is one."""
    found: PerDemonstration = {}
    for k in TRANSITIONS:
        values = [_nll(system, p, k, h) for p, h in zip(scored.positions, scored.dt, strict=True)]
        if any(value is not None for value in values):
            found[f"nll_{k}"] = values
    return found


def _nll(system: DynamicalSystem, positions: FloatArray, k: int, dt: float) -> float | None:
    """Return the likelihood of transitions over k samples; None where there is none."""
    if len(positions) <= k:
        return None
    densities = system.log_prob(positions[:-k], positions[k:], k * dt)
    return None if densities is None else metrics.nll(densities, positions.shape[1])


def each(
    function: Callable[[Any, Any], Any], left: Sequence[FloatArray], right: Sequence[FloatArray]
) -> list[float | None]:
    """Return a metric of each pair, of all at once where the lengths allow."""
    if len({len(a) for a in left}) == 1:
        return np.asarray(function(np.stack(left), np.stack(right)), dtype=np.float64).tolist()  # type: ignore[no-any-return]
    return [float(function(a, b)) for a, b in zip(left, right, strict=True)]


def lyapunov_violation(
    system: DynamicalSystem, demos: Demonstrations, rng: np.random.Generator
) -> float | None:
    """Return where V does not decrease along the field.

    dV/dt is the central difference of `lyapunov` along `velocity`, over a way of `NUDGE` diagonals
    each: a method is not asked for its own opinion of its derivative.
    """
    low, high = scored_box(demos)
    states = metrics.uniform_states(low, high, rng=rng)
    if system.lyapunov(states[:1]) is None:
        return None
    field = system.velocity(states)
    with np.errstate(divide="ignore", invalid="ignore"):  # a field of 0 or nan is a violation
        nudge = field * (
            NUDGE * metrics.box_diagonal(low, high) / np.linalg.norm(field, axis=1, keepdims=True)
        )
        ahead, behind = system.lyapunov(states + nudge), system.lyapunov(states - nudge)
        rates = np.asarray(ahead) - np.asarray(behind)
    return metrics.lyapunov_violation(rates, states, demos.goal)


def step_us(policy: Any, task: Any, scored: Demonstrations) -> float:
    """Return the median time of a call with a single state, along the first demonstration.

    A policy's own state goes from call to call, as in an episode.
    """
    env = task.like()
    env.reset(seed=0, options={"start": scored.positions[0][0]})
    bound = bind(policy, env)
    states = scored.positions[0][:: max(1, len(scored.positions[0]) // 64)]
    if task.control_mode == "force":
        states = np.hstack([states, np.zeros_like(states)])
    following = cycle(list(states))
    state: Any = None

    def call() -> None:
        nonlocal state
        _, state = bound.predict(next(following), state=state, deterministic=True)

    with one_thread():
        return metrics.median_call_us(call, TIMED_CALLS)


@contextmanager
def one_thread() -> Iterator[None]:
    """Let numerical libraries use one thread; torch too, where something has imported it."""
    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

    torch = sys.modules.get("torch")
    n_threads = torch.get_num_threads() if torch is not None else 0
    with threadpool_limits(1):
        if torch is not None:
            torch.set_num_threads(1)
        try:
            yield
        finally:
            if torch is not None:
                torch.set_num_threads(n_threads)


def statistic(
    function: Callable[[FloatArray], Any], values: Sequence[float | None]
) -> float | None:
    """Return a statistic of the values that there are; None if there are none."""
    present = np.array([v for v in values if v is not None], dtype=np.float64)
    return float(function(present)) if len(present) else None
