"""Many point masses that step at once: `PointMassEnv`'s numbers, batched in NumPy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.envs.dynamics import ARRAYS
from iflow_gym.envs.task import (
    START_NOISE,
    ControlMode,
    Episode,
    PointMassInterface,
    PointMassTask,
    Push,
)

BoolArray = NDArray[np.bool_]


class PointMassVectorEnv(PointMassInterface, VectorEnv[FloatArray, FloatArray, NDArray[Any]]):
    """`num_envs` environments like `PointMassEnv`, stepped together.

    The same seeds and actions give the same bits as `gymnasium.vector.SyncVectorEnv` over
    `PointMassEnv`: a seed s gives environment i the seed s + i, a list gives each its own. An
    episode that ended begins anew in the next step (`AutoresetMode.NEXT_STEP`), whose action is
    ignored for that environment. `info` follows Gymnasium's convention: each key of
    `PointMassEnv` holds an array of shape (n,), and ``_key`` the mask of where it is set.

    `reset(options=...)` takes ``{"demonstration": i}`` with one index or shape (n,), ``{"start":
    x}`` with shape (d,) or (n, d), and ``{"reset_mask": mask}``, which resets only where the mask,
    shape (n,), is true. `dt` has shape (n,): each environment has its demonstration's.

    Arguments are `PointMassEnv`'s, after `num_envs`; there is no rendering.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        demonstrations: Demonstrations,
        num_envs: int = 1,
        *,
        control_mode: ControlMode = "velocity",
        horizon: int | None = None,
        start_noise: float = START_NOISE,
        perturbation: Push | None = None,
        mass: float = 1.0,
        damping: float | None = None,
        render_mode: None = None,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"Expected num_envs >= 1, got {num_envs}.")
        if render_mode is not None:
            raise ValueError(
                f"Expected render_mode None, got {render_mode!r}: the batch does not render; use "
                "gymnasium.make_vec(..., vectorization_mode='sync')."
            )
        self.task = PointMassTask(
            demonstrations,
            control_mode=control_mode,
            horizon=horizon,
            start_noise=start_noise,
            perturbation=perturbation,
            mass=mass,
            damping=damping,
        )
        self.num_envs = num_envs
        self.single_observation_space = self.task.observation_space
        self.single_action_space = self.task.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._generators: list[tuple[np.random.Generator, int]] = []
        self._ready = False
        n, d = num_envs, self.n_dims
        self._state: list[FloatArray] = [np.zeros(n) for _ in range(self.task.control.blocks * d)]
        n_coefficients = len(self.task.control.coefficients(demonstrations.mean_dt))
        self._coefficients = np.zeros((n_coefficients, n))
        self._push = np.zeros((d, n))
        self._dt = np.full(n, demonstrations.mean_dt)
        self._count, self._horizon, self._demonstration, self._push_step = (
            np.zeros(n, dtype=np.int64) for _ in range(4)
        )
        self._ended = np.zeros(n, dtype=np.bool_)

    @property
    def dt(self) -> FloatArray:
        """Seconds a step of each running episode, shape (n,)."""
        return self._dt.copy()

    @property  # type: ignore[misc]
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """Each environment's random number generator."""
        return tuple(generator for generator, _ in self._seeded())

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """Each environment's seed."""
        return tuple(seed for _, seed in self._seeded())

    def _seeded(self) -> list[tuple[np.random.Generator, int]]:
        if not self._generators:
            self._generators = [seeding.np_random() for _ in range(self.num_envs)]
        return self._generators

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Begin an episode in each environment; see `PointMassEnv` for the options."""
        n = self.num_envs
        options = dict(options or {})
        mask = self._checked_mask(options.pop("reset_mask", None))
        indices, starts = self.task.checked_options(options, n)
        seeds = [None] * n if seed is None else seed
        if isinstance(seeds, int | np.integer):
            seeds = [int(seeds) + i for i in range(n)]
        if len(seeds) != n:
            raise ValueError(f"Expected one seed, or one for each of {n} environments, got {seed}.")
        generators = self._seeded()
        for i in np.flatnonzero(mask).tolist():
            if (own := seeds[i]) is not None:
                generators[i] = seeding.np_random(own)
            self._begin(i, self.task.episode(generators[i][0], indices[i], starts[i]))
        self._ready = True
        return self._observation(), self._info(self.task.measures(ARRAYS, self._state), mask)

    def _checked_mask(self, mask: Any) -> BoolArray:
        if mask is None:
            return np.ones(self.num_envs, dtype=np.bool_)
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
            raise TypeError(f"Expected options['reset_mask'] to be a boolean array, got {mask!r}.")
        if mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(
                f"Expected options['reset_mask'] of shape ({self.num_envs},), true at least once, "
                f"got {mask!r}."
            )
        return mask

    def _begin(self, i: int, episode: Episode) -> None:
        for component, value in zip(self._state, episode.state, strict=True):
            component[i] = value
        self._coefficients[:, i] = episode.coefficients
        self._push[:, i] = episode.push
        self._dt[i] = episode.dt
        self._count[i] = 0
        self._horizon[i] = episode.horizon
        self._demonstration[i] = episode.demonstration
        self._push_step[i] = episode.push_step
        self._ended[i] = False

    def step(
        self, actions: FloatArray
    ) -> tuple[FloatArray, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Hold an action, shape (n, d), for one dt; begin anew where the last step ended."""
        if not self._ready:
            raise gymnasium.error.ResetNeeded("Call reset() before step().")
        values = np.asarray(actions, dtype=np.float64)
        shape = (self.num_envs, self.n_dims)
        if values.shape != shape or not np.isfinite(values).all():
            self.task.reject(values, shape)
        components = list(np.ascontiguousarray(values.T))
        following, rewards, measures = self.task.advance(
            ARRAYS, self._state, components, list(self._coefficients), self._dt
        )
        self._state = following
        self._count += 1
        if self.task.perturbation is not None:
            now = self._count == self._push_step
            if now.any():
                push = list(np.where(now, self._push, 0.0))
                self._state = self.task.displaced(ARRAYS, following, push)
                measures = self.task.measures(ARRAYS, self._state)
        if self._ended.any():
            begun = np.flatnonzero(self._ended).tolist()
            for i in begun:
                self._begin(i, self.task.episode(self._seeded()[i][0], None, None))
            rewards[begun] = 0.0
            measures = self.task.measures(ARRAYS, self._state)
        self._ended = self._count >= self._horizon
        info = self._info(measures, np.ones(self.num_envs, dtype=np.bool_))
        terminated = np.zeros(self.num_envs, dtype=np.bool_)
        return self._observation(), rewards, terminated, self._ended.copy(), info

    def _observation(self) -> FloatArray:
        return np.stack(self._state, axis=-1)

    def _info(self, measures: tuple[FloatArray, ...], mask: BoolArray) -> dict[str, Any]:
        info: dict[str, NDArray[Any]] = {
            "is_success": measures[0] <= self.task.tolerance,
            **dict(zip(self.task.guide.measured, measures, strict=True)),
            "time": self._count * self._dt,
            "dt": self._dt.copy(),
            "demonstration": self._demonstration.copy(),
            "pushed": (self._push_step > 0) & (self._push_step <= self._count),
        }
        if not mask.all():
            info = {key: np.where(mask, value, value.dtype.type(0)) for key, value in info.items()}
        return {**info, **{f"_{key}": mask.copy() for key in info}}
