"""A point mass that is not what its controller takes it for, in a wind: `iflow/Disturbed-*-v0`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, SupportsFloat

import numpy as np
from numpy.typing import NDArray

from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.envs.dynamics import (
    ARRAYS,
    FLOATS,
    Arithmetic,
    Component,
    ForceControl,
    dot,
    excess,
)
from iflow_gym.envs.point_mass import PointMassEnv
from iflow_gym.envs.point_mass_vector import PointMassVectorEnv
from iflow_gym.envs.task import PointMassInterface, Push

MASS_RATIO = 4.0
"""Mass of the plant over the nominal one."""

DAMPING_RATIO = 3.0
"""Damping of the plant over the nominal one."""

WIDTH = 0.1
"""Widths of the reward's kernels in diagonals and in peak speeds: this far off they pay half."""


@dataclass(frozen=True)
class Wind:
    r"""A force field of two parts: what blows at a place, and what turns a mass that moves aside.

    With o = x - x* the offset from the goal (of a motion that repeats from the mean of its
    samples), s = ||o|| / L, L the `reach`, c the nominal damping, F_0 = c s_0 the force that it
    opposes at the demonstrations' peak speed s_0, e the unit vector along `direction` and Q the
    quarter turn in the plane of the first two axes,

        F(x, v) = F_0 strength s^2 / (1 + s^2) e + curl c Q v.

    The first is a steady wind that leaves the goal in the lee; it can hold a mass at another place,
    where the policy commands less than the wind takes. The second is the curl field of motor
    control (Shadmehr & Mussa-Ivaldi, J. Neuroscience 14(5), 1994, eq. 9): it vanishes at rest, so
    that the mass rests where the policy has it rest, and nowhere else.
    """

    strength: float = 0.05
    """Of the steady wind far from the goal, in F_0, >= 0."""
    direction: tuple[float, ...] | None = None
    """Where it blows to (any length but 0); None takes (0.6, -0.8): aslant across and down."""
    curl: float = 0.1
    """Of the force across the velocity, in nominal damping; negative turns clockwise. In one
    dimension there is none."""
    reach: float = 0.25
    """L in diagonals of the demonstrations' bounding box: there half of the steady wind is felt."""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.strength) and self.strength >= 0):
            raise ValueError(f"Expected a wind's strength >= 0 and finite, got {self.strength!r}.")
        if not np.isfinite(self.curl):
            raise ValueError(f"Expected a finite curl of the wind, got {self.curl!r}.")
        if not (np.isfinite(self.reach) and self.reach > 0):
            raise ValueError(f"Expected a wind's reach > 0 and finite, got {self.reach!r}.")

    def unit(self, n_dims: int) -> FloatArray:
        """Return e, shape (d,)."""
        default = np.array([0.6, -0.8, *(0.0,) * n_dims])[:n_dims]
        e = default if self.direction is None else np.asarray(self.direction, dtype=np.float64)
        size = np.linalg.norm(e) if e.shape == (n_dims,) else 0.0
        if not (np.isfinite(size) and size > 0):
            raise ValueError(
                f"Expected a wind's direction to have {n_dims} finite components, not all zero, "
                f"got {self.direction!r}."
            )
        return np.asarray(e / size)


class WindField:
    """A wind over one set of demonstrations, for one mass and for many (see `Wind`).

    Its values are forces as actions; a `unit` force is c in largest forces, per speed. The
    arithmetic is that of `iflow_gym.envs.dynamics`.
    """

    def __init__(self, wind: Wind, demonstrations: Demonstrations, unit: float) -> None:
        d = demonstrations.n_dims
        self._centre: list[float] = demonstrations.centre.tolist()
        self._per_length = 1.0 / (wind.reach * demonstrations.bounding_box.diagonal)
        steady = unit * demonstrations.peak_speed * wind.strength * wind.unit(d)
        self._steady: list[float] = steady.tolist()
        self._curl = unit * wind.curl if d > 1 else 0.0

    def at(
        self, ops: Arithmetic[Component], x: Sequence[Component], v: Sequence[Component]
    ) -> list[Component]:
        """Return the d components of the force at a position and a velocity."""
        o = [(a - c) * self._per_length for a, c in zip(x, self._centre, strict=True)]
        square = dot(o, o)
        share = square / (1.0 + square)
        blown = [share * e for e in self._steady]
        if self._curl:
            blown[0] = blown[0] - self._curl * v[1]
            blown[1] = blown[1] + self._curl * v[0]
        return blown


