"""Scores of a policy at the drums: does it hit them when the demonstrations do?

The definitions are those of `iflow_gym.metrics.drumming`. A rollout starts where a demonstration
does and lasts as long; its score is what that demonstration implies. A method of this suite runs
as `iflow_gym.policy` runs it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iflow_gym.demonstrations import FloatArray
from iflow_gym.envs.drumming.arguments import ForcePush
from iflow_gym.metrics import drumming as metrics
from iflow_gym.metrics.accuracy import rmse

if TYPE_CHECKING:
    from iflow_gym.envs.drumming.env import DrummingEnv

RECOVERED_TIME: Final = 1.0
"""A pushed rollout has recovered if it is on the orbit throughout its last so many seconds."""

METRICS: Final = (
    "hit_f1",
    "sequence_f1",
    "timing_error",
    "tempo_error",
    "missed",
    "extra",
    "tracking_rmse",
    "rmse",
    "recovered",
)
"""Names of what `score` returns."""


class Performance(NamedTuple):
    """What one rollout did."""

    path: FloatArray
    """Of the tip in m, shape (T, 3), the start first; nan from where the policy ran away."""
    targets: FloatArray
    """Where each command asked the tip to be, in m, shape (T - 1, 3); 0 where there was none."""
    on_orbit: NDArray[np.bool_]
    """Shape (T - 1,)."""
    times: FloatArray
    """Of the hits in s, shape (n,)."""
    drums: NDArray[np.intp]
    """Of the hits, shape (n,)."""


def score(system_or_policy: Any, env: DrummingEnv, seed: int) -> dict[str, float]:
    """Score a fitted system, or a policy, at the drums.

    Parameters
    ----------
    system_or_policy
        A fitted method of this suite, or anything with ``predict(observation, state,
        episode_start, deterministic)``; one with ``for_environment(env)`` is asked for its policy.
    env : DrummingEnv
        It is not stepped: environments like it are made, without its perturbation and horizon.
    seed : int
        Of the directions of the pushes.

    Returns
    -------
    dict
        Means over the demonstrations of `METRICS`. ``rmse`` is in m. ``recovered`` is the share of
        rollouts that, pushed with 4 N s half way (a `ForcePush`), are on the orbit throughout their
        last second. A policy that returns nan or infinity has run away: what it would have hit is
        missed, ``rmse`` is infinite.
    """
    demos = env.demonstrations
    free, pushed = env.like(), env.like(ForcePush())
    seeds = np.random.default_rng(seed).integers(2**31, size=len(demos)).tolist()
    rows = []
    for index, positions in enumerate(demos.positions):
        notes = free.score_of(index)
        played = perform(system_or_policy, free, index, seed=seeds[index])
        after = perform(system_or_policy, pushed, index, seed=seeds[index])
        together = (*notes, played.times, played.drums)
        rows.append(
            {
                "hit_f1": metrics.hit_f1(*together),
                "sequence_f1": metrics.sequence_f1(*together),
                "timing_error": metrics.timing_error(*together),
                "tempo_error": metrics.tempo_error(*together),
                "missed": float(metrics.missed(*together)),
                "extra": float(metrics.extra(*together)),
                "tracking_rmse": metrics.tracking_rmse(played.targets, played.path[1:]),
                "rmse": float(rmse(positions, played.path)),
                "recovered": float(after.on_orbit[-round(RECOVERED_TIME / env.dt) :].all()),
            }
        )
    return {name: float(np.mean([row[name] for row in rows])) for name in METRICS}


def perform(
    system_or_policy: Any, env: DrummingEnv, demonstration: int, seed: int | None = None
) -> Performance:
    """Run a policy from a demonstration's start to the end of the episode."""
    policy = _bound(system_or_policy, env)
    observation, _ = env.reset(seed=seed, options={"demonstration": demonstration})
    n_steps = len(env.demonstrations.positions[demonstration]) - 1
    path = np.full((n_steps + 1, 3), np.nan)
    targets, on_orbit = np.zeros((n_steps, 3)), np.zeros(n_steps, dtype=np.bool_)
    hits: list[metrics.Hit] = []
    path[0] = observation[:3]
    state, episode_start = None, np.ones(1, dtype=np.bool_)
    for k in range(n_steps):
        action, state = policy.predict(
            observation, state=state, episode_start=episode_start, deterministic=True
        )
        if not np.isfinite(action).all():
            hits += env.simulation.pending_hits()
            break
        observation, _, _, _, info = env.step(action)
        path[k + 1], on_orbit[k] = observation[:3], info["is_success"]
        targets[k] = info["target"]
        hits += info["hits"]
        episode_start = np.zeros(1, dtype=np.bool_)
    return Performance(
        path,
        targets,
        on_orbit,
        np.array([hit.time for hit in hits], dtype=np.float64),
        np.array([hit.drum for hit in hits], dtype=np.intp),
    )


def _bound(policy: Any, env: DrummingEnv) -> Any:
    from iflow_gym.policy import MethodPolicy, policy_of
    from iflow_gym.system import Method

    if isinstance(policy, MethodPolicy):
        policy = policy.method
    if isinstance(policy, Method):
        return policy_of(policy, env)
    bind = getattr(policy, "for_environment", None)
    if bind is not None:
        return bind(env)
    if not callable(getattr(policy, "predict", None)):
        raise TypeError(
            "Expected a fitted method or a policy with predict(observation, state, "
            f"episode_start, deterministic), got {type(policy).__name__}."
        )
    return policy
