"""What contradicts a proof: a start from which the motion goes elsewhere, and where it goes.

A proof speaks of the method's own flow, for all time. An environment measures for some durations,
holds a command for a sample time and has a greatest speed. So what is measured there only names
the suspects; each is followed by the method's own rollout, for longer:

- A rollout that left ten times the box is followed with a quarter of the sample time for four more
  horizons. It contradicts the proof if it is not finite, or still outside. One that comes back went
  a long way round, or was driven off by the sample time, which no proof of a flow speaks of.
- A rollout that stood still outside the tolerance (a spurious attractor) is followed for ten more
  horizons. It contradicts the proof if it has come to rest: if it moved by less than 1e-9 of the
  box's diagonal in the second half of them, so that a slow motion does not count. Of a motion that
  repeats, a state at rest has to attract what is nudged from it, too: in the plane every cycle goes
  round an equilibrium, from which a proof must exempt its starts.
- A Lyapunov function that grows along the field, by a difference over a way of 1e-6 diagonals that
  is above rounding. One that only stays equal, to rounding, does not.

That not all starts have converged within the horizon contradicts nothing: a proof promises no pace.
Those that had not arrived are followed for ten horizons; that some came no nearer in the last
quarter of them, as what goes round does, is noted. It is no contradiction: no finite time is one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iflow_gym import metrics
from iflow_gym.baselines.runner.plan import task_of
from iflow_gym.demonstrations import FloatArray
from iflow_gym.evaluate import motion_of
from iflow_gym.evaluation import cycles, drumming
from iflow_gym.evaluation.common import NUDGE
from iflow_gym.evaluation.rollouts import rollouts, scored_box
from iflow_gym.metrics.cycles import PERIODS
from iflow_gym.metrics.stability import FINAL_FRACTION, STOPPED_RADIUS
from iflow_gym.system import DynamicalSystem, Method

FOLLOWED = 8
"""Suspects of a kind that are followed."""

FINER = 4
"""Parts of a sample time in which what has diverged is followed."""

LONGER = 4
"""Horizons for which it is followed."""

REST_HORIZONS = 10
"""Horizons for which what stood still is followed."""

AT_REST = 1e-9
"""Way, in diagonals of the box, that is none."""

RISE = 1e-12
"""Least relative growth of a Lyapunov function over a nudge that is no rounding."""


@dataclass(frozen=True)
class Contradiction:
    """A state that a proof excludes."""

    what: str
    start: FloatArray
    end: FloatArray

    def __str__(self) -> str:
        return f"{self.what}: from {_point(self.start)} to {_point(self.end)}"


@dataclass(frozen=True)
class Suspicion:
    """What was measured in the environment and does not contradict the proof."""

    text: str

    def __str__(self) -> str:
        return self.text


def examine(
    system: Method, environment: str, seed: int, found: Mapping[str, float | None]
) -> Iterator[Contradiction | Suspicion]:
    """Yield what speaks against the proof that a fitted method claims, where scores do.

    Parameters
    ----------
    system
        Fitted; it claims ``proved``.
    environment
        Id of the environment that the scores are of.
    seed
        Of the cell, by which the states of the Lyapunov function are drawn.
    found
        Its scores, measured here.
    """
    task = task_of(environment)
    attraction = found.get("attraction")
    elsewhere = attraction is not None and attraction < 1
    converged = found.get("converged")
    away = converged is not None and converged < 1
    if found.get("diverged") or found.get("spurious_attractors") or elsewhere or away:
        yield from _moved(system, task)
    if found.get("lyapunov_violation") and isinstance(system, DynamicalSystem):
        yield from _risen(system, task, seed)


def _moved(system: Method, task: Any) -> Iterator[Contradiction | Suspicion]:
    demos = task.demonstrations
    low, high = scored_box(demos)
    starts, n_steps, dt = _grid(task)
    env = task.like(len(starts), horizon=n_steps)
    first, _ = env.reset(seed=0, options={"start": starts})
    paths = rollouts(system, [env], first, n_steps)
    gone = metrics.diverged(paths, low, high)
    if gone.any():
        yield from _followed_out(system, starts[gone][:FOLLOWED], n_steps, dt, (low, high))
    tolerance = metrics.convergence_tolerance(low, high)
    ends = paths[:, -1]
    last = paths[:, -max(2, math.ceil(FINAL_FRACTION * paths.shape[1])) :]
    still = ~gone & (np.linalg.norm(last - ends[:, None], axis=2).max(axis=1)
                     <= STOPPED_RADIUS * tolerance)  # fmt: skip
    if demos.goal is not None:
        still &= np.linalg.norm(ends - demos.attractor, axis=1) > tolerance
    if still.any():
        yield from _followed_on(system, starts[still], ends[still], n_steps, dt, task)
    if demos.goal is not None:
        under_way = ~gone & ~still & (np.linalg.norm(ends - demos.attractor, axis=1) > tolerance)
        if under_way.any():
            yield from _followed_round(system, starts[under_way], n_steps, dt, task)


def _grid(task: Any) -> tuple[FloatArray, int, float]:
    """Return the starts that the environment is scored from, the steps of a rollout, and its dt."""
    demos = task.demonstrations
    low, high = scored_box(demos)
    motion = motion_of(task)
    if motion == "drumming":
        n_steps = drumming.START_PERIODS * cycles.samples(demos.period, task.dt)
        return drumming.reachable_starts(task), n_steps, float(task.dt)
    per_axis = None if demos.n_dims in (2, 3) else 2
    starts = metrics.start_grid(low, high, per_axis)
    if motion == "goal":
        n_steps = math.ceil(metrics.HORIZON * float(demos.durations.max()) / demos.mean_dt)
    else:
        n_steps = PERIODS * cycles.samples(demos.period, demos.mean_dt)
    return starts, n_steps, demos.mean_dt


def _followed_out(
    system: Method, starts: FloatArray, n_steps: int, dt: float, box: tuple[FloatArray, FloatArray]
) -> Iterator[Contradiction | Suspicion]:
    with np.errstate(all="ignore"):
        paths = system.rollout(starts, (1 + LONGER) * n_steps * FINER, dt / FINER)  # type: ignore[attr-defined]
    outside = metrics.diverged(paths[:, -1:], *box)
    for start, path, out in zip(starts, paths, outside, strict=True):
        if out:
            seconds = (1 + LONGER) * n_steps * dt
            yield Contradiction(
                f"diverged, after {seconds:.3g} s in steps of {dt / FINER:.3g} s", start, path[-1]
            )
    if not outside.all():
        back = _point(starts[~outside][0])
        yield Suspicion(
            f"left ten times the box in the environment, as from {back}, and is back inside where "
            f"the method rolls out by itself in steps of {dt / FINER:.3g} s"
        )


def _followed_on(
    system: Method, starts: FloatArray, ends: FloatArray, n_steps: int, dt: float, task: Any
) -> Iterator[Contradiction | Suspicion]:
    demos = task.demonstrations
    box = scored_box(demos)
    diagonal = metrics.box_diagonal(*box)
    chosen = _some(len(ends))
    begun, at = starts[chosen], ends[chosen]
    n = REST_HORIZONS * n_steps
    if isinstance(system, DynamicalSystem):
        nudge = np.zeros_like(at)
        if system.period_ is not None:
            nudge[:, 0] = NUDGE * diagonal
        paths = system.rollout(at + nudge, n, dt)
    else:  # its clock cannot be set: once more from the start
        paths = system.rollout(begun, n_steps + n, dt)[:, n_steps:]  # type: ignore[attr-defined]
    late = paths[:, n // 2 :]
    moved = np.linalg.norm(late - late[:, -1:], axis=2).max(axis=1)
    rests = moved <= AT_REST * diagonal
    there = np.zeros(len(at), dtype=np.bool_)
    if demos.goal is not None:
        reached = np.linalg.norm(paths[:, -1] - demos.attractor, axis=1)
        there = reached <= metrics.convergence_tolerance(*box)
    for start, path in zip(begun[rests & ~there], paths[rests & ~there], strict=True):
        yield Contradiction("came to rest elsewhere", start, path[-1])
    if (moving := there | ~rests).any():
        yield Suspicion(
            f"stood still in the environment, as from {_point(begun[moving][0])}, but moves on: "
            f"of {len(at)} that were followed for {n * dt:.3g} s more, {there.sum()} are at the "
            f"goal, {(moving & ~there).sum()} on their way"
        )


def _followed_round(
    system: Method, starts: FloatArray, n_steps: int, dt: float, task: Any
) -> Iterator[Suspicion]:
    followed = starts[_some(len(starts))]
    n = REST_HORIZONS * n_steps
    with np.errstate(all="ignore"):
        paths = system.rollout(followed, n, dt)  # type: ignore[attr-defined]
    demos = task.demonstrations
    away = np.linalg.norm(paths - demos.attractor, axis=2)
    third, fourth = away[:, n // 2 : 3 * n // 4], away[:, 3 * n // 4 :]
    arrived = away[:, -1] <= metrics.convergence_tolerance(*scored_box(demos))
    no_nearer = ~arrived & ~(fourth.max(axis=1) < third.max(axis=1))
    if no_nearer.any():
        yield Suspicion(
            f"of {len(starts)} starts from which it does not arrive in the environment "
            f"{len(followed)} were followed for {n * dt:.3g} s: {no_nearer.sum()} came no nearer "
            f"to the goal in the last quarter, as from {_point(followed[no_nearer][0])}; does it "
            "go round?"
        )


def _some(count: int) -> NDArray[np.intp]:
    """Return indices of up to `FOLLOWED` out of so many, evenly taken."""
    return np.unique(np.linspace(0, count - 1, min(FOLLOWED, count)).astype(np.intp))


def _risen(system: DynamicalSystem, task: Any, seed: int) -> Iterator[Contradiction | Suspicion]:
    demos = task.demonstrations
    low, high = scored_box(demos)
    _, rng = np.random.default_rng(seed).spawn(2)  # as `iflow_gym.evaluate.evaluate` draws them
    states = metrics.uniform_states(low, high, rng=rng)
    field = system.velocity(states)
    with np.errstate(all="ignore"):
        way = NUDGE * metrics.box_diagonal(low, high)
        nudge = field * (way / np.linalg.norm(field, axis=1, keepdims=True))
        ahead, behind = system.lyapunov(states + nudge), system.lyapunov(states - nudge)
        assert ahead is not None
        assert behind is not None
        growth = (ahead - behind) / (np.abs(ahead) + np.abs(behind))
    growth = np.where(np.isfinite(growth), growth, np.inf)
    worst = int(growth.argmax())
    if growth[worst] > RISE:
        text = "its Lyapunov function grows along the field"
        yield Contradiction(text, states[worst], (states + nudge)[worst])
    else:
        yield Suspicion("its Lyapunov function stays equal, to rounding, at some states")


def _point(x: FloatArray) -> str:
    return "(" + ", ".join(f"{value:.6g}" for value in x) + ")"
