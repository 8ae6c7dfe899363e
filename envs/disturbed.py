"""A point mass that is not what its controller takes it for, in a wind: `iflow/Disturbed-*-v0`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.envs.dynamics import Arithmetic, Component, ForceControl, dot, excess
from iflow_gym.envs.guide import CycleGuide, GoalGuide, Guide
from iflow_gym.envs.point_mass import PointMassEnv
from iflow_gym.envs.point_mass_vector import PointMassVectorEnv
from iflow_gym.envs.task import PointMassInterface, Push

MASS_RATIO = 2.0
"""Mass of the plant over the nominal one."""

DAMPING_RATIO = 1.5
"""Damping of the plant over the nominal one."""


@dataclass(frozen=True)
class Wind:
    r"""A smooth, bounded force field that leaves the goal in the lee.

    With o = x - x* the offset from the goal (of a motion that repeats from the mean of its
    samples), L the `reach`, s = ||o|| / L, F_0 = c s_0 the force that damping opposes at the
    demonstrations' peak speed s_0 (c the nominal damping), e the unit vector along `direction`, and
    Q the quarter turn in the plane of the first two axes,

        F(x) = F_0 s^2 / (1 + s^2) (strength e + swirl Q o / ||o||).

    So ||F|| <= F_0 (strength + swirl), F vanishes at x* with its first derivatives, and far away it
    is a steady wind and a vortex about the goal.
    """

    strength: float = 0.4
    """Of the steady wind far from the goal, in F_0."""
    direction: tuple[float, ...] | None = None
    """Where it blows to (any length but 0); None takes (0.6, -0.8): aslant across and down."""
    swirl: float = 0.1
    """Of the vortex round the goal, in F_0; negative turns clockwise."""
    reach: float = 0.25
    """L in diagonals of the demonstrations' bounding box: there half of the wind is felt."""

    def __post_init__(self) -> None:
        for name in ("strength", "swirl"):
            if not np.isfinite(value := getattr(self, name)):
                raise ValueError(f"Expected a finite {name} of the wind, got {value!r}.")
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

    Its values are forces as actions: `scale` is F_0 in largest forces. The arithmetic is that of
    `iflow_gym.envs.dynamics`.
    """

    def __init__(self, wind: Wind, demonstrations: Demonstrations, scale: float) -> None:
        d = demonstrations.n_dims
        self._centre: list[float] = demonstrations.centre.tolist()
        self._per_length = 1.0 / (wind.reach * demonstrations.bounding_box.diagonal)
        self._steady: list[float] = (scale * wind.strength * wind.unit(d)).tolist()
        self._swirl = scale * wind.swirl if d > 1 else 0.0

    def at(self, ops: Arithmetic[Component], x: Sequence[Component]) -> list[Component]:
        """Return the d components of the force at a position."""
        o = [(a - c) * self._per_length for a, c in zip(x, self._centre, strict=True)]
        square = dot(o, o)
        share = 1.0 / (1.0 + square)
        blown = [square * e for e in self._steady]
        if self._swirl:
            turning = self._swirl * ops.root(square)
            blown[0] = blown[0] - turning * o[1]
            blown[1] = blown[1] + turning * o[0]
        return [share * f for f in blown]


class DisturbedControl(ForceControl):
    """Force control whose `action_for` knows the nominal mass and damping, and the plant others.

    The plant m' dv/dt = F + F_wind - c' v is integrated in closed form over a dt in which the
    action F and the wind at the position where the dt begins are held: `ForceControl`'s equations
    with m', c' and F + F_wind.
    """

    def __init__(
        self, nominal: ForceControl, mass_ratio: float, damping_ratio: float, field: WindField
    ) -> None:
        super().__init__(nominal.mass, nominal.damping, nominal.max_force)
        self._plant = ForceControl(
            mass_ratio * nominal.mass, damping_ratio * nominal.damping, nominal.max_force
        )
        self._field = field

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
        wind = self._field.at(ops, state[:d])
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


class PacedGoalGuide(GoalGuide):
    """Along a motion that ends, at the demonstrated tempo, to its goal."""

    def reward(
        self,
        ops: Arithmetic[Component],
        x: Sequence[Component],
        x_next: Sequence[Component],
        dt: Component,
        distance: Component,
    ) -> Component:
        """Return the reward of a step: 1 at the goal, elsewhere the demonstrated tempo pays most.

        That of motions that repeat, r = <u, n> s_k / max(||u||, s_k)^2.
        """
        made, pace, shown = self._progress(ops, x, x_next, dt)
        share = ops.largest(ops.smallest(made * shown / (pace * pace), 1.0), -1.0)
        return ops.select(distance <= self.tolerance, 1.0, share)


@lru_cache(maxsize=64)
def paced_guide_for(demonstrations: Demonstrations) -> Guide:
    """Return the guide of a set of demonstrations for which tempo counts."""
    return (PacedGoalGuide if demonstrations.period is None else CycleGuide)(demonstrations)


class _Disturbed(PointMassInterface):
    """What the single and the batched environment add to the point mass."""

    mass_ratio: float
    damping_ratio: float
    wind: Wind

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
        scale = nominal.damping * demos.peak_speed / nominal.max_force
        field = WindField(self.wind, demos, scale)
        task.control = DisturbedControl(nominal, self.mass_ratio, self.damping_ratio, field)
        task.guide = paced_guide_for(demos.shown)

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

    def wind_force(self, positions: FloatArray) -> FloatArray:
        """Return the wind's force, kg length/s², at positions, shape (..., d) both."""
        from iflow_gym.envs.dynamics import ARRAYS

        x = self._vectors(positions, "position")
        control = self.task.control
        assert isinstance(control, DisturbedControl)
        parts = control._field.at(ARRAYS, list(np.moveaxis(x, -1, 0)))
        return np.asarray(np.stack(parts, axis=-1) * control.max_force)


class DisturbedEnv(_Disturbed, PointMassEnv):
    r"""A `PointMassEnv` in force mode whose plant differs from what its controller is told.

    ## Description
    A policy commands a velocity; `command_to_action` turns it into the force with which the mass
    would have that velocity at the end of dt, if it had the nominal `mass` and `damping` and no
    wind blew. The plant has `mass_ratio` times the mass, `damping_ratio` times the damping, and a
    wind blows that nobody is told of, as a tool of unknown weight and a draught or a loose cable
    load a robot. So the mass lags behind every command and is blown aside, and a field that is
    stable, and knows the demonstrations by heart, ends at the goal and is wrong on the way.

    $$m' \dot v = F + F_\text{wind}(x) - c' v$$

    is integrated in closed form over a dt, with F and the wind at its beginning held. The goal lies
    in the lee, $F_\text{wind}(x^*) = 0$, so that a policy can come to rest there;
    `iflow_gym.envs.disturbed.Wind` has the field. `env.unwrapped.wind_force(x)` is for pictures and
    tests: a policy is not to look.

    Actions, observations (with velocities) and the rest are `PointMassEnv`'s in force mode, and
    `mass` and `damping` are the nominal ones.

    ## Rewards
    `PointMassEnv`'s of a motion that repeats, which pays the demonstrated tempo most, and 1 where
    x' is within the goal's tolerance: here tempo is what is lost. With the reward of a motion that
    ends hurrying costs nothing.

    ## Arguments
    | argument | default | meaning |
    | --- | --- | --- |
    | `mass_ratio` | `2.0` | the plant's mass over the nominal one, > 0 |
    | `damping_ratio` | `1.5` | the plant's damping over the nominal one, > 0 |
    | `wind` | `None` | a `Wind(strength, direction, swirl, reach)`; `None` takes its defaults |
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
