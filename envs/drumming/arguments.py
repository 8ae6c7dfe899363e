"""What the drumming environment is asked for, checked where it comes in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.envs.drumming.control import CONTROL_DT, Workspace
from iflow_gym.envs.task import RESET_OPTIONS, Push

ControlMode = Literal["velocity", "torque"]

OBSERVABLES: Final = ("tip", "tip_velocity", "joints", "force", "phase")
"""What an observation can be made of."""


@dataclass(frozen=True)
class ForcePush:
    """A perturbation: a steady force on the stick's tip for a while."""

    fraction: float = 0.5
    """When it begins: this fraction of the way, counted in the demonstration's own steps. Half way
    is the middle of the third stroke of the demonstrations of `iflow/Drumming-v0`."""
    impulse: float = 4.0
    """Force times duration, in N s."""
    duration: float = 0.1
    """In s; rounded to control steps, at least one."""
    direction: tuple[float, float, float] | None = None
    """Where to (any length but 0); None draws a direction from the environment's generator."""

    def __post_init__(self) -> None:
        if not 0 < self.fraction <= 1:
            raise ValueError(f"Expected a push's fraction in (0, 1], got {self.fraction}.")
        if not (np.isfinite(self.impulse) and self.impulse >= 0):
            raise ValueError(f"Expected a push's impulse >= 0 and finite, got {self.impulse}.")
        if not (np.isfinite(self.duration) and self.duration > 0):
            raise ValueError(f"Expected a push's duration > 0 and finite, got {self.duration}.")


def checked_demonstrations(demonstrations: Demonstrations) -> Demonstrations:
    """Return demonstrations that the arm can be asked for; raise for others."""
    if not isinstance(demonstrations, Demonstrations):
        raise TypeError(
            f"Expected Demonstrations, got {type(demonstrations).__name__}: make them with "
            "Demonstrations.from_arrays(..., period=...)."
        )
    if demonstrations.n_dims != 3 or demonstrations.period is None:
        raise ValueError(
            "Expected demonstrations of a cycle in 3-D, got "
            f"{demonstrations.n_dims} dimensions and period {demonstrations.period}."
        )
    if any(abs(dt - CONTROL_DT) > 1e-9 for dt in demonstrations.dt):
        raise ValueError(
            f"Expected demonstrations with dt = {CONTROL_DT} s, the arm's control step, got "
            f"{demonstrations.dt}: resample them."
        )
    if not np.all([Workspace.contains(p).all() for p in demonstrations.positions]):
        raise ValueError(
            "Expected demonstrations within the arm's workspace, x, y, z from "
            f"{Workspace.low.tolist()} to {Workspace.high.tolist()}, got samples outside: move "
            "them by a rigid transform."
        )
    return demonstrations


def checked_parts(observe: Sequence[str]) -> tuple[str, ...]:
    """Return the parts of an observation."""
    parts = (observe,) if isinstance(observe, str) else tuple(observe)
    if unknown := [name for name in parts if name not in OBSERVABLES]:
        raise ValueError(f"Expected observe among {list(OBSERVABLES)}, got {unknown}.")
    if parts[:1] != ("tip",) or len(set(parts)) < len(parts):
        raise ValueError(
            f"Expected observe to begin with 'tip' and to name each part once, got {parts}: a "
            "policy finds the position first."
        )
    return parts


def checked_push(push: Push | ForcePush | None) -> Push | ForcePush | None:
    """Return a perturbation whose direction, if it has one, is one in space."""
    if push is None:
        return None
    if not isinstance(push, Push | ForcePush):
        raise TypeError(f"Expected perturbation to be a Push, a ForcePush or None, got {push!r}.")
    if push.direction is not None:
        direction = np.asarray(push.direction, dtype=np.float64)
        length = np.linalg.norm(direction) if direction.shape == (3,) else 0.0
        if not (np.isfinite(length) and length > 0):
            raise ValueError(
                "Expected a push's direction to have 3 finite components, not all zero, got "
                f"{push.direction!r}."
            )
    return push


def vectors(values: ArrayLike, label: str) -> FloatArray:
    """Return vectors, shape (..., 3), as float64."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim == 0 or array.shape[-1] != 3:
        raise ValueError(f"Expected a {label} of shape (..., 3), got {array.shape}.")
    return array


def checked_options(
    demonstrations: Demonstrations, options: Mapping[str, Any] | None
) -> tuple[int | None, FloatArray | None]:
    """Return the demonstration and the start that reset options ask for, None where not given."""
    options = options or {}
    if unknown := sorted(set(options) - set(RESET_OPTIONS)):
        raise ValueError(
            f"Expected reset options among {list(RESET_OPTIONS)}, got {unknown}: use "
            "{'demonstration': i} to start where recording i does, {'start': x} to start at x."
        )
    index, start = options.get("demonstration"), options.get("start")
    if index is not None:
        count = len(demonstrations)
        number = np.asarray(index)
        if number.dtype.kind not in "iu" or number.shape not in ((), (1,)):
            raise TypeError(
                "Expected options['demonstration'] to be a whole number from 0 to "
                f"{count - 1}, got {index!r}."
            )
        index = int(number.reshape(()))
        if not 0 <= index < count:
            raise ValueError(
                f"Expected options['demonstration'] from 0 to {count - 1} ({count} recordings "
                f"of {demonstrations.name!r}), got {index}."
            )
    if start is not None:
        try:
            start = np.asarray(start, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise TypeError(f"Expected options['start'] to be numbers, got {start!r}.") from error
        if start.shape != (3,) or not np.isfinite(start).all():
            raise ValueError(
                f"Expected options['start'] to be a finite position of shape (3,), got {start!r}."
            )
    return index, start
