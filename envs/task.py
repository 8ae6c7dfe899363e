"""The point-mass task: what its single and its batched environment have in common.

`PointMassTask` checks the arguments, holds the spaces, draws episodes and advances the state;
`PointMassInterface` is the part of the public interface that both environments share.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple, NoReturn, cast

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.envs.dynamics import (
    Arithmetic,
    Component,
    Control,
    ForceControl,
    VelocityControl,
    scaled_into_box,
)
from iflow_gym.envs.guide import guide_for
from iflow_gym.metrics import Motion

ControlMode = Literal["velocity", "force"]

SPEED_MARGIN = 5.0
"""`max_speed` in peak speeds of the demonstrations."""

ARENA = 20.0
"""The walls are the demonstrations' bounding box enlarged this many times about its centre."""

THINNEST_SIDE = 0.25
"""Sides of the bounding box below this fraction of its diagonal count as this long in `ARENA`."""

START_NOISE = 0.02
"""Standard deviation of random starts as a fraction of the bounding box's diagonal."""

TIME_CONSTANT = 0.01
"""Default mass / damping in force mode as a fraction of the demonstrations' mean duration."""

RESET_OPTIONS = ("demonstration", "start")


@dataclass(frozen=True)
class Push:
    """A perturbation: the mass is displaced once, in one step, and left to recover."""

    fraction: float = 0.4
    """When: this fraction of the way, counted in the demonstration's own steps."""
    size: float = 0.25
    """How far, as a fraction of the diagonal of the demonstrations' bounding box."""
    direction: tuple[float, ...] | None = None
    """Where to (any length but 0); None draws a direction from the environment's generator."""

    def __post_init__(self) -> None:
        if not 0 < self.fraction <= 1:
            raise ValueError(f"Expected a push's fraction in (0, 1], got {self.fraction}.")
        if not (np.isfinite(self.size) and self.size >= 0):
            raise ValueError(f"Expected a push's size >= 0 and finite, got {self.size}.")


class Episode(NamedTuple):
    """How one episode begins and what it is made of."""

    state: list[float]
    dt: float
    horizon: int
    demonstration: int
    """Index of the demonstration, -1 for a start of the caller's choice."""
    push_step: int
    """After which step the mass is pushed; 0 for never."""
    push: list[float]
    """Displacement of the push, d components."""
    coefficients: tuple[float, ...]
    """What the control needs of dt."""


