"""Scores of a system or a policy on an environment: every number of METRICS.md but the fit's cost.

The environment is the judge. Every trajectory that is scored is recorded from the observations of
the batched environment, stepped with the actions of a policy; `DynamicalSystem.rollout` is never
used, because there a method would integrate itself as finely as it likes, with no sample time to
hold a command for and no greatest speed. (A method whose flow is exact gets the same trajectory
from both, as a test shows.)
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import cycle
from typing import Any, Protocol

import gymnasium
import numpy as np
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from iflow_gym import metrics
from iflow_gym.demonstrations import BoundingBox, Demonstrations, FloatArray
from iflow_gym.envs.point_mass_vector import PointMassVectorEnv
from iflow_gym.envs.task import THINNEST_SIDE, PointMassInterface, Push
from iflow_gym.metrics.stability import PERTURBATION_SIZE, PERTURBATION_TIME, STARTS_PER_AXIS
from iflow_gym.policy import MethodPolicy, policy_of
from iflow_gym.system import DynamicalSystem, Method

TRANSITIONS = (1, 10)
"""Samples k between the two ends of a transition whose likelihood is taken."""

STARTS = 256
"""About how many starts the grid has where METRICS.md fixes none: in 1-D, and from 4-D on."""

TIMED_CALLS = 300
"""Calls of the policy that `step_us` is the median of."""

NUDGE = 1e-6
"""How far a state is moved along the field to see V change, as a fraction of the diagonal."""

FIT_COSTS = ("fit_seconds", "fit_cpu_seconds", "peak_memory_mb")
"""Metrics that only whoever fits can measure."""

Scores = dict[str, "float | None"]


class Policy(Protocol):
    """What is scored: Stable-Baselines3's interface.

    A policy that needs to know the environment, its `dt` or its `command_to_action`, has a method
    `for_environment(env)`, which returns the policy to ask; `env` is a batch, or a single one for
    `step_us`.
    """

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Any, Any]:
        """Return actions and the state that the next call is given."""


@dataclass(frozen=True)
class Evaluation:
    """What an evaluation found."""

    metrics: Scores
    """Every metric by name but `FIT_COSTS`; None where it does not apply. Means over the scored
    demonstrations where there is a value for each."""
    medians: Scores
    """Medians over the scored demonstrations, of the metrics that have a value for each."""
    per_demonstration: dict[str, list[float | None]]
    """Values for each scored demonstration, in their order."""


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
        Whose score split the demonstrations are taken from; the box, the goal's tolerance and the
        durations are those of all demonstrations of the environment.
    stability : bool
        Whether to take the metrics that need long rollouts; without, they are None.

    Returns
    -------
    Evaluation

    Raises
    ------
    TypeError, ValueError
        If `env` is no point-mass environment, or the policy does not fit it.

    Notes
    -----
    A policy whose action is not finite has run away: its trajectory is nan from there on, so that
    accuracy is infinite and the start diverged, and the others of its batch go on.

    The pushed rollouts take as many steps as those from the grid, ceil(5 x longest duration / mean
    dt), each at its own demonstration's dt: at least 5 times its own duration.
    """
    task = _task_environment(env)
    method = _method_of(system_or_policy)
    system = method if isinstance(method, DynamicalSystem) else None
    policy = system_or_policy if method is None else method
    demos = task.demonstrations
    scored = demos.split(protocol).score
    indices = [i for i, p in enumerate(demos.positions) if any(p is q for q in scored.positions)]
    push_rng, state_rng = np.random.default_rng(seed).spawn(2)

    per_demonstration = _accuracy(policy, task, scored, indices)
    if system is not None:
        per_demonstration |= _teacher_forced(system, scored)
        if protocol == "generalisation":  # elsewhere nothing is held out
            per_demonstration |= _likelihood(system, scored)
    values: Scores = {m.name: None for m in metrics.METRICS if m.name not in FIT_COSTS}
    if stability:
        pushes = push_rng.integers(2**31, size=len(demos))[indices].tolist()
        found, recovered = _stability(policy, task, indices, pushes)
        values |= found
        per_demonstration["perturbation_recovery"] = recovered
    if system is not None:
        values["lyapunov_violation"] = _lyapunov_violation(system, demos, state_rng)
    if method is not None:
        values["n_parameters"] = float(method.n_parameters)
    values["step_us"] = _step_us(policy, task, scored)
    values |= {name: _statistic(np.mean, v) for name, v in per_demonstration.items()}
    medians = {name: _statistic(np.median, v) for name, v in per_demonstration.items()}
    return Evaluation(values, medians, per_demonstration)


