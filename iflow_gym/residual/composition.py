"""The arithmetic of residuals: what an agent sees, and what becomes of what it adds.

With c the base's velocity command, a the agent's action and `scale` the largest residual in
greatest speeds, the command is

    u = c + r,    r = scale max_speed a,

where a `LyapunovShield` may change r. The environment's `command_to_action` carries u out in
whichever way it is controlled: as a velocity, a force, or the joint torques of an arm. With a = 0
that is the base's own action, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from iflow_gym.demonstrations import FloatArray
from iflow_gym.residual.bases import BoolArray, base_of
from iflow_gym.residual.shield import RATE_SHARE, LyapunovShield
from iflow_gym.system import DynamicalSystem

SCALE = 0.1
"""Default of the largest residual in greatest speeds: half of the demonstrations' peak speed."""

NEAR = 0.05
"""Width of the lens on the goal in diagonals of the demonstrations' bounding box."""

Features = NDArray[np.float32]


class Composition:
    """A base in a task, and how an agent's actions are added to its commands.

    Parameters
    ----------
    task : environment of iflow_gym, unwrapped, single or batched, or like one
        Its `n_dims`, `max_speed`, `demonstrations` and `command_to_action` are used, and the space
        of its observations, whose position comes first.
    base_policy : Method, policy or None
        See `iflow_gym.residual.bases.base_of`.
    scale : float
        In (0, 1].
    stable : bool or float
        Whether the residual is projected so that the base's Lyapunov function falls; a number is
        the shield's `rate_share`.
    """

    def __init__(
        self, task: Any, base_policy: Any, scale: float = SCALE, stable: bool | float = False
    ) -> None:
        if not 0 < scale <= 1:
            raise ValueError(f"Expected scale in (0, 1], a share of max_speed, got {scale!r}.")
        self.task = task
        self.n_dims: int = task.n_dims
        self.base = base_of(base_policy, task)
        self.largest = float(scale) * float(task.max_speed)
        self.shield: LyapunovShield | None = None
        if stable is not False:
            share = RATE_SHARE if stable is True else float(stable)
            self.shield = LyapunovShield(lyapunov_of(base_policy), task.max_speed, share)
        single = getattr(task, "single_observation_space", task.observation_space)
        demos = task.demonstrations
        box, d, width = demos.bounding_box, self.n_dims, single.shape[0]
        centre = ((single.high + single.low) / 2).astype(np.float64)
        half = ((single.high - single.low) / 2).astype(np.float64)
        centre[:d], half[:d] = (box.high + box.low) / 2, box.diagonal / 2
        if width == 2 * d:  # velocities
            centre[d:], half[d:] = 0.0, demos.peak_speed
        self._centre, self._half, self._peak = centre, half, demos.peak_speed
        self.action_space = spaces.Box(-1.0, 1.0, (d,), np.float32)
        self._goal = demos.goal
        self._near = NEAR * box.diagonal
        near = np.ones(0 if self._goal is None else d)
        fastest = np.full(d, task.max_speed / self._peak)
        seen = np.concatenate([(single.high - centre) / half, fastest, near])
        low = np.concatenate([(single.low - centre) / half, -fastest, -near])
        self.observation_space = spaces.Box(
            low.astype(np.float32), seen.astype(np.float32), dtype=np.float32
        )

    def features(self, observations: FloatArray, command: FloatArray) -> Features:
        """Return what the agent sees, float32, of order 1: shape (n, observation + d), or of a
        motion that ends (n, observation + 2 d).

        The environment's observation, positions about the middle of the demonstrations' bounding
        box in half diagonals, velocities in the demonstrations' peak speed, anything else in half
        the width of its range; then the base's command in peak speeds; and of a motion that ends
        the offset o from the goal under a lens, o / sqrt(||o||^2 + w^2) with w 5 % of the diagonal,
        since the goal's tolerance is a fiftieth of what the rest resolves. Cut at the space's
        bounds.
        """
        parts = [(observations - self._centre) / self._half, command / self._peak]
        if self._goal is not None:
            offset = observations[:, : self.n_dims] - self._goal
            square = np.einsum("ni,ni->n", offset, offset)
            parts.append(offset / np.sqrt(square + self._near**2)[:, None])
        seen = np.concatenate(parts, axis=-1).astype(np.float32)
        return np.asarray(np.clip(seen, self.observation_space.low, self.observation_space.high))

    def positions(self, features: FloatArray) -> FloatArray:
        """Return the positions, shape (n, d), that features show."""
        d = self.n_dims
        return np.asarray(features[:, :d] * self._half[:d] + self._centre[:d])

    def allowance(
        self, observations: FloatArray, dt: FloatArray, before: FloatArray | None, begun: BoolArray
    ) -> FloatArray | None:
        """Return the shield's W for `commanded`, (n,), from that of the step before; see there."""
        if self.shield is None:
            return None
        return self.shield.allowance(observations[:, : self.n_dims], dt, before, begun)

    def commanded(
        self,
        observations: FloatArray,
        command: FloatArray,
        actions: FloatArray,
        dt: FloatArray,
        allowance: FloatArray | None = None,
    ) -> FloatArray:
        """Return u, shape (n, d), for the base's `command` and the agent's actions, (n, d) each."""
        added = np.clip(np.asarray(actions, dtype=np.float64), -1.0, 1.0) * self.largest
        if self.shield is not None:
            x = observations[:, : self.n_dims]
            added = self.shield.kept(x, command, added, dt, allowance)
        return np.asarray(command + added)

    def checked(self, actions: Any, shape: tuple[int, ...]) -> FloatArray:
        """Return the agent's actions as float64; raise ValueError unless finite and of a shape."""
        values = np.asarray(actions, dtype=np.float64)
        if values.shape != shape:
            raise ValueError(f"Expected residual actions of shape {shape}, got {values.shape}.")
        if not np.isfinite(values).all():
            raise ValueError("Expected finite residual actions, got NaN or infinity.")
        return values


def lyapunov_of(base_policy: Any) -> Any:
    """Return the Lyapunov function of a base in closed form.

    A method of another package offers one by a method ``lyapunov_function()`` that returns a
    `LyapunovFunction`.

    Raises
    ------
    ValueError
        If the base has none.
    """
    system = getattr(base_policy, "method", base_policy)
    own: Callable[[], Any] | None = getattr(system, "lyapunov_function", None)
    if own is not None:
        return own()
    from iflow_gym.baselines.lyapunov import lyapunov_function

    found = lyapunov_function(system)
    if found is not None:
        return found
    what = "a Lyapunov function" if isinstance(system, DynamicalSystem) else "a field"
    raise ValueError(
        f"Expected a base with the gradient of {what} for a stable residual, got "
        f"{type(system).__name__}: use ImitationFlow, give your method lyapunov_function(), or "
        "leave stable out."
    )


def starts_of(n: int, value: bool) -> BoolArray:
    """Return n times the same."""
    return np.full(n, value, dtype=np.bool_)
