"""Scores of a system or a policy on an environment: every metric but what a fit costs.

Every trajectory that is scored is recorded from the observations of the batched environment,
stepped with the actions of a policy; see `iflow_gym.evaluation.rollouts`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np

from iflow_gym import metrics
from iflow_gym.evaluation import cycles, drumming, goals
from iflow_gym.evaluation.common import (
    PerDemonstration,
    Scores,
    likelihood,
    lyapunov_violation,
    statistic,
    step_us,
    teacher_forced,
)
from iflow_gym.evaluation.rollouts import Policy
from iflow_gym.policy import MethodPolicy
from iflow_gym.system import DynamicalSystem, Method

__all__ = ["FIT_COSTS", "Evaluation", "Policy", "evaluate", "motion_of", "score"]

KINDS: dict[metrics.Motion, Any] = {"goal": goals, "cycle": cycles, "drumming": drumming}
"""Modules that score a motion, by its kind."""

FIT_COSTS = ("fit_seconds", "fit_cpu_seconds", "peak_memory_mb")
"""Metrics that only whoever fits can measure."""


@dataclass(frozen=True)
class Evaluation:
    """What an evaluation found."""

    metrics: Scores
    """Every metric by name but `FIT_COSTS`; None where it does not apply. Means over the scored
    demonstrations where there is a value for each."""
    medians: Scores
    """Medians over the scored demonstrations, of the metrics that have a value for each."""
    per_demonstration: PerDemonstration
    """Values for each scored demonstration, in their order."""
    likelihoods: dict[str, list[float]] = field(default_factory=dict)
    """Log densities, nats, of the scored demonstrations of each motion that this one is to be told
    apart from, itself among them, by environment id; empty where there are none, and in
    reproduction, where nothing is held out."""


def score(
    system_or_policy: Any, env: Any, seed: int, *, protocol: str = "reproduction"
) -> dict[str, float | None]:
    """Return `evaluate`'s metrics: name to mean over the scored demonstrations, None for not any.

    Parameters are `evaluate`'s.
    """
    return evaluate(system_or_policy, env, seed=seed, protocol=protocol).metrics


def evaluate(
    system_or_policy: Any,
    env: Any,
    *,
    seed: int,
    protocol: str = "reproduction",
    stability: bool = True,
) -> Evaluation:
    """Score a fitted system, or a policy, on an environment of iflow_gym.

    Parameters
    ----------
    system_or_policy : DynamicalSystem, MovementPrimitive or Policy
        Fitted on the protocol's fit split. Anything with `predict(observation, state,
        episode_start, deterministic)` will do, a policy that depends on time too: what it returns
        as its state is given back at the next step (None at the first). Only a system has
        teacher-forced metrics, a likelihood and a Lyapunov function: of a primitive, which has no
        field to be asked, they are None. Its pushed rollouts show what its clock does then.
    env : environment, vector environment or str
        One of iflow_gym's, or an id. It is not stepped: batches with its demonstrations and its
        control mode are made for the purpose, without its perturbation, horizon or wrappers.
    seed : int
        Of the directions of the pushes and the states where the Lyapunov function is tested. The
        same seed gives every method the same ones.
    protocol : str
        Whose score split the demonstrations are taken from; the box, the tolerances and the
        durations are those of all demonstrations of the environment.
    stability : bool
        Whether to take the metrics that need long rollouts; without, they are None.

    Returns
    -------
    Evaluation

    Raises
    ------
    TypeError, ValueError
        If `env` is no environment of iflow_gym, or the policy does not fit it.

    Notes
    -----
    A policy whose action is not finite has run away: its trajectory is nan from there on, so that
    accuracy is infinite and the start diverged, and the others of its batch go on.

    The pushed rollouts of a motion that ends take as many steps as those from the grid, ceil(5 x
    longest duration / mean dt), each at its own demonstration's dt: at least 5 times its own
    duration. All rollouts of a motion that repeats last 8 of its periods.
    """
    task = _task_environment(env)
    method = _method_of(system_or_policy)
    system = method if isinstance(method, DynamicalSystem) else None
    policy = system_or_policy if method is None else method
    demos = task.demonstrations
    scored = demos.split(protocol).score
    indices = [i for i, p in enumerate(demos.positions) if any(p is q for q in scored.positions)]
    push_rng, state_rng = np.random.default_rng(seed).spawn(2)
    motion = motion_of(task)
    kind = KINDS[motion]

    per_demonstration = kind.accuracy(policy, task, scored, indices)
    if system is not None:
        per_demonstration |= teacher_forced(system, scored)
        if protocol == "generalisation":  # elsewhere nothing is held out
            per_demonstration |= likelihood(system, scored)
    values: Scores = {m.name: None for m in metrics.metrics_of(motion) if m.name not in FIT_COSTS}
    if stability:
        pushes = push_rng.integers(2**31, size=len(demos))[indices].tolist()
        found, recovered = kind.stability(policy, task, indices, pushes)
        values |= found
        per_demonstration["perturbation_recovery"] = recovered
    if system is not None:
        values["lyapunov_violation"] = lyapunov_violation(system, demos, state_rng)
    if method is not None:
        values["n_parameters"] = float(method.n_parameters)
    values["step_us"] = step_us(policy, task, scored)
    values |= {name: statistic(np.mean, v) for name, v in per_demonstration.items()}
    medians = {name: statistic(np.median, v) for name, v in per_demonstration.items()}
    unseen = protocol == "generalisation"
    rivals = _likelihoods(system, task, protocol) if system is not None and unseen else {}
    return Evaluation(values, medians, per_demonstration, rivals)


def motion_of(task: Any) -> metrics.Motion:
    """Return the kind of motion that an unwrapped environment of iflow_gym is of."""
    motion: metrics.Motion = task.motion
    return motion


def _likelihoods(system: DynamicalSystem, task: Any, protocol: str) -> dict[str, list[float]]:
    """Return log p(tau) of the scored demonstrations of each of the task's `rivals`."""
    found: dict[str, list[float]] = {}
    for rival in task.rivals:
        others = _task_environment(rival).demonstrations.split(protocol).score
        densities = [
            system.trajectory_log_prob(p, dt, initial=True)
            for p, dt in zip(others.positions, others.dt, strict=True)
        ]
        if any(density is None for density in densities):
            return {}
        found[rival] = [float(density) for density in densities if density is not None]
    return found


def _task_environment(env: Any) -> Any:
    base = (gymnasium.make(env) if isinstance(env, str) else env).unwrapped
    if not all(hasattr(base, name) for name in ("demonstrations", "like", "motion")):
        raise TypeError(
            f"Expected an environment of iflow_gym or its id, got {type(base).__name__}."
        )
    return base


def _method_of(system_or_policy: Any) -> Method | None:
    if isinstance(system_or_policy, Method):
        return system_or_policy
    if isinstance(system_or_policy, MethodPolicy):
        return system_or_policy.method  # its own environment is another than the batch
    if not callable(getattr(system_or_policy, "predict", None)) and not hasattr(
        system_or_policy, "for_environment"
    ):
        raise TypeError(
            "Expected a fitted method or a policy with predict(observation, state, "
            f"episode_start, deterministic), got {type(system_or_policy).__name__}."
        )
    return None