# What is scored ---------------------------------------------------------------------------


def _task_environment(env: Any) -> PointMassInterface:
    base = (gymnasium.make(env) if isinstance(env, str) else env).unwrapped
    if not isinstance(base, PointMassInterface):
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


def _bound(policy: Any, env: Any) -> Policy:
    """Return the policy for an environment."""
    if isinstance(policy, Method):
        return policy_of(policy, env)
    bind: Callable[[Any], Policy] | None = getattr(policy, "for_environment", None)
    bound: Policy = policy if bind is None else bind(env)
    return bound


# Rollouts ---------------------------------------------------------------------------------


class _Batch:
    """Vector environments that step side by side, so that a policy is asked once for all.

    They may differ in what only the constructor sets, the perturbation. To a policy this is one
    environment of iflow_gym.
    """

    def __init__(self, envs: Sequence[PointMassVectorEnv]) -> None:
        self._envs = list(envs)
        self.unwrapped = self
        first = self._envs[0]
        self.num_envs = sum(env.num_envs for env in self._envs)
        self.demonstrations = first.demonstrations
        self.n_dims, self.max_speed = first.n_dims, first.max_speed
        self.single_observation_space = first.single_observation_space
        self.single_action_space = first.single_action_space
        self.observation_space = batch_space(first.single_observation_space, self.num_envs)
        self.action_space = batch_space(first.single_action_space, self.num_envs)
        ends = np.cumsum([env.num_envs for env in self._envs]).tolist()
        self._slices = [slice(e - env.num_envs, e) for e, env in zip(ends, self._envs, strict=True)]
        self.dt: FloatArray = np.concatenate([env.dt for env in self._envs])

    def command_to_action(
        self, velocity_command: ArrayLike, observation: ArrayLike, dt: Any = None
    ) -> FloatArray:
        """As the environment's, shape (n, d)."""
        steps = self.dt if dt is None else dt
        return self._envs[0].command_to_action(velocity_command, observation, steps)

    def observe(self, observations: Sequence[FloatArray]) -> FloatArray:
        """Join what the environments returned, shape (n, observation)."""
        return observations[0] if len(observations) == 1 else np.concatenate(observations)

    def step(self, actions: NDArray[Any]) -> FloatArray:
        """Step all; return the observations, shape (n, observation)."""
        return self.observe(
            [env.step(actions[s])[0] for env, s in zip(self._envs, self._slices, strict=True)]
        )


def _vector(
    task: PointMassInterface, n: int, n_steps: int, push: Push | None = None
) -> PointMassVectorEnv:
    """Return n environments like `task` with a horizon: none of them begins anew within it."""
    mode: dict[str, Any] = {"control_mode": task.control_mode}
    if task.control_mode == "force":
        mode |= {"mass": task.mass, "damping": task.damping}
    return PointMassVectorEnv(task.demonstrations, n, horizon=n_steps, perturbation=push, **mode)


