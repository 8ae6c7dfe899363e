"""A point mass that is to move as demonstrated: the environment of every planar dataset."""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING, Any, ClassVar, SupportsFloat

import gymnasium
import numpy as np
from numpy.typing import NDArray

from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.envs.dynamics import FLOATS
from iflow_gym.envs.task import (
    START_NOISE,
    ControlMode,
    Episode,
    PointMassInterface,
    PointMassTask,
    Push,
)

if TYPE_CHECKING:
    from iflow_gym.envs.rendering import Renderer


class PointMassEnv(PointMassInterface, gymnasium.Env[FloatArray, FloatArray]):
    r"""Move a point mass the way the demonstrations do.

    ## Description
    A point mass lives in the space of a set of demonstrations, of any dimension d. A policy that is
    worth its name follows the demonstrated motion from where it starts, and comes back to it after
    a push. Where the motion ends, the policy ends at the goal and stays there; where it repeats
    with a period, the policy goes round and round at its tempo. The arithmetic is float64, and
    exact: playing a recording's velocities gives the recording back to rounding.

    `env.unwrapped` has `demonstrations`, `dt`, `max_speed`, the conversions
    `velocity_to_action`, `action_to_velocity`, `force_to_action`, `action_to_force` and
    `command_to_action`, `get_dataset` and `score`; wrappers hide them.

    ## Action Space
    `Box(-1, 1, (d,), float32)`. Float64 actions are used at full precision. An action whose
    largest component exceeds 1 is divided by it, as a whole: no component is clipped by itself.

    | control_mode | action component | -1 | 1 | unit |
    | --- | --- | --- | --- | --- |
    | `"velocity"` (default) | velocity, held for one dt | -max_speed | max_speed | length/s |
    | `"force"` | force, held for one dt | -max_force | max_force | kg length/s² |

    `max_speed` is 5 times the demonstrations' peak speed. In velocity mode
    $x' = x + \Delta t\, v_\text{max}\, a$. In force mode $m \dot v = F - c v$ is integrated in
    closed form, and `max_force` = damping * `max_speed`, so that `max_speed` is the terminal speed.

    ## Observation Space
    `Box(float64)` of shape (d,), in force mode (2 d,).

    | index | quantity | min | max | unit |
    | --- | --- | --- | --- | --- |
    | 0 .. d-1 | position | centre - 10 sides | centre + 10 sides | length |
    | d .. 2d-1 (force mode) | velocity | -max_speed | max_speed | length/s |

    Centre and sides are those of the demonstrations' bounding box; a side shorter than a quarter
    of the box's diagonal counts as that. So the arena is the box enlarged 20 times, twice what the
    metrics call diverged. Its walls stop the mass: position stays at the wall, and in force mode
    the velocity into it becomes 0.

    ## Rewards
    Progress along the demonstrations. With the step's velocity $u = (x' - x) / \Delta t$, its
    middle $m = (x + x') / 2$, the demonstrations' sample k nearest to m (position $p_k$, unit
    tangent $t_k$, speed $s_k$) and w = 5 % of the diagonal of the bounding box,

    $$n = \frac{t_k + (p_k - m) / w}{\lVert t_k + (p_k - m) / w \rVert}, \qquad
      r = \frac{\langle u, n \rangle}{\max(\lVert u \rVert, s_k)},$$

    and r = 1 where x' is within the goal's tolerance. r lies in [-1, 1]; a replay gets about 1 a
    step, standing still 0, staying at the goal 1, and undoing a step costs what the step paid. A
    push is not charged to the step in which it comes. A motion that repeats has no goal, and its
    tempo is part of it: going faster than demonstrated pays less,

    $$r = \frac{\langle u, n \rangle \, s_k}{\max(\lVert u \rVert, s_k)^2}.$$

    `iflow_gym.envs.guide` says more.

    ## Starting State
    The first sample of a demonstration drawn uniformly, plus Gaussian noise with a standard
    deviation of `start_noise` diagonals a component; the demonstration's dt, and in force mode its
    first velocity. With `reset(options={"demonstration": i})` exactly the first sample of
    demonstration i. With `reset(options={"start": x})` the position x at rest, with the mean dt of
    the demonstrations; with both the position x, at rest, and the dt and length of demonstration i.

    ## Episode End
    Truncated after `horizon` steps, by default as many as the demonstration has (T_i - 1, or for a
    start of the caller's choice the mean duration over the mean dt). Never terminated. No
    `TimeLimit` is needed, since the environment truncates by itself.

    ## Arguments
    | argument | default | meaning |
    | --- | --- | --- |
    | `demonstrations` | required | `iflow_gym.Demonstrations` |
    | `control_mode` | `"velocity"` | or `"force"` |
    | `horizon` | `None` | steps an episode; `None` takes the demonstration's own |
    | `start_noise` | `0.02` | standard deviation of random starts, in diagonals |
    | `perturbation` | `None` | a `Push(fraction, size, direction)` displaces the mass once |
    | `mass` | `1.0` | kg, force mode only |
    | `damping` | `None` | kg/s, force mode only; `None` makes mass / damping 1 % of the duration |
    | `policy` | `None` | whose streamlines are drawn: anything with `velocity(x)`, or `predict` |
    | `render_mode` | `None` | `"rgb_array"` or `"human"`; d = 2 only |

    ## Info
    The same keys after a reset and after every step.

    | key | type | meaning |
    | --- | --- | --- |
    | `is_success` | bool | within 2 % of the bounding box's diagonal of the goal, or the orbit |
    | `distance_to_goal` | float | length; of a motion that ends |
    | `distance_to_orbit` | float | length, from the nearest sample; of a motion that repeats |
    | `phase` | float | of that sample, in rounds from 0 to 1; of a motion that repeats |
    | `time` | float | seconds since the reset |
    | `dt` | float | seconds a step in this episode |
    | `demonstration` | int | index of the demonstration, -1 for a start of the caller's choice |
    | `pushed` | bool | whether the push has come |

    ## Version History
    * v0: Initial version.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array", "human"], "render_fps": 50}  # noqa: RUF012
    _resets_needed: ClassVar[str] = "Call reset() before step() and render()."

    def __init__(
        self,
        demonstrations: Demonstrations,
        *,
        control_mode: ControlMode = "velocity",
        horizon: int | None = None,
        start_noise: float = START_NOISE,
        perturbation: Push | None = None,
        mass: float = 1.0,
        damping: float | None = None,
        policy: Any = None,
        render_mode: str | None = None,
    ) -> None:
        self.task = PointMassTask(
            demonstrations,
            control_mode=control_mode,
            horizon=horizon,
            start_noise=start_noise,
            perturbation=perturbation,
            mass=mass,
            damping=damping,
        )
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(
                f"Expected render_mode None, 'rgb_array' or 'human', got {render_mode!r}."
            )
        if render_mode is not None and self.n_dims != 2:
            raise ValueError(
                f"Expected demonstrations in the plane to render, got {self.n_dims} dimensions: "
                "leave render_mode out."
            )
        self.metadata = {**self.metadata, "render_fps": max(1, round(1 / demonstrations.mean_dt))}
        self.render_mode = render_mode
        self.policy = policy
        self.observation_space = self.task.observation_space
        self.action_space = self.task.action_space
        self._action_shape = (self.n_dims,)
        self._episode: Episode | None = None
        self._state: list[float] = []
        self._count = 0
        self._renderer: Renderer | None = None
        self._trail: list[list[float]] = []

    @property
    def dt(self) -> float:
        """Seconds a step of the running episode; before the first reset the mean dt."""
        return self.demonstrations.mean_dt if self._episode is None else self._episode.dt

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Begin an episode; see Starting State for the options."""
        super().reset(seed=seed)
        (index,), (start,) = self.task.checked_options(options, 1)
        self._episode = self.task.episode(self.np_random, index, start)
        self._state = self._episode.state
        self._count = 0
        if self.render_mode is not None:
            self._trail = [self._state[:2]]
            if self.render_mode == "human":
                self.render()
        return np.array(self._state), self._info(self.task.measures(FLOATS, self._state))

    def step(
        self, action: FloatArray
    ) -> tuple[FloatArray, SupportsFloat, bool, bool, dict[str, Any]]:
        """Hold an action for one dt."""
        episode = self._episode
        if episode is None:
            raise gymnasium.error.ResetNeeded(self._resets_needed)
        values = np.asarray(action, dtype=np.float64)
        components: list[float] = values.tolist()
        if values.shape != self._action_shape or not all(map(isfinite, components)):
            self.task.reject(values, self._action_shape)
        self._state, reward, measures = self.task.advance(
            FLOATS, self._state, components, episode.coefficients, episode.dt
        )
        self._count += 1
        if self._count == episode.push_step:
            self._state = self.task.displaced(FLOATS, self._state, episode.push)
            measures = self.task.measures(FLOATS, self._state)
        if self.render_mode is not None:
            self._trail.append(self._state[:2])
            if self.render_mode == "human":
                self.render()
        truncated = self._count >= episode.horizon
        return np.array(self._state), reward, False, truncated, self._info(measures)

    def _info(self, measures: tuple[float, ...]) -> dict[str, Any]:
        episode = self._episode
        assert episode is not None
        return {
            "is_success": measures[0] <= self.task.tolerance,
            **dict(zip(self.task.guide.measured, measures, strict=True)),
            "time": self._count * episode.dt,
            "dt": episode.dt,
            "demonstration": episode.demonstration,
            "pushed": 0 < episode.push_step <= self._count,
        }

    def get_dataset(
        self, split: str = "reproduction", part: str = "fit"
    ) -> dict[str, NDArray[Any]]:
        """Return the demonstrations as transitions of this environment, under D4RL's keys.

        Parameters
        ----------
        split : str
            A protocol of `Demonstrations.split`.
        part : {"fit", "score"}
            The recordings to fit on, or those to score on.

        Returns
        -------
        dict of arrays, N transitions, one recording after the other
            ``observations`` and ``next_observations`` (N, d) or (N, 2 d), ``actions`` (N, d),
            ``rewards`` (N,), all float64; ``terminals`` (N,), all false; ``timeouts`` (N,), true
            at the last transition of each recording.

        Notes
        -----
        The recordings are played in the environment itself, without push. In velocity mode the
        action is the one that takes a sample to the next, so the observations are the recording,
        to rounding. In force mode it is the force that gives the next sample's velocity at the
        end of dt, and the mass stays within a step's length of the recording where the force
        suffices.
        """
        parts = self.demonstrations.split(split)
        if part not in parts._fields:
            raise ValueError(f"Expected part {' or '.join(parts._fields)}, got {part!r}.")
        demos = getattr(parts, part)
        control = self.task.control
        player = self.like()
        rows: dict[str, list[Any]] = {key: [] for key in _DATASET_KEYS}
        for index, positions in enumerate(self.demonstrations.positions):
            if not any(positions is p for p in demos.positions):
                continue
            velocities = self.demonstrations.velocities[index]
            observation, _ = player.reset(options={"demonstration": index})
            for following, velocity in zip(positions[1:], velocities[1:], strict=True):
                if control.blocks == 1:
                    velocity = (following - observation) / player.dt
                action = player.command_to_action(velocity, observation)
                arrived, reward, terminal, timeout, _ = player.step(action)
                transition = (observation, action, arrived, reward, terminal, timeout)
                for key, value in zip(_DATASET_KEYS, transition, strict=True):
                    rows[key].append(value)
                observation = arrived
        return {key: np.array(values) for key, values in rows.items()}

    def score(self, system_or_policy: Any, seed: int) -> Any:
        """Score a system or a policy on this environment: see `iflow_gym.evaluate.score`."""
        from iflow_gym.evaluate import score

        return score(system_or_policy, self, seed)

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture, shape (height, width, 3), or show it in a window."""
        if self.render_mode is None:
            gymnasium.logger.warn(
                "render() was called without a render_mode: pass render_mode='rgb_array' to "
                "gymnasium.make."
            )
            return None
        if self._episode is None:
            raise gymnasium.error.ResetNeeded(self._resets_needed)
        from iflow_gym.envs.rendering import Renderer

        if self._renderer is None:
            self._renderer = Renderer(self)
        if self.render_mode == "human":
            self._renderer.show(self._trail, self._count * self._episode.dt)
            return None
        return self._renderer.frame(self._trail, self._count * self._episode.dt)

    def close(self) -> None:
        """Close the window, where there is one."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


_DATASET_KEYS = (
    "observations",
    "actions",
    "next_observations",
    "rewards",
    "terminals",
    "timeouts",
)