class PointMassTask:
    """A point mass in the arena around a set of demonstrations (see `PointMassEnv`)."""

    def __init__(
        self,
        demonstrations: Demonstrations,
        *,
        control_mode: ControlMode,
        horizon: int | None,
        start_noise: float,
        perturbation: Push | None,
        mass: float,
        damping: float | None,
    ) -> None:
        if not isinstance(demonstrations, Demonstrations):
            raise TypeError(
                f"Expected Demonstrations, got {type(demonstrations).__name__}: make them with "
                "Demonstrations.from_arrays(...)."
            )
        if horizon is not None and (not isinstance(horizon, int | np.integer) or horizon < 1):
            raise ValueError(
                f"Expected horizon to be a whole number of steps >= 1, got {horizon!r}: leave it "
                "out for as many steps as the demonstration has."
            )
        if not (np.isfinite(start_noise) and start_noise >= 0):
            raise ValueError(
                f"Expected start_noise >= 0 (a fraction of the diagonal), got {start_noise!r}."
            )
        self.demonstrations = demonstrations
        self.horizon = None if horizon is None else int(horizon)
        self.start_noise = float(start_noise)
        self.n_dims = demonstrations.n_dims
        box = demonstrations.bounding_box
        self.diagonal = box.diagonal
        self.guide = guide_for(demonstrations.shown)  # what is held out guides nobody
        self.tolerance = self.guide.tolerance
        half = ARENA / 2 * np.maximum(box.high - box.low, THINNEST_SIDE * self.diagonal)
        centre = (box.low + box.high) / 2
        self.low, self.high = centre - half, centre + half
        self._walls: tuple[list[float], list[float]] = (self.low.tolist(), self.high.tolist())
        self.max_speed = SPEED_MARGIN * demonstrations.peak_speed
        self.control = self._control(control_mode, mass, damping)
        self.perturbation = self._checked_push(perturbation)
        self.action_space: spaces.Space[FloatArray] = cast(
            "spaces.Space[FloatArray]", spaces.Box(-1.0, 1.0, (self.n_dims,), np.float32)
        )
        self.observation_space = self._observation_space()

    def _control(self, mode: str, mass: float, damping: float | None) -> Control:
        if mode == "velocity":
            return VelocityControl(self.max_speed)
        if mode != "force":
            raise ValueError(f"Expected control_mode 'velocity' or 'force', got {mode!r}.")
        if damping is None:
            damping = mass / (TIME_CONSTANT * float(self.demonstrations.durations.mean()))
        for name, value in (("mass", mass), ("damping", damping)):
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"Expected {name} > 0, got {value!r}.")
        return ForceControl(float(mass), float(damping), float(damping) * self.max_speed)

    def _checked_push(self, push: Push | None) -> Push | None:
        if push is None:
            return None
        if not isinstance(push, Push):
            raise TypeError(f"Expected perturbation to be a Push or None, got {push!r}.")
        if push.direction is not None:
            direction = np.asarray(push.direction, dtype=np.float64)
            length = np.linalg.norm(direction) if direction.shape == (self.n_dims,) else 0.0
            if not (np.isfinite(length) and length > 0):
                raise ValueError(
                    f"Expected a push's direction to have {self.n_dims} finite components, not "
                    f"all zero, got {push.direction!r}."
                )
        return push

    def _observation_space(self) -> spaces.Space[FloatArray]:
        low, high = self.low, self.high
        if self.control.blocks == 2:
            speeds = np.full(self.n_dims, self.max_speed)
            low, high = np.concatenate([low, -speeds]), np.concatenate([high, speeds])
        return cast("spaces.Space[FloatArray]", spaces.Box(low, high, dtype=np.float64))

    # Episodes -----------------------------------------------------------------------------

    def episode(
        self, rng: np.random.Generator, demonstration: int | None, start: FloatArray | None
    ) -> Episode:
        """Draw an episode; what is None is chosen by the environment."""
        demos = self.demonstrations
        index = demonstration
        if index is None and start is None:
            index = int(rng.integers(len(demos) - demos.held_out))
        if index is None:
            index, dt = -1, demos.mean_dt
            n_steps = max(1, round(float(demos.durations.mean()) / dt))
        else:
            dt, n_steps = demos.dt[index], len(demos.positions[index]) - 1
        position = demos.positions[index][0] if start is None else start
        if demonstration is None and start is None:
            noise = self.start_noise * self.diagonal * rng.standard_normal(self.n_dims)
            position = np.clip(position + noise, self.low, self.high)
        state = position.tolist()
        if self.control.blocks == 2:
            moving = demos.velocities[index][0] if start is None else np.zeros(self.n_dims)
            state += moving.tolist()
        push_step, push = self._push(rng, n_steps)
        return Episode(
            state,
            dt,
            n_steps if self.horizon is None else self.horizon,
            index,
            push_step,
            push,
            self.control.coefficients(dt),
        )

    def _push(self, rng: np.random.Generator, n_steps: int) -> tuple[int, list[float]]:
        push = self.perturbation
        if push is None:
            return 0, [0.0] * self.n_dims
        direction = (
            rng.standard_normal(self.n_dims)
            if push.direction is None
            else np.asarray(push.direction, dtype=np.float64)
        )
        direction = direction / np.linalg.norm(direction)
        displacement: list[float] = (push.size * self.diagonal * direction).tolist()
        return max(1, round(push.fraction * n_steps)), displacement

    # Arithmetic ---------------------------------------------------------------------------

    def advance(
        self,
        ops: Arithmetic[Component],
        state: Sequence[Component],
        action: Sequence[Component],
        coefficients: Sequence[Component],
        dt: Component,
    ) -> tuple[list[Component], Component, tuple[Component, ...]]:
        """Return the state one dt later, the reward, and the measures there."""
        following = self.control.advance(ops, state, action, coefficients, *self._walls)
        d = self.n_dims
        measures = self.guide.measures(ops, following)
        reward = self.guide.reward(ops, state[:d], following[:d], dt, measures[0])
        return following, reward, measures

    def measures(
        self, ops: Arithmetic[Component], state: Sequence[Component]
    ) -> tuple[Component, ...]:
        """Return the distance from the goal; of a motion that repeats from the orbit, and phase."""
        return self.guide.measures(ops, state)

    def displaced(
        self, ops: Arithmetic[Component], state: Sequence[Component], push: Sequence[Component]
    ) -> list[Component]:
        """Return the state pushed aside, as far as the walls allow."""
        moved = [
            ops.smallest(ops.largest(x + p, low), high)
            for x, p, low, high in zip(state, push, *self._walls, strict=False)
        ]
        return moved + list(state[self.n_dims :])

    # Checks -------------------------------------------------------------------------------

    def reject(self, action: NDArray[Any], shape: tuple[int, ...]) -> NoReturn:
        """Say what is wrong with an action."""
        if action.shape != shape:
            raise ValueError(f"Expected an action of shape {shape}, got {action.shape}.")
        raise ValueError(
            f"Expected a finite action, got {np.array2string(action, threshold=20)}: the policy "
            "gave NaN or infinity."
        )

    def checked_options(
        self, options: Mapping[str, Any] | None, n: int
    ) -> tuple[list[int | None], list[FloatArray | None]]:
        """Return the demonstration and the start of each of n episodes, None where not given.

        One index, or one start of shape (d,), holds for all n.
        """
        options = options or {}
        if unknown := sorted(set(options) - set(RESET_OPTIONS)):
            raise ValueError(
                f"Expected reset options among {list(RESET_OPTIONS)}, got {unknown}: use "
                "{'demonstration': i} to start where recording i does, {'start': x} to start at x."
            )
        indices: list[int | None] = [None] * n
        starts: list[FloatArray | None] = [None] * n
        if (wanted := options.get("demonstration")) is not None:
            indices = list(self._checked_indices(wanted, n))
        if (points := options.get("start")) is not None:
            starts = list(self._checked_starts(points, n))
        return indices, starts

    def _checked_indices(self, wanted: ArrayLike, n: int) -> list[int]:
        count = len(self.demonstrations)
        index = np.asarray(wanted)
        if index.dtype.kind not in "iu" or index.shape not in ((), (n,)):
            raise TypeError(
                f"Expected options['demonstration'] to be a whole number from 0 to {count - 1}"
                + (f" or {n} of them" if n > 1 else "")
                + f", got {wanted!r}."
            )
        if ((index < 0) | (index >= count)).any():
            raise ValueError(
                f"Expected options['demonstration'] from 0 to {count - 1} ({count} recordings of "
                f"{self.demonstrations.name!r}), got {wanted!r}."
            )
        return [int(i) for i in np.broadcast_to(index, n)]

    def _checked_starts(self, points: ArrayLike, n: int) -> FloatArray:
        shapes = ((self.n_dims,), (n, self.n_dims))
        try:
            start = np.asarray(points, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise TypeError(f"Expected options['start'] to be numbers, got {points!r}.") from error
        if start.shape not in shapes:
            raise ValueError(
                f"Expected options['start'] of shape {' or '.join(map(str, dict.fromkeys(shapes)))}"
                f", got {start.shape}."
            )
        inside = (start >= self.low) & (start <= self.high)  # false for NaN
        if not inside.all():
            raise ValueError(
                f"Expected options['start'] inside the box from {self.low} to {self.high}, got "
                f"{points!r}: choose a start between observation_space.low and .high."
            )
        return np.broadcast_to(start, (n, self.n_dims))


class PointMassInterface:
    """Attributes and conversions that the single and the batched environment share.

    They are found on `env.unwrapped`, since wrappers hide attributes.
    """

    task: PointMassTask

    rivals: ClassVar[tuple[str, ...]] = ()
    """Ids of environments whose motions a model of this one's is to be told apart from by its
    density, itself among them; none by default."""

    @property
    def motion(self) -> Motion:
        """Whether the demonstrations end at a goal or repeat."""
        return "goal" if self.demonstrations.period is None else "cycle"

    def like(
        self,
        num_envs: int | None = None,
        *,
        horizon: int | None = None,
        perturbation: Push | None = None,
    ) -> Any:
        """Return an environment of the same motion and control, or a batch of `num_envs` of them.

        Its horizon and perturbation are its own; it does not render, and has no wrappers.
        """
        from iflow_gym.envs.point_mass import PointMassEnv
        from iflow_gym.envs.point_mass_vector import PointMassVectorEnv

        settings: dict[str, Any] = {
            "control_mode": self.control_mode, "horizon": horizon, "perturbation": perturbation
        }  # fmt: skip
        if self.control_mode == "force":
            settings |= {"mass": self.mass, "damping": self.damping}
        if num_envs is None:
            return PointMassEnv(self.demonstrations, **settings)
        return PointMassVectorEnv(self.demonstrations, num_envs, **settings)

    @property
    def dt(self) -> Any:
        """Seconds a step of the running episode: a float, or shape (n,) in a batch."""
        raise NotImplementedError

    @property
    def demonstrations(self) -> Demonstrations:
        """The demonstrations of the motion."""
        return self.task.demonstrations

    @property
    def n_dims(self) -> int:
        """Dimension d of a position."""
        return self.task.n_dims

    @property
    def control_mode(self) -> str:
        """What an action is: ``"velocity"`` or ``"force"``."""
        return self.task.control.name

    @property
    def max_speed(self) -> float:
        """Speed of an action component of 1 (in force mode its terminal speed)."""
        return self.task.max_speed

    @property
    def max_force(self) -> float:
        """Force of an action component of 1; force mode only."""
        return self._force_control().max_force

    @property
    def mass(self) -> float:
        """Mass in kg; force mode only."""
        return self._force_control().mass

    @property
    def damping(self) -> float:
        """Viscous damping in kg/s; force mode only."""
        return self._force_control().damping

    def velocity_to_action(self, velocity: ArrayLike) -> FloatArray:
        """Return the action of a velocity, shape (..., d), scaled as a whole to fit the box."""
        self._velocity_control()
        return scaled_into_box(self._vectors(velocity, "velocity") / self.max_speed)

    def action_to_velocity(self, action: ArrayLike) -> FloatArray:
        """Return the velocity that an action, shape (..., d), commands."""
        self._velocity_control()
        return scaled_into_box(self._vectors(action, "action")) * self.max_speed

    def force_to_action(self, force: ArrayLike) -> FloatArray:
        """Return the action of a force, shape (..., d), scaled as a whole to fit the box."""
        return scaled_into_box(self._vectors(force, "force") / self.max_force)

    def action_to_force(self, action: ArrayLike) -> FloatArray:
        """Return the force of an action, shape (..., d)."""
        return scaled_into_box(self._vectors(action, "action")) * self.max_force

    def command_to_action(
        self,
        velocity_command: ArrayLike,
        observation: ArrayLike,
        dt: float | FloatArray | None = None,
    ) -> FloatArray:
        """Return the action that carries out a velocity command, in either control mode.

        In velocity mode the command is the velocity of the coming dt. In force mode the action is
        the force with which the mass has the commanded velocity at the end of dt. Either is
        scaled as a whole to fit the box [-1, 1].

        Parameters
        ----------
        velocity_command : array, shape (..., d)
            In the demonstrations' `length_unit`/s.
        observation : array, shape (..., d) or in force mode (..., 2 d)
            The state that the command is given in.
        dt : float or array, seconds, optional
            By default that of the running episode.
        """
        command = self._vectors(velocity_command, "velocity command")
        state = np.asarray(observation, dtype=np.float64)
        size = self.task.control.blocks * self.n_dims
        if state.ndim == 0 or state.shape[-1] != size:
            raise ValueError(
                f"Expected observations of shape (..., {size}) in {self.control_mode} mode, got "
                f"{state.shape}."
            )
        return self.task.control.action_for(command, state, self.dt if dt is None else dt)

    def _vectors(self, values: ArrayLike, label: str) -> FloatArray:
        array = np.asarray(values, dtype=np.float64)
        if array.ndim == 0 or array.shape[-1] != self.n_dims:
            raise ValueError(
                f"Expected a {label} of shape (..., {self.n_dims}), got {array.shape}."
            )
        return array

    def _velocity_control(self) -> VelocityControl:
        if not isinstance(self.task.control, VelocityControl):
            raise ValueError(
                "Expected control_mode='velocity', got 'force': there an action is a force; use "
                "command_to_action(velocity, observation)."
            )
        return self.task.control

    def _force_control(self) -> ForceControl:
        if not isinstance(self.task.control, ForceControl):
            raise ValueError(
                "Expected control_mode='force', got 'velocity': there an action is a velocity; "
                "use velocity_to_action."
            )
        return self.task.control