def _rollouts(
    policy: Any, envs: Sequence[PointMassVectorEnv], first: FloatArray, n_steps: int
) -> FloatArray:
    """Return positions, shape (n, n_steps + 1, d), from environments that were just reset.

    `first` are the observations of the reset, shape (n, observation).
    """
    batch = _Batch(envs)
    n, d = batch.num_envs, batch.n_dims
    bound = _bound(policy, batch)
    paths = np.empty((n_steps + 1, n, d))
    paths[0] = first[:, :d]
    runaway = np.zeros(n, dtype=np.bool_)
    episode_start = np.ones(n, dtype=np.bool_)
    observation, state = first, None
    for k in range(n_steps):
        actions, state = bound.predict(
            observation, state=state, episode_start=episode_start, deterministic=True
        )
        actions = np.asarray(actions)
        if actions.shape == (n, d) and not np.isfinite(actions).all():
            runaway |= ~np.isfinite(actions).all(axis=1)
            actions = np.where(runaway[:, None], 0.0, actions)
        observation = batch.step(actions)
        paths[k + 1] = observation[:, :d]
        if k == 0:
            episode_start = np.zeros(n, dtype=np.bool_)
        if runaway.any():
            paths[k + 1, runaway] = np.nan
    return np.ascontiguousarray(paths.transpose(1, 0, 2))


# Accuracy ---------------------------------------------------------------------------------


def _accuracy(
    policy: Any, task: PointMassInterface, scored: Demonstrations, indices: Sequence[int]
) -> dict[str, list[float | None]]:
    """Return the scores of rollouts from each scored demonstration's start."""
    n_steps = max(len(p) for p in scored.positions) - 1
    env = _vector(task, len(indices), n_steps)
    first, _ = env.reset(seed=0, options={"demonstration": np.array(indices)})
    paths = _rollouts(policy, [env], first, n_steps)
    made = [path[: len(p)] for path, p in zip(paths, scored.positions, strict=True)]
    return trajectory_scores(scored.positions, made)


def trajectory_scores(
    demonstrated: Sequence[FloatArray], made: Sequence[FloatArray]
) -> dict[str, list[float | None]]:
    """Return RMSE, Fréchet distance, DTW and swept area of each pair of trajectories.

    Parameters
    ----------
    demonstrated, made : sequences of n arrays, shape (T_i, d)
        What was shown, and what was made of it, in units of length.

    Returns
    -------
    dict
        Name of the metric to n values; the area has a name in 2-D and another in 3-D.
    """
    functions: dict[str, Callable[[Any, Any], Any]] = {
        "rmse": metrics.rmse,
        "frechet": metrics.frechet,
        "dtw": metrics.dtw,
    }
    if demonstrated[0].shape[1] == 2:
        functions["swept_area"] = metrics.swept_area
    if demonstrated[0].shape[1] == 3:
        functions["swept_surface"] = metrics.swept_surface
    return {name: _each(f, demonstrated, made) for name, f in functions.items()}


def _teacher_forced(
    system: DynamicalSystem, scored: Demonstrations
) -> dict[str, list[float | None]]:
    """Return the scores of the field at the demonstrations' own samples."""
    predicted = [system.velocity(p) for p in scored.positions]
    functions: dict[str, Callable[[Any, Any], Any]] = {
        "seds_error": metrics.seds_error,
        "direction_error": metrics.direction_error,
        "velocity_rmse": metrics.velocity_rmse,
    }
    return {name: _each(f, scored.velocities, predicted) for name, f in functions.items()}


def _likelihood(system: DynamicalSystem, scored: Demonstrations) -> dict[str, list[float | None]]:
    """Return the negative log-likelihood of the demonstrations' transitions, where there is one."""
    found: dict[str, list[float | None]] = {}
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


def _each(
    function: Callable[[Any, Any], Any], left: Sequence[FloatArray], right: Sequence[FloatArray]
) -> list[float | None]:
    """Return a metric of each pair, of all at once where the lengths allow."""
    if len({len(a) for a in left}) == 1:
        return np.asarray(function(np.stack(left), np.stack(right)), dtype=np.float64).tolist()  # type: ignore[no-any-return]
    return [float(function(a, b)) for a, b in zip(left, right, strict=True)]