class DisturbedControl(ForceControl):
    """Force control whose `action_for` knows the nominal mass and damping, and the plant others.

    The plant m' dv/dt = F + F_wind - c' v is integrated in closed form over a dt in which the
    action F and the wind on the state in which the dt begins are held: `ForceControl`'s equations
    with m', c' and F + F_wind.
    """

    def __init__(
        self, nominal: ForceControl, mass_ratio: float, damping_ratio: float, field: WindField
    ) -> None:
        super().__init__(nominal.mass, nominal.damping, nominal.max_force)
        self._plant = ForceControl(
            mass_ratio * nominal.mass, damping_ratio * nominal.damping, nominal.max_force
        )
        self.field = field

    def coefficients(self, dt: float) -> tuple[float, ...]:
        """Return what the plant's equations need of dt."""
        return self._plant.coefficients(dt)

    def advance(
        self,
        ops: Arithmetic[Component],
        state: Sequence[Component],
        action: Sequence[Component],
        coefficients: Sequence[Component],
        low: Sequence[float],
        high: Sequence[float],
    ) -> list[Component]:
        """Return the state one dt later; a wall stops the component that runs into it."""
        kept, glide, gain, reach = coefficients
        d = len(low)
        limit = excess(ops, action)
        wind = self.field.at(ops, state[:d], state[d:])
        positions, velocities = [], []
        for x, v, a, w, wall, far in zip(
            state[:d], state[d:], action, wind, low, high, strict=True
        ):
            force = a / limit + w
            free = x + glide * v + reach * force
            stopped = ops.smallest(ops.largest(free, wall), far)
            positions.append(stopped)
            velocities.append(ops.select(stopped == free, kept * v + gain * force, 0.0))
        return positions + velocities


