"""One state at a time: the mean dynamics in a control loop, on NumPy alone.

    x -> h(phi_t(h^-1(x - x*))),    phi_t the latent system over a time t.

For a single state the arithmetic is nothing and the calls are everything: a NumPy call costs some
0.3 us, a Python float some 0.02. So a layer is two products and a tanh on vectors that are
allocated once, and everything about its few coordinates is done in floats: see `fields.points`.
Flows of other kinds go through their batch of one. Equal to the batched path up to rounding.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
import scipy.linalg

from iflow_gym.baselines.imitation_flow.fields.autoregressive import AutoregressiveField
from iflow_gym.baselines.imitation_flow.fields.autoregressive_point import autoregressive_point
from iflow_gym.baselines.imitation_flow.fields.base import FlowField
from iflow_gym.baselines.imitation_flow.fields.coupling import CouplingField
from iflow_gym.baselines.imitation_flow.fields.coupling_point import coupling_point
from iflow_gym.baselines.imitation_flow.fields.spline import SplineField
from iflow_gym.baselines.imitation_flow.fields.spline_point import SplinePoint
from iflow_gym.demonstrations import FloatArray

Vector = list[float]

N_TIMES = 256
"""How many exp(A t) are kept; a policy that keeps below a speed limit asks for many times."""


class Latent(Protocol):
    """A latent system in batches: with `drift`, or with `decay`, `turn` and `radius`, it is fast.

    See `fields.latents`, where `LinearField` has the first and `CycleField` the others.
    """

    def rate(self, z: FloatArray) -> FloatArray:
        """Return dz/dt, (n, d)."""

    def propagate(self, z: FloatArray, times: FloatArray) -> FloatArray:
        """Return the states a time (n,) after z, (n, d)."""


class PointFlow(Protocol):
    """A flow for one state (d,)."""

    def forward(self, z: Vector) -> Vector:
        """Return h(z)."""

    def inverse(self, y: Vector) -> Vector:
        """Return h^-1(y)."""

    def push_forward(self, z: Vector, dz: Vector) -> tuple[Vector, Vector]:
        """Return h(z) and J_h(z) dz."""


@dataclass(frozen=True)
class MeanDynamics:
    """What the mean dynamics of a trained model are made of.

    Attributes
    ----------
    flow : FlowField
        h.
    latent : Latent
        Its times are in units of `time`.
    attractor : array, shape (d,)
        h^-1(0), the place of the latent system's origin; zeros for a cycle.
    origin : array, shape (d,)
        The state x* that is the flow's origin.
    frame : array, shape (d, d)
        x = frame y + origin.
    time : float
        Seconds in a unit of latent time.
    """

    flow: FlowField
    latent: Latent
    attractor: FloatArray
    origin: FloatArray
    frame: FloatArray
    time: float


class RealTimeStepper:
    """Steps one state (d,) at a time, without a batch and without autograd.

    The work vectors belong to the stepper, so calls from several threads wait for each other. A
    copy or a pickle of a stepper has its own.

    Examples
    --------
    >>> stepper = RealTimeStepper(dynamics)  # doctest: +SKIP
    >>> x = stepper.step(x, 0.01)  # doctest: +SKIP
    """

    def __init__(self, dynamics: MeanDynamics) -> None:
        self.dynamics = dynamics
        self._lock = threading.Lock()
        flow = dynamics.flow
        self._flow = point_flow(flow)
        self._propagate, self._rate = point_latent(dynamics.latent)
        frame = np.asarray(dynamics.frame, dtype=np.float64)
        self._frame: list[Vector] = frame.tolist()
        self._back: list[Vector] = np.linalg.inv(frame).tolist()
        self._origin, self._attractor = dynamics.origin.tolist(), dynamics.attractor.tolist()

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.dynamics,)

    def step(self, x: FloatArray, dt: float) -> FloatArray:
        """Return the state (d,) a time dt (seconds, > 0) after x (d,)."""
        with self._lock:
            z = self._propagate(self._encode(x), float(dt) / self.dynamics.time)
            y = self._flow.forward([a + b for a, b in zip(z, self._attractor, strict=True)])
            return np.array(
                [v + o for v, o in zip(_apply(self._frame, y), self._origin, strict=True)]
            )

    def velocity(self, x: FloatArray) -> FloatArray:
        """Return dx/dt (d,) in x (d,), in length/s."""
        with self._lock:
            z = self._encode(x)
            place = [a + b for a, b in zip(z, self._attractor, strict=True)]
            _, rate = self._flow.push_forward(place, self._rate(z))
            return np.array(_apply(self._frame, rate)) / self.dynamics.time

    def _encode(self, x: FloatArray) -> Vector:
        y = _apply(self._back, [a - b for a, b in zip(x.tolist(), self._origin, strict=True)])
        return [a - b for a, b in zip(self._flow.inverse(y), self._attractor, strict=True)]


def point_flow(flow: FlowField) -> PointFlow:
    """Return a flow and its inverse for one state; not for several threads at once."""
    if isinstance(flow, CouplingField):
        return coupling_point(flow)
    if isinstance(flow, AutoregressiveField):
        return autoregressive_point(flow)
    if isinstance(flow, SplineField):
        return SplinePoint(flow)
    return BatchOfOne(flow)


class BatchOfOne:
    """Any flow for one state, through its batch."""

    def __init__(self, flow: FlowField) -> None:
        self._flow = flow

    def forward(self, z: Vector) -> Vector:
        """Return h(z)."""
        return _first(self._flow.forward(np.array([z])))

    def inverse(self, y: Vector) -> Vector:
        """Return h^-1(y)."""
        return _first(self._flow.inverse(np.array([y]))[0])

    def push_forward(self, z: Vector, dz: Vector) -> tuple[Vector, Vector]:
        """Return h(z) and J_h(z) dz."""
        y, dy = self._flow.push_forward(np.array([z]), np.array([dz]))
        return _first(y), _first(dy)


def point_latent(
    latent: Latent,
) -> tuple[Callable[[Vector, float], Vector], Callable[[Vector], Vector]]:
    """Return (z, t) -> the state a time t after z, and z -> dz/dt, for one state."""
    if (drift := getattr(latent, "drift", None)) is not None:
        return linear(drift)
    if hasattr(latent, "turn") and hasattr(latent, "radius"):
        return cycle(latent.decay.tolist(), latent.turn, latent.radius)  # type: ignore[attr-defined]
    return (
        lambda z, t: _first(latent.propagate(np.array([z]), np.array([t]))),
        lambda z: _first(latent.rate(np.array([z]))),
    )


def linear(
    drift: FloatArray,
) -> tuple[Callable[[Vector, float], Vector], Callable[[Vector], Vector]]:
    """Return the two functions of dz = A z dt; exp(A t) is kept for the latest times."""
    rows: list[Vector] = drift.tolist()

    @lru_cache(maxsize=N_TIMES)
    def propagator(t: float) -> list[Vector]:
        if len(rows) == 2:
            return _planar_exponential(rows, t)
        result: list[Vector] = scipy.linalg.expm(drift * t).tolist()
        return result

    return lambda z, t: _apply(propagator(t), z), lambda z: _apply(rows, z)


def cycle(
    decay: Vector, turn: float, radius: float
) -> tuple[Callable[[Vector, float], Vector], Callable[[Vector], Vector]]:
    """Return the two functions of d rho = -a (rho - rho*), d psi = b, d z_j = -a_j z_j."""
    first, others = decay[0], decay[1:]

    def propagate(z: Vector, t: float) -> Vector:
        rho, angle = math.hypot(z[0], z[1]), math.atan2(z[1], z[0]) + turn * t
        rho = radius + (rho - radius) * math.exp(-first * t)
        extra = [v * math.exp(-a * t) for v, a in zip(z[2:], others, strict=True)]
        return [rho * math.cos(angle), rho * math.sin(angle), *extra]

    def rate(z: Vector) -> Vector:
        rho = math.hypot(z[0], z[1])
        cos, sin = (z[0] / rho, z[1] / rho) if rho > 0 else (1.0, 0.0)
        inward, around = first * (radius - rho), turn * rho
        extra = [-a * v for v, a in zip(z[2:], others, strict=True)]
        return [inward * cos - around * sin, inward * sin + around * cos, *extra]

    return propagate, rate


def _planar_exponential(rows: list[Vector], t: float) -> list[Vector]:
    """exp(A t) = even I + odd (A - m I), m = tr A / 2: see `latent`."""
    (a, b), (c, d) = rows
    mean, half = (a + d) / 2, (a - d) / 2
    square = half * half + b * c  # of the eigenvalues' distance to their mean
    root = math.sqrt(abs(square)) * t
    if root < 1e-2:
        signed = math.copysign(root * root, square)
        decay = math.exp(mean * t)
        even = decay * (1 + signed / 2 + signed * signed / 24)
        odd = decay * t * (1 + signed / 6 + signed * signed / 120)
    elif square > 0:  # without cosh, which overflows over a long time
        slow, less = math.exp(mean * t + root), math.expm1(-2 * root)
        even, odd = slow * (1 + less / 2), -slow * less / 2 * t / root
    else:
        decay = math.exp(mean * t)
        even, odd = decay * math.cos(root), decay * math.sin(root) * t / root
    return [[even + odd * half, odd * b], [odd * c, even - odd * half]]


def _apply(rows: list[Vector], vector: Vector) -> Vector:
    if len(vector) == 2:
        (a, b), (c, d) = rows
        x, y = vector
        return [a * x + b * y, c * x + d * y]
    return [sum(map(float.__mul__, row, vector)) for row in rows]


def _first(states: FloatArray) -> Vector:
    result: Vector = states[0].tolist()
    return result
