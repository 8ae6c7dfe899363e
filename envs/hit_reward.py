r"""A reward for drumming that hears the drums: `HitReward`.

The reward of `iflow/Drumming-v0` is progress along the demonstrated path. It sees no hit, and pays
an arm that passes above the heads more than one that strikes them, since way down and way up lie
side by side there. Here half is paid for keeping the recording and half for the strokes.

**Keeping**, at each step, of the episode's recording i at its own time, with w 10 % of the diagonal
of the demonstrations' bounding box and w_v 10 % of their peak speed:

    k_t = 1 / (1 + ||x_t - p_{i,t}||^2 / w^2) / 2 + 1 / (1 + ||v_t - p'_{i,t}||^2 / w_v^2) / 2.

Beyond the recording's end and from a start of the caller's choice the environment's own reward
takes its place. (A mean of kernels of the errors of position and velocity, as in Peng et al.,
"DeepMimic", ACM ToG 37(4), 2018, and in `iflow_gym.envs.disturbed`.)

**A stroke** on drum d at time t with force f, after one on drum b at time s, pays when it is
reported, 0.05 s later,

    W / (1 + e^2 / tau^2) / (1 + (f - f_0)^2 / (f_0 / 2)^2),    e = t - s - T_{b,d},

T_{b,d} the mean interval from b to d in the demonstrations' scores, tau = 50 ms the tolerance of
the metrics, f_0 the force of the recordings' strokes; -W where no recording goes from b to d. The
first stroke's e is its distance from the recording's own first note; from a start of the caller's
choice any first stroke is in time. W is half of the steps between two notes, so that

    r = k_t / 2 + (strokes)

is at most about 1 a step. A policy knows neither which recording it is to keep nor its tempo: one
that drums the recordings' mean rhythm gets about as much as a replay of a recording, whose
intervals are off the mean.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple, SupportsFloat

import gymnasium
import numpy as np

from iflow_gym.demonstrations import FloatArray
from iflow_gym.metrics.drumming import TOLERANCE, Hit

WIDTH: Final = 0.1
"""Widths of the kernels of keeping, in diagonals and in peak speeds: this far off they pay half."""

FORCE: Final = 6.4
"""Median force in N of the strokes of the suite's six recordings, as the arm plays them back."""


class Stroke(NamedTuple):
    """How a hit compares with what the demonstrations do."""

    hit: Hit
    error: float | None
    """Of its time in s, positive if late; None where no recording goes from the last drum to this
    one, and for the first of an episode without a recording."""
    worth: float
    """What was paid for it."""


class HitReward(gymnasium.Wrapper[FloatArray, FloatArray, FloatArray, FloatArray]):
    """`DrummingEnv` with a reward for keeping the recording and for its strokes (see the module).

    Nothing else changes, so that an agent is scored in the environment itself;
    ``info["strokes"]`` is a tuple of `Stroke`, for each of ``info["hits"]``, and
    ``info["progress"]`` the environment's own reward, 0 after a reset.

    Parameters
    ----------
    env : DrummingEnv, wrapped or not
    force : float
        f_0 in N, > 0.
    """

    def __init__(self, env: Any, force: float = FORCE) -> None:
        super().__init__(env)
        task: Any = env.unwrapped
        if not hasattr(task, "score_of"):
            raise TypeError(f"Expected an environment with drums, got {type(task).__name__}.")
        if not (np.isfinite(force) and force > 0):
            raise ValueError(f"Expected a force > 0 in N, got {force!r}.")
        self.force = float(force)
        self._task = task
        demos = task.demonstrations
        self._per_width = 1 / (WIDTH * demos.bounding_box.diagonal)
        self._per_speed = 1 / (WIDTH * demos.peak_speed)
        scores = [task.score_of(i) for i in range(len(demos.positions))]
        self._first = [float(times[0]) if len(times) else None for times, _ in scores]
        found: dict[tuple[int, int], list[float]] = {}
        for times, drums in scores:
            pairs = zip(drums.tolist(), drums[1:].tolist(), strict=False)
            for pair, apart in zip(pairs, np.diff(times).tolist(), strict=True):
                found.setdefault(pair, []).append(apart)
        if not found:
            raise ValueError(
                "Expected demonstrations that strike a drum at least twice, got none: there is no "
                "rhythm to pay."
            )
        self.intervals = {pair: float(np.mean(apart)) for pair, apart in sorted(found.items())}
        """T in s, by the drums of two successive notes."""
        self.worth = 0.5 * float(np.mean([t for apart in found.values() for t in apart])) / task.dt
        """W."""
        self._last: Hit | None = None
        self._index = -1
        self._count = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Begin an episode; options are the environment's."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._last, self._index, self._count = None, int(info["demonstration"]), 0
        return observation, {**info, "strokes": (), "progress": 0.0}

    def step(
        self, action: FloatArray
    ) -> tuple[FloatArray, SupportsFloat, bool, bool, dict[str, Any]]:
        """Hold an action for a control step."""
        observation, progress, terminated, truncated, info = self.env.step(action)
        self._count += 1
        strokes = tuple(self._heard(hit) for hit in info["hits"])
        reward = 0.5 * self._kept(observation, float(progress)) + sum(s.worth for s in strokes)
        info = {**info, "strokes": strokes, "progress": float(progress)}
        return observation, reward, terminated, truncated, info

    def _kept(self, observation: FloatArray, progress: float) -> float:
        """Return k_t."""
        demos = self._task.demonstrations
        if self._index < 0 or self._count >= len(demos.positions[self._index]):
            return progress
        shown, moved = demos.positions[self._index], demos.velocities[self._index]
        apart = self._per_width * (observation[:3] - shown[self._count])
        along = self._per_speed * (self._task.simulation.tip_velocity - moved[self._count])
        return float(0.5 / (1 + apart @ apart) + 0.5 / (1 + along @ along))

    def _heard(self, hit: Hit) -> Stroke:
        """Return what a hit is worth, and keep it for the next one."""
        before, self._last = self._last, hit
        first = self._first[self._index] if self._index >= 0 else None
        if before is not None:
            apart = self.intervals.get((before.drum, hit.drum))
            if apart is None:
                return Stroke(hit, None, -self.worth)
            error: float | None = hit.time - before.time - apart
        else:
            error = None if first is None else hit.time - first
        loud = 1 / (1 + ((hit.force - self.force) / (self.force / 2)) ** 2)
        late = 1.0 if error is None else 1 / (1 + (error / TOLERANCE) ** 2)
        return Stroke(hit, error, self.worth * late * loud)