class _Disturbed(PointMassInterface):
    """What the single and the batched environment add to the point mass."""

    mass_ratio: float
    damping_ratio: float
    wind: Wind
    _per_width: float
    _per_speed: float
    _shown: FloatArray
    """Samples and velocities of every recording after the other; `_offset` is where each begins."""
    _last: NDArray[np.intp]
    """Index of each recording's last sample."""
    _offset: NDArray[np.intp]

    def _disturb(self, mass_ratio: float, damping_ratio: float, wind: Wind | None) -> None:
        for name, value in (("mass_ratio", mass_ratio), ("damping_ratio", damping_ratio)):
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"Expected {name} > 0 and finite, got {value!r}.")
        if wind is not None and not isinstance(wind, Wind):
            raise TypeError(f"Expected wind to be a Wind or None, got {wind!r}.")
        self.mass_ratio, self.damping_ratio = float(mass_ratio), float(damping_ratio)
        self.wind = Wind() if wind is None else wind
        task, demos = self.task, self.demonstrations
        nominal = self._force_control()
        field = WindField(self.wind, demos, nominal.damping / nominal.max_force)
        task.control = DisturbedControl(nominal, self.mass_ratio, self.damping_ratio, field)
        self._per_width = 1.0 / (WIDTH * task.diagonal)
        self._per_speed = 1.0 / (WIDTH * demos.peak_speed)
        lengths = [len(p) for p in demos.positions]
        moving = [np.hstack(pair) for pair in zip(demos.positions, demos.velocities, strict=True)]
        self._shown = np.concatenate(moving)
        self._last = np.array(lengths) - 1
        self._offset = np.concatenate([[0], np.cumsum(lengths)[:-1]])

    def _kept(
        self, ops: Arithmetic[Component], x: Sequence[Component], shown: Sequence[Component]
    ) -> Component:
        """Return the mean of two kernels: of position and of velocity, 2 d components each."""
        d = self.n_dims
        apart = [a - p for a, p in zip(x, shown, strict=True)]
        o = [a * self._per_width for a in apart[:d]]
        u = [a * self._per_speed for a in apart[d:]]
        kept: Component = 0.5 / (1.0 + dot(o, o)) + 0.5 / (1.0 + dot(u, u))
        return kept

    def like(
        self,
        num_envs: int | None = None,
        *,
        horizon: int | None = None,
        perturbation: Push | None = None,
    ) -> Any:
        """Return an environment of the same motion and plant, or a batch of `num_envs` of them.

        Its horizon and perturbation are its own; it does not render, and has no wrappers.
        """
        settings: dict[str, Any] = {
            "horizon": horizon,
            "perturbation": perturbation,
            "mass": self.mass,
            "damping": self.damping,
            "mass_ratio": self.mass_ratio,
            "damping_ratio": self.damping_ratio,
            "wind": self.wind,
        }
        if num_envs is None:
            return DisturbedEnv(self.demonstrations, **settings)
        return DisturbedVectorEnv(self.demonstrations, num_envs, **settings)

    def wind_force(self, positions: FloatArray, velocities: FloatArray) -> FloatArray:
        """Return the wind's force, kg length/s², at positions and velocities, shape (..., d)."""
        x, v = self._vectors(positions, "position"), self._vectors(velocities, "velocity")
        control = self.task.control
        assert isinstance(control, DisturbedControl)
        parts = control.field.at(ARRAYS, list(np.moveaxis(x, -1, 0)), list(np.moveaxis(v, -1, 0)))
        return np.asarray(np.stack(parts, axis=-1) * control.max_force)


