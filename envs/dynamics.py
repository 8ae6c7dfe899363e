"""The point mass in motion: arithmetic shared by the single and the batched environment.

Everything is written once, for one mass and for many. A *component* is a float (one mass) or an
array of shape (n,) (n masses); a vector is a sequence of d components. Only operations that
IEEE 754 rounds correctly are used on them (+, -, *, /, square root, comparison), so a batch gives
the same bits as its masses one by one. Exponentials depend on dt alone and are taken once, when an
episode begins.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar, cast

import numpy as np

from iflow_gym.demonstrations import FloatArray

Component = TypeVar("Component", float, FloatArray)


class Table(NamedTuple):
    """Rows that are looked up by an index, laid out for a float and for an array."""

    rows: Any
    """Indexed by an int: a list of tuples of floats, or a memory view of ints."""
    array: np.ndarray[Any, Any]
    """Indexed on its first axis by an integer array."""


@dataclass(frozen=True, slots=True)
class Arithmetic(Generic[Component]):
    """The few functions that differ between a float and an array."""

    largest: Callable[[Any, Any], Component]
    smallest: Callable[[Any, Any], Component]
    root: Callable[[Component], Component]
    whole: Callable[[Component], Any]
    """Truncate to an index."""
    pick: Callable[[Table, Any], Any]
    """Look a row up in a table by its index; of an array of rows the columns come back."""
    select: Callable[[Any, Any, Any], Component]
    """The second argument where the first is true, else the third."""


FLOATS: Arithmetic[float] = Arithmetic(
    largest=max,
    smallest=min,
    root=math.sqrt,
    whole=int,
    pick=lambda table, index: table.rows[index],
    select=lambda condition, yes, no: yes if condition else no,
)

ARRAYS: Arithmetic[FloatArray] = Arithmetic(
    largest=np.maximum,
    smallest=np.minimum,
    root=np.sqrt,
    whole=lambda values: values.astype(np.intp),
    pick=lambda table, index: table.array.take(index, axis=0).T.copy(),
    select=cast("Callable[[Any, Any, Any], FloatArray]", np.where),
)


def dot(left: Sequence[Component], right: Sequence[Component]) -> Component:
    """Return the inner product of two vectors, summed from the first component on."""
    total: Component = reduce(operator.add, map(operator.mul, left, right))
    return total


def excess(ops: Arithmetic[Component], action: Sequence[Component]) -> Component:
    """Return what an action is divided by to fit the box [-1, 1]: its largest component, or 1.

    The whole action is scaled, never one component alone: a scaled stable field is still stable,
    a bent one need not be.
    """
    one: Any = 1.0
    largest: Component = reduce(ops.largest, map(abs, action), one)
    return largest


def scaled_into_box(action: FloatArray) -> FloatArray:
    """Scale actions, shape (..., d), by their largest component where it exceeds 1."""
    largest = np.abs(action).max(axis=-1, keepdims=True)
    return np.asarray(action / np.maximum(largest, 1.0))


class VelocityControl:
    """The action is the velocity for one dt: x' = x + dt max_speed a."""

    name: ClassVar[str] = "velocity"
    blocks: ClassVar[int] = 1
    """The state is d components of position."""

    def __init__(self, max_speed: float) -> None:
        self.max_speed = max_speed

    def coefficients(self, dt: float) -> tuple[float, ...]:
        """Return what depends on dt alone."""
        return (dt * self.max_speed,)

    def advance(
        self,
        ops: Arithmetic[Component],
        state: Sequence[Component],
        action: Sequence[Component],
        coefficients: Sequence[Component],
        low: Sequence[float],
        high: Sequence[float],
    ) -> list[Component]:
        """Return the state one dt later; the mass stops at the walls `low` and `high`."""
        reach = coefficients[0] / excess(ops, action)
        return [
            ops.smallest(ops.largest(x + reach * a, wall), far)
            for x, a, wall, far in zip(state, action, low, high, strict=True)
        ]

    def action_for(
        self, command: FloatArray, observation: FloatArray, dt: float | FloatArray
    ) -> FloatArray:
        """Return the action of a velocity command, shape (..., d), scaled into the box."""
        return scaled_into_box(command / self.max_speed)


class ForceControl:
    """The action is a force on a mass with viscous damping: m dv/dt = F - c v.

    The force is held for one dt, over which the equation has the closed form

        v' = e v + (1 - e) F / c,    x' = x + s v + (dt - s) F / c,
        e = exp(-c dt / m),          s = (1 - e) m / c.
    """

    name: ClassVar[str] = "force"
    blocks: ClassVar[int] = 2
    """The state is d components of position, then d of velocity."""

    def __init__(self, mass: float, damping: float, max_force: float) -> None:
        self.mass, self.damping, self.max_force = mass, damping, max_force

    def coefficients(self, dt: float) -> tuple[float, ...]:
        """Return e, s, and the gains of the action on velocity and on position."""
        kept = math.exp(-self.damping * dt / self.mass)
        lost = -math.expm1(-self.damping * dt / self.mass)
        glide = lost * self.mass / self.damping
        terminal_speed = self.max_force / self.damping
        return kept, glide, lost * terminal_speed, (dt - glide) * terminal_speed

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
        gain, reach = gain / limit, reach / limit
        positions, velocities = [], []
        for x, v, a, wall, far in zip(state[:d], state[d:], action, low, high, strict=True):
            free = x + glide * v + reach * a
            stopped = ops.smallest(ops.largest(free, wall), far)
            positions.append(stopped)
            velocities.append(ops.select(stopped == free, kept * v + gain * a, 0.0))
        return positions + velocities

    def action_for(
        self, command: FloatArray, observation: FloatArray, dt: float | FloatArray
    ) -> FloatArray:
        """Return the force that reaches a velocity command after dt, as an action in the box."""
        velocity = observation[..., command.shape[-1] :]
        rate = np.asarray(dt)[..., None] * (self.damping / self.mass)
        force = self.damping * (command - np.exp(-rate) * velocity) / -np.expm1(-rate)
        return scaled_into_box(force / self.max_force)


Control = VelocityControl | ForceControl