# Stability --------------------------------------------------------------------------------


def _stability(
    policy: Any, task: PointMassInterface, indices: Sequence[int], push_seeds: Sequence[int]
) -> tuple[Scores, list[float | None]]:
    """Return the scores of rollouts from the grid, and whether each pushed one converged."""
    demos = task.demonstrations
    low, high = _scored_box(demos)
    goal, d = demos.attractor, demos.n_dims
    per_axis = None if d in STARTS_PER_AXIS else max(2, round(STARTS ** (1 / d)))
    grid = metrics.start_grid(low, high, per_axis)
    n_steps = math.ceil(metrics.HORIZON * float(demos.durations.max()) / demos.mean_dt)
    free = _vector(task, len(grid), n_steps)
    pushed = _vector(task, len(indices), n_steps, Push(PERTURBATION_TIME, PERTURBATION_SIZE))
    from_grid, _ = free.reset(seed=0, options={"start": grid})
    from_starts, _ = pushed.reset(
        seed=list(push_seeds), options={"demonstration": np.array(indices)}
    )
    first = np.concatenate([from_grid, from_starts])
    paths = _rollouts(policy, [free, pushed], first, n_steps)
    free_paths, pushed_paths = paths[: len(grid)], paths[len(grid) :]
    tolerance = metrics.convergence_tolerance(low, high)
    duration = float(demos.durations.mean())
    gone = metrics.diverged(free_paths, low, high)
    found: Scores = {
        "converged": metrics.fraction(metrics.converged(free_paths, goal, tolerance)),
        "settling_time": metrics.settling_time(
            free_paths, goal, tolerance, demos.mean_dt, duration
        ),
        # A rollout that leaves ends at the environment's wall, which is no attractor of the method.
        "spurious_attractors": float(
            metrics.spurious_attractors(free_paths[~gone], goal, tolerance) if not gone.all() else 0
        ),
        "diverged": metrics.fraction(gone),
    }
    recovered = metrics.converged(pushed_paths, goal, tolerance)
    return found, [float(r) for r in recovered]


def _lyapunov_violation(
    system: DynamicalSystem, demos: Demonstrations, rng: np.random.Generator
) -> float | None:
    """Return where V does not decrease along the field.

    dV/dt is the central difference of `lyapunov` along `velocity`, over a way of `NUDGE` diagonals
    each: a method is not asked for its own opinion of its derivative.
    """
    low, high = _scored_box(demos)
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
    return metrics.lyapunov_violation(rates, states, demos.attractor)


def _scored_box(demos: Demonstrations) -> BoundingBox:
    """Return the box that starts are taken from: the bounding box, where each side has a length.

    A side without one, as a straight line along an axis has, is given `THINNEST_SIDE` diagonals,
    as the environment gives it in its arena.
    """
    box = demos.bounding_box
    missing = 0.5 * THINNEST_SIDE * box.diagonal * (box.high == box.low)
    return BoundingBox(box.low - missing, box.high + missing)


# Cost -------------------------------------------------------------------------------------


def _step_us(policy: Any, task: PointMassInterface, scored: Demonstrations) -> float:
    """Return the median time of a call with a single state, along the first demonstration.

    A policy's own state goes from call to call, as in an episode.
    """
    from iflow_gym.envs.point_mass import PointMassEnv

    settings: dict[str, Any] = {"control_mode": task.control_mode}
    if task.control_mode == "force":
        settings |= {"mass": task.mass, "damping": task.damping}
    env = PointMassEnv(task.demonstrations, **settings)
    env.reset(seed=0, options={"start": scored.positions[0][0]})
    bound = _bound(policy, env)
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


def _statistic(
    function: Callable[[FloatArray], Any], values: Sequence[float | None]
) -> float | None:
    """Return a statistic of the values that there are; None if there are none."""
    present = np.array([v for v in values if v is not None], dtype=np.float64)
    return float(function(present)) if len(present) else None