class DisturbedEnv(_Disturbed, PointMassEnv):
    r"""A `PointMassEnv` in force mode whose plant differs from what its controller is told.

    ## Description
    A policy commands a velocity; `command_to_action` turns it into the force with which the mass
    would have that velocity at the end of dt, if it had the nominal `mass` and `damping` and no
    wind blew. The plant has `mass_ratio` times the mass, `damping_ratio` times the damping, and a
    wind blows that nobody is told of, as a tool of unknown weight and a draught load a robot. So
    the mass lags behind every command and is blown aside, and a field that is stable, and knows the
    demonstrations by heart, ends at the goal and is wrong on the way.

    $$m' \dot v = F + F_\text{wind}(x, v) - c' v$$

    is integrated in closed form over a dt, with F and the wind at its beginning held. The goal lies
    in the lee, so that a policy can come to rest there. The defaults, a load of three times the own
    mass and a light wind, are such that ImitationFlow still ends at the goal: a field commands
    little where the recordings were slow, and a stronger wind holds it there.
    `env.unwrapped.wind_force(x, v)` is for pictures and tests: a policy is not to look.

    Actions, observations (with velocities) and the rest are `PointMassEnv`'s in force mode, and
    `mass` and `damping` are the nominal ones.

    ## Rewards
    How well the episode's recording i is kept, at its own time:

    $$r_t = \frac{1/2}{1 + \lVert x_t - p_{i,t} \rVert^2 / w^2}
          + \frac{1/2}{1 + \lVert v_t - \dot p_{i,t} \rVert^2 / w_v^2}$$

    with w 10 % of the diagonal of the demonstrations' bounding box, w_v 10 % of their peak speed,
    and t counted in steps; beyond the recording's end its last sample stands. 1 a step is the most.
    `PointMassEnv`'s reward, progress, is blind to what is lost here: arriving late, or beside the
    recording, costs it little. (A mean of kernels of the errors of position and velocity is the
    imitation reward of Peng et al., "DeepMimic", ACM ToG 37(4), 2018; these need no exponential,
    and their tails are longer.) From a start of the caller's choice, which has no recording, and of
    a motion that repeats, whose rounds nobody keeps in step, the reward is `PointMassEnv`'s.

    ## Arguments
    | argument | default | meaning |
    | --- | --- | --- |
    | `mass_ratio` | `4.0` | the plant's mass over the nominal one, > 0 |
    | `damping_ratio` | `3.0` | the plant's damping over the nominal one, > 0 |
    | `wind` | `None` | a `Wind(strength, direction, curl, reach)`; `None` takes its defaults |
    | the rest | | as in `PointMassEnv`, but `control_mode` |

    ## Version History
    * v0: Initial version.
    """

    def __init__(
        self,
        demonstrations: Demonstrations,
        *,
        mass_ratio: float = MASS_RATIO,
        damping_ratio: float = DAMPING_RATIO,
        wind: Wind | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(demonstrations, control_mode="force", **_without_mode(kwargs))
        self._disturb(mass_ratio, damping_ratio, wind)

    def step(
        self, action: FloatArray
    ) -> tuple[FloatArray, SupportsFloat, bool, bool, dict[str, Any]]:
        """Hold an action for one dt."""
        observation, reward, terminated, truncated, info = super().step(action)
        i = info["demonstration"]
        if i >= 0 and self.demonstrations.period is None:
            shown = self._shown[self._offset[i] + min(self._count, self._last[i])]
            reward = self._kept(FLOATS, observation.tolist(), shown.tolist())
        return observation, reward, terminated, truncated, info


class DisturbedVectorEnv(_Disturbed, PointMassVectorEnv):
    """Many of `DisturbedEnv`, stepped together: its numbers, bit for bit."""

    def __init__(
        self,
        demonstrations: Demonstrations,
        num_envs: int = 1,
        *,
        mass_ratio: float = MASS_RATIO,
        damping_ratio: float = DAMPING_RATIO,
        wind: Wind | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(demonstrations, num_envs, control_mode="force", **_without_mode(kwargs))
        self._disturb(mass_ratio, damping_ratio, wind)

    def step(
        self, actions: FloatArray
    ) -> tuple[FloatArray, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Hold an action, shape (n, d), for one dt; begin anew where the last step ended."""
        observations, rewards, terminated, truncated, info = super().step(actions)
        if self.demonstrations.period is None:
            i = self._demonstration
            shown = self._shown[self._offset[i] + np.minimum(self._count, self._last[i])]
            kept = self._kept(ARRAYS, list(observations.T), list(shown.T))
            told = (i >= 0) & (self._count > 0)  # an episode that just began has paid nothing
            rewards = np.where(told, kept, rewards)
        return observations, rewards, terminated, truncated, info


class DisturbedLASAEnv(DisturbedEnv):
    """A `DisturbedEnv` with the seven recordings of a LASA shape; lengths are millimetres."""

    def __init__(self, shape: str, **kwargs: Any) -> None:
        super().__init__(load_lasa(shape), **kwargs)


class DisturbedLASAVectorEnv(DisturbedVectorEnv):
    """A `DisturbedVectorEnv` with the seven recordings of a LASA shape."""

    def __init__(self, shape: str, num_envs: int = 1, **kwargs: Any) -> None:
        super().__init__(load_lasa(shape), num_envs, **kwargs)


def _without_mode(kwargs: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments of the point mass without `control_mode`, which has one value here."""
    if (mode := kwargs.pop("control_mode", "force")) != "force":
        raise ValueError(
            f"Expected control_mode='force', got {mode!r}: in velocity mode there is no mass for a "
            "wind to blow at; use the undisturbed environment."
        )
    return kwargs
