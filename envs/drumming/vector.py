"""Many arms at once, in as many processes as there are processors."""

from __future__ import annotations

import multiprocessing
import weakref
from collections.abc import Sequence
from typing import Any, ClassVar, cast

import gymnasium
import joblib
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from iflow_gym.datasets.drums import Drum
from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.envs.drumming.arguments import checked_options
from iflow_gym.envs.drumming.crew import Columns, Crew, CrewProcess, Plan, end, shared
from iflow_gym.envs.drumming.env import DrummingEnv
from iflow_gym.envs.drumming.recorded import DrummingRecordedEnv
from iflow_gym.envs.point_mass_vector import PointMassVectorEnv
from iflow_gym.metrics.drumming import Hit

BoolArray = NDArray[np.bool_]


class DrummingVectorEnv(VectorEnv[FloatArray, FloatArray, NDArray[Any]]):
    """`num_envs` arms like `DrummingEnv`, stepped together in processes.

    Gymnasium's `AsyncVectorEnv` with one arm a process spends as long on a step's messages as on
    the step. Here each process, one for each processor, moves an equal share of the arms, this
    process among them, and what they know comes back in shared memory: two short messages a process
    and step, however many arms there are.

    The same seeds and actions give the same bits as `gymnasium.vector.SyncVectorEnv` over
    `DrummingEnv`: a seed s gives arm i the seed s + i, a list gives each its own. An episode that
    ended begins anew in the next step (`AutoresetMode.NEXT_STEP`), whose action is ignored for that
    arm. `info` follows Gymnasium's convention: each key of `DrummingEnv` holds an array of shape
    (n, ...), ``hits`` of tuples, and ``_key`` the mask of where it is set.

    `reset(options=...)` takes ``{"demonstration": i}`` with one index or shape (n,), ``{"start":
    x}`` with shape (3,) or (n, 3), and ``{"reset_mask": mask}``, which resets only where the mask,
    shape (n,), is true. Conversions are `DrummingEnv`'s, of n commands at once; in torque mode each
    depends on the joints of its own arm.

    Parameters
    ----------
    num_envs : int
        How many arms, n.
    processes : int, optional
        At most so many, this one among them; None takes the processors that this process may use
        (`joblib.cpu_count`).
    context : str, optional
        How processes begin, of `multiprocessing.get_context`. Where they are spawned, as they are
        by default on macOS, a script makes the batch under ``if __name__ == "__main__":``.
    **settings
        Arguments of `DrummingEnv`. There is no rendering.

    Examples
    --------
    >>> envs = gymnasium.make_vec("iflow/Drumming-v0", num_envs=8)  # doctest: +SKIP
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": []}  # noqa: RUF012
    arm: ClassVar[type[DrummingEnv]] = DrummingEnv
    """What there are many of."""
    _checked_mask = PointMassVectorEnv._checked_mask

    def __init__(
        self,
        num_envs: int = 1,
        *,
        processes: int | None = None,
        context: str | None = None,
        render_mode: None = None,
        **settings: Any,
    ) -> None:
        for name, value in (("num_envs", num_envs), ("processes", processes)):
            if not (value is None or (isinstance(value, int | np.integer) and value >= 1)):
                raise ValueError(f"Expected {name} to be a whole number >= 1, got {value!r}.")
        if render_mode is not None:
            raise ValueError(
                f"Expected render_mode None, got {render_mode!r}: the batch does not render; use "
                "gymnasium.make_vec(..., vectorization_mode='sync')."
            )
        self.num_envs = num_envs = int(num_envs)
        self._task = self.arm(**settings)
        self.single_observation_space = self._task.observation_space
        self.single_action_space = self._task.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        first, info = self._task.reset(seed=0)
        self._columns = Columns(len(first), info)
        (n_actions,) = cast("tuple[int]", self.single_action_space.shape)
        if processes is None:  # a daemon, such as a worker of another batch, can have none
            processes = 1 if multiprocessing.current_process().daemon else joblib.cpu_count()
        self._context: Any = multiprocessing.get_context(context)
        rows = self._context.RawArray("d", num_envs * self._columns.width)
        actions = self._context.RawArray("d", num_envs * n_actions)
        self._rows, self._actions = shared(rows, num_envs), shared(actions, num_envs)
        shares = np.array_split(np.arange(num_envs), min(int(processes), num_envs))
        # The recordings are read once, here.
        settings |= {"demonstrations": self.demonstrations, "drums": self.drums}
        settings.pop("mirror", None)
        self._plans = [
            Plan(settings, self._columns, num_envs, range(s[0], s[-1] + 1), rows, actions)
            for s in shares
        ]
        self._own = Crew(self._plans[0])
        self._others: list[CrewProcess] = []
        weakref.finalize(self, end, self._others)
        self._ready = False

    # What an arm has ----------------------------------------------------------------------

    @property
    def demonstrations(self) -> Demonstrations:
        """The demonstrations."""
        return self._task.demonstrations

    @property
    def drums(self) -> tuple[Drum, ...]:
        """The drums."""
        return self._task.drums

    @property
    def control_mode(self) -> str:
        """``"velocity"`` or ``"torque"``."""
        return self._task.control_mode

    @property
    def n_dims(self) -> int:
        """Dimension of a position: 3."""
        return self._task.n_dims

    @property
    def max_speed(self) -> float:
        """Speed of the tip in m/s of an action component of 1."""
        return self._task.max_speed

    @property
    def dt(self) -> FloatArray:
        """Seconds a step, shape (n,)."""
        return np.full(self.num_envs, self._task.dt)

    @property
    def processes(self) -> int:
        """How many processes move the arms, this one among them."""
        return len(self._plans)

    @property  # type: ignore[misc]
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """A copy of each arm's random number generator."""
        return self._of_arms("generators")

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """Each arm's seed."""
        return self._of_arms("seeds")

    def velocity_to_action(self, velocity: ArrayLike) -> FloatArray:
        """Return the actions of velocities in m/s, shape (..., 3), scaled to fit the box."""
        return self._task.velocity_to_action(velocity)

    def action_to_velocity(self, action: ArrayLike) -> FloatArray:
        """Return the velocities in m/s that actions, shape (..., 3), command."""
        return self._task.action_to_velocity(action)

    def command_to_action(
        self, velocity_command: ArrayLike, observation: ArrayLike, dt: Any = None
    ) -> FloatArray:
        """Return the actions of velocity commands, as `DrummingEnv.command_to_action` does.

        In torque mode commands have shape (n, 3) and observations (n, observation): one an arm, in
        the state that it is in now.
        """
        if self.control_mode == "velocity":
            return self._task.command_to_action(velocity_command, observation, dt)
        commands, states = np.asarray(velocity_command), np.asarray(observation)
        shape = self.observation_space.shape
        if commands.shape != (self.num_envs, 3) or states.shape != shape:
            raise ValueError(
                f"Expected commands of shape ({self.num_envs}, 3) and observations of shape "
                f"{shape} in torque mode, got {commands.shape} and {states.shape}: the torques "
                "depend on each arm's joints."
            )
        if not self._ready:
            raise gymnasium.error.ResetNeeded("Call reset() before command_to_action().")
        return np.stack(self._of_arms("actions_of", commands, states))

    def _of_arms(self, method: str, *arguments: Any) -> tuple[Any, ...]:
        """Return what a method of the crews returns for each arm."""
        return tuple(value for values in self._asked(method, *arguments) for value in values)

    def _asked(self, method: str, *arguments: Any) -> list[Any]:
        """Return what a method of each crew returns; they are at it side by side.

        Each crew gets its share of the arguments, of which all arms have one. After an error or an
        interrupt nobody knows where the arms are: the processes are ended, and all arms must be
        reset.
        """
        if self.closed:
            raise gymnasium.error.ClosedEnvironmentError("The arms were closed: make them anew.")
        own, *others = (
            [argument[plan.share.start : plan.share.stop] for argument in arguments]
            for plan in self._plans
        )
        try:
            if not self._others:
                for plan in self._plans[1:]:
                    self._others.append(CrewProcess(self._context, plan))
            for crew, theirs in zip(self._others, others, strict=True):
                crew.begin(method, *theirs)
            mine = getattr(self._own, method)(*own)
            return [mine, *(crew.result() for crew in self._others)]
        except BaseException:
            self._ready = False
            end(self._others)
            raise

    # Episodes -----------------------------------------------------------------------------

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Begin an episode with each arm; see the class for the options."""
        orders = self._orders(seed, dict(options or {}))
        self._asked("reset", orders)
        self._ready = True
        begun = np.array([order is not None for order in orders])
        return self._rows[:, self._columns.observation].copy(), self._info({}, begun)

    def _orders(self, seed: Any, options: dict[str, Any]) -> list[tuple[Any, Any] | None]:
        """Return seed and options of each arm, checked; None for one that goes on."""
        n = self.num_envs
        mask = self._checked_mask(options.pop("reset_mask", None))  # type: ignore[misc]
        if not (self._ready or mask.all()):
            raise gymnasium.error.ResetNeeded("Call reset() for all arms before some of them.")
        checked_options(self.demonstrations, dict.fromkeys(options))  # that they are options
        each: list[dict[str, Any]] = [{} for _ in range(n)]
        for key, value in options.items():
            own_shape = (3,) if key == "start" else ()
            for_all = value is None or np.shape(value) == own_shape
            if not for_all and np.shape(value) != (n, *own_shape):
                raise ValueError(
                    f"Expected options[{key!r}] of shape {own_shape} or {(n, *own_shape)}, got "
                    f"{np.shape(value)}."
                )
            for i, own in enumerate(each):
                own[key] = value if for_all else value[i]
        placed: set[tuple[float, ...]] = set()
        for i in np.flatnonzero(mask).tolist():
            _, start = checked_options(self.demonstrations, each[i])
            if start is not None and tuple(start) not in placed:
                self._task.simulation.place(start)
                placed.add(tuple(start))
        return [
            (own_seed, own) if due else None
            for own_seed, own, due in zip(self._seeds(seed), each, mask.tolist(), strict=True)
        ]

    def _seeds(self, seed: Any) -> list[int | None]:
        """Return each arm's seed."""
        n = self.num_envs
        seeds = [None] * n if seed is None else seed
        if isinstance(seeds, int | np.integer):
            seeds = [int(seeds) + i for i in range(n)]
        if np.shape(seeds) != (n,):
            raise ValueError(f"Expected one seed, or one for each of {n} arms, got {seed!r}.")
        for own in seeds:
            if not (own is None or (isinstance(own, int | np.integer) and own >= 0)):
                raise ValueError(f"Expected seeds that are whole numbers >= 0, got {own!r}.")
        return [None if own is None else int(own) for own in seeds]

    def step(
        self, actions: FloatArray
    ) -> tuple[FloatArray, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Hold an action, shape (n, d), for a control step; begin anew where the last one ended."""
        if not self._ready:
            raise gymnasium.error.ResetNeeded("Call reset() before step().")
        values = np.asarray(actions)
        if values.shape != self.action_space.shape:
            raise ValueError(
                f"Expected actions of shape {self.action_space.shape}, got {values.shape}."
            )
        if not np.isfinite(values).all():
            bad = np.flatnonzero(~np.isfinite(values).all(axis=1)).tolist()
            raise ValueError(
                f"Expected finite actions, got NaN or infinity for the arms {bad}: "
                f"{values[bad].tolist()}."
            )
        self._actions[:] = values
        hits: dict[int, tuple[Hit, ...]] = {}
        for of_crew in self._asked("step"):
            hits |= of_crew
        rows, columns = self._rows, self._columns
        return (
            rows[:, columns.observation].copy(),
            rows[:, columns.reward].copy(),
            rows[:, columns.terminated] > 0,
            rows[:, columns.truncated] > 0,
            self._info(hits, np.ones(self.num_envs, dtype=np.bool_)),
        )

    def _info(self, hits: dict[int, tuple[Hit, ...]], told: BoolArray) -> dict[str, Any]:
        """Return what the arms that are told of know, and the mask of them, by key."""
        rows = self._rows if told.all() else np.where(told[:, None], self._rows, 0.0)
        infos = self._columns.infos(rows)
        infos["hits"] = np.empty(self.num_envs, dtype=object)
        for i in range(self.num_envs):
            infos["hits"][i] = hits.get(i, ()) if told[i] else None
        return {k: v for key in infos for k, v in ((key, infos[key]), (f"_{key}", told.copy()))}

    def render(self) -> None:
        """Refuse: a batch has no picture."""
        raise NotImplementedError(
            "A batch of arms does not render: use gymnasium.make(id, render_mode='rgb_array'), or "
            "gymnasium.make_vec(id, n, vectorization_mode='sync', render_mode='rgb_array')."
        )

    def close_extras(self, **kwargs: Any) -> None:
        """End the processes."""
        end(self._others, **{"terminate": False, **kwargs})


class DrummingRecordedVectorEnv(DrummingVectorEnv):
    """`num_envs` arms like `DrummingRecordedEnv`, stepped together in processes."""

    arm = DrummingRecordedEnv
