"""Drumming with a robot arm: the paper's robot experiment (sec. IV-D) in MuJoCo."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Final, SupportsFloat, cast

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from iflow_gym.datasets.drums import DRUMS, TIP_RADIUS, Drum, load_drums
from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.envs.drumming.arguments import (
    ControlMode,
    ForcePush,
    checked_demonstrations,
    checked_options,
    checked_parts,
    checked_push,
    vectors,
)
from iflow_gym.envs.drumming.arms import Arms
from iflow_gym.envs.drumming.control import CONTROL_DT
from iflow_gym.envs.drumming.scene import TORQUE_LIMITS
from iflow_gym.envs.drumming.simulation import Simulation, UnreachableError
from iflow_gym.envs.dynamics import FLOATS, excess, scaled_into_box
from iflow_gym.envs.guide import Guide, guide_for
from iflow_gym.envs.task import START_NOISE, Push
from iflow_gym.metrics import Motion
from iflow_gym.metrics.drumming import Hit, implied_score

if TYPE_CHECKING:
    from iflow_gym.envs.drumming.rendering import Renderer

MAX_SPEED: Final = 1.0
"""Speed of the tip in m/s of an action component of 1: three times the demonstrations' peak."""

ON_ORBIT: Final = 0.05
"""Distance from the demonstrations that is success, in diagonals of their bounding box."""

START_DRAWS: Final = 20
"""Random starts that are tried before the demonstration's own first sample is taken."""


class DrummingEnv(gymnasium.Env[FloatArray, FloatArray]):
    r"""Drum with a robot arm the way the demonstrations do.

    ## Description
    A seven-joint Franka arm stands before two drums with a stick in its hand, in MuJoCo. The
    motion is that of the ImitationFlow paper's robot experiment: an arch between the drums, high
    over on the way to the right one, low on the way back, a stroke on either head, about 5 s a
    round. A policy sees where the stick's tip is and says how it should move; a controller turns
    that into torques of the joints, with the stick's orientation held. A good policy goes round on
    the demonstrated orbit, comes back to it after a push, and hits each drum when the
    demonstrations do.

    Physics run at 1 kHz, control at 100 Hz. Lengths are metres in the frame of the arm's base: x
    forward, y to the left, z up. The heads are of mesh, as on electronic drums: they give way by
    2 mm/N, with damping, and a stroke follows through, 11 to 14 mm into the head. The arm holds
    against a head with up to 10 N, and gives way to more.

    `env.unwrapped` has `demonstrations`, `drums`, `dt`, `max_speed`, `n_dims`, the conversions
    `velocity_to_action`, `action_to_velocity` and `command_to_action`, `score_of` (the notes that
    a demonstration implies), `get_dataset` and `score`; wrappers hide them. For many arms at once,
    `gymnasium.make_vec(id, num_envs=n)` gives a batch whose processes share them out.

    ## Action Space
    An action whose largest component exceeds 1 is divided by it, as a whole: no component is
    clipped by itself. Float64 actions are used at full precision.

    | control_mode | space | action component | -1 | 1 |
    | --- | --- | --- | --- | --- |
    | `"velocity"` (default) | `Box(-1, 1, (3,), float32)` | velocity of the tip | -1 m/s | 1 m/s |
    | `"torque"` | `Box(-1, 1, (7,), float32)` | torque of a joint | -limit | limit |

    A velocity is held for a control step; the arm reaches it at the step's end, or accelerates
    towards it by 20 m/s^2. Where a joint's stop or a joint's speed limit is near, the command is
    slowed as a whole (`info["command_scale"]`), never bent; along the border of the workspace it
    slides, and along a drum, which counts as solid from 16 mm below its head on, and rises at its
    wall: `iflow_gym.envs.drumming.control` and `keepout` have the equations. Torques, of up to
    87 N m (joints 1 to 4) and 12 N m (5 to 7), come on top of the compensation of gravity; they are
    scaled as a whole so that the joints keep their limits. A collision can make a joint faster
    than its limit for an instant; no joint reaches its stop.

    ## Observation Space
    `Box(float64)`, the parts that `observe` names, in its order; the tip comes first always.

    | part | size | quantity | min | max | unit |
    | --- | --- | --- | --- | --- | --- |
    | `"tip"` (default) | 3 | position of the tip | -2 | 2 | m |
    | `"tip_velocity"` | 3 | velocity of the tip | -10 | 10 | m/s |
    | `"joints"` | 7 | joint angles | limits - 0.1 | limits + 0.1 | rad |
    | | 7 | joint velocities | -20 | 20 | rad/s |
    | `"force"` | 2 | largest force on each head in the last step | 0 | 2000 | N |
    | `"phase"` | 2 | cosine and sine of 2 pi time / period | -1 | 1 | - |

    The tip is kept within the workspace: x from 0.58 to 0.88, y from -0.4 to 0.4, z from 0.13 to
    0.7, and at most 0.77 m from (0.36, 0, -0.03).

    ## Rewards
    That of the point mass for a motion that repeats, in [-1, 1] (`iflow_gym.envs.guide`): about 1 a
    step for a replay, 0 for standing still, -1 for going back. On the heads, where the way down and
    the way up lie side by side, the nearest sample may belong to the other one, and a replay has
    some steps that cost.

    ## Starting State
    The first sample of a demonstration drawn uniformly, plus Gaussian noise with a standard
    deviation of `start_noise` diagonals of the demonstrations' bounding box a component, moving as
    the demonstration does. With `reset(options={"demonstration": i})` exactly the first sample of
    demonstration i. With `reset(options={"start": x})` the position x at rest; with both the
    position x, at rest, and the length of demonstration i. The arm is in the posture of that
    position that is nearest to its normal one. A start that is out of reach or inside a drum raises
    an error.

    ## Episode End
    Truncated after `horizon` steps, by default as many as the demonstration has. Never terminated.
    No `TimeLimit` is needed, since the environment truncates by itself.

    ## Arguments
    | argument | default | meaning |
    | --- | --- | --- |
    | `demonstrations` | `None` | of a cycle within the workspace; `None` takes the suite's six |
    | `drums` | `None` | tuple of `iflow_gym.datasets.drums.Drum`; `None` takes the suite's two |
    | `control_mode` | `"velocity"` | or `"torque"` |
    | `observe` | `("tip",)` | parts of the observation |
    | `horizon` | `None` | steps an episode; `None` takes the demonstration's own |
    | `start_noise` | `0.02` | standard deviation of random starts, in diagonals |
    | `perturbation` | `None` | a `Push` or a `ForcePush`, see Perturbations |
    | `render_mode` | `None` | `"rgb_array"`; needs OpenGL |
    | `width`, `height` | `640`, `480` | of a picture, in pixels |

    ## Info
    The same keys after a reset and after every step.

    | key | type | meaning |
    | --- | --- | --- |
    | `is_success` | bool | within 5 % of the bounding box's diagonal of the demonstrations |
    | `distance_to_orbit` | float | m from the demonstrations' nearest sample |
    | `phase` | float | of that sample, in rounds from 0 to 1 |
    | `time` | float | seconds since the reset |
    | `dt` | float | seconds a step |
    | `demonstration` | int | index of the demonstration, -1 for a start of the caller's choice |
    | `pushed` | bool | whether the push has begun |
    | `hits` | tuple | of `Hit(time, drum, force)`: what this step decided, see Hits |
    | `forces` | array, shape (2,) | largest normal force on each head in this step, N |
    | `target` | array, shape (3,) | where the command wanted the tip at the step's end, m |
    | `command_scale` | float | how much of the command the limits let through |

    In torque mode `target` is where the tip is.

    ## Hits
    A contact of the stick with a head of at least 2 N that none preceded on that drum within
    0.1 s. Its `time` is that of the onset, to the millisecond; its `force` the largest within
    0.05 s. It is reported when that is known, 0.05 s after the onset, or in the episode's last
    step.

    ## Perturbations
    Both come once, `fraction` of the way; 0.5 is in the middle of a stroke. A `Push(fraction,
    size, direction)` moves the arm aside at once, so that the tip is displaced by `size` diagonals,
    or as far as arm and drums allow; joint velocities stay. A `ForcePush(fraction, impulse,
    duration, direction)` pushes the tip with a steady force; the controller resists, and 4 N s
    in 0.1 s move the tip by about 0.1 m, not quite in the direction of the force.

    ## Version History
    * v0: Initial version. Scores belong to a version of MuJoCo: contacts are solved slightly
      differently from one to the next.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 100}  # noqa: RUF012
    motion: ClassVar[Motion] = "drumming"
    rivals: ClassVar[tuple[str, ...]] = ()
    _resets_needed: ClassVar[str] = "Call reset() before step() and render()."

    def __init__(
        self,
        demonstrations: Demonstrations | None = None,
        drums: tuple[Drum, ...] | None = None,
        *,
        control_mode: ControlMode = "velocity",
        observe: Sequence[str] = ("tip",),
        horizon: int | None = None,
        start_noise: float = START_NOISE,
        perturbation: Push | ForcePush | None = None,
        render_mode: str | None = None,
        width: int = 640,
        height: int = 480,
    ) -> None:
        self._demonstrations = checked_demonstrations(
            load_drums() if demonstrations is None else demonstrations
        )
        self.drums: tuple[Drum, ...] = DRUMS if drums is None else tuple(drums)
        if control_mode not in ("velocity", "torque"):
            raise ValueError(f"Expected control_mode 'velocity' or 'torque', got {control_mode!r}.")
        if horizon is not None and (not isinstance(horizon, int | np.integer) or horizon < 1):
            raise ValueError(
                f"Expected horizon to be a whole number of steps >= 1, got {horizon!r}: leave it "
                "out for as many steps as the demonstration has."
            )
        if not (np.isfinite(start_noise) and start_noise >= 0):
            raise ValueError(
                f"Expected start_noise >= 0 (a fraction of the diagonal), got {start_noise!r}."
            )
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"Expected render_mode None or 'rgb_array', got {render_mode!r}.")
        self.control_mode: ControlMode = control_mode
        self.observe = checked_parts(observe)
        self.horizon = None if horizon is None else int(horizon)
        self.start_noise = float(start_noise)
        self.perturbation = checked_push(perturbation)
        self.render_mode = render_mode
        self.width, self.height = int(width), int(height)
        self.diagonal = self._demonstrations.bounding_box.diagonal
        self.simulation = Simulation(self.drums)
        size = 3 if control_mode == "velocity" else len(TORQUE_LIMITS)
        self.action_space = cast(
            "spaces.Space[FloatArray]", spaces.Box(-1.0, 1.0, (size,), np.float32)
        )
        self.observation_space = self._observation_space()
        self._running = False
        self._count = self._length = 0
        self._index = -1
        self._push_steps = range(0)
        self._push = np.zeros(3)
        self._tip = np.zeros(3)
        self._trail: list[FloatArray] = []
        self._renderer: Renderer | None = None

    # What it is ---------------------------------------------------------------------------

    @property
    def demonstrations(self) -> Demonstrations:
        """The demonstrations of the motion."""
        return self._demonstrations

    @property
    def dt(self) -> float:
        """Seconds a step."""
        return CONTROL_DT

    @property
    def n_dims(self) -> int:
        """Dimension of a position: 3."""
        return 3

    @property
    def max_speed(self) -> float:
        """Speed of the tip in m/s of an action component of 1."""
        return MAX_SPEED

    def score_of(self, index: int) -> tuple[FloatArray, NDArray[np.intp]]:
        """Return the notes that a demonstration implies: times in s and drums, shape (n,) each."""
        return implied_score(
            self.demonstrations.positions[index],
            self.demonstrations.dt[index],
            [drum.head for drum in self.drums],
            [drum.radius for drum in self.drums],
            tip_radius=TIP_RADIUS,
        )

    def reachable(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Which positions, shape (n, 3), an episode can start from; shape (n,).

        The state of a running episode is lost: reset afterwards.
        """
        self._running = False
        found = []
        for point in np.asarray(points, dtype=np.float64).reshape(-1, 3):
            try:
                self.simulation.place(point)
            except UnreachableError:
                found.append(False)
            else:
                found.append(True)
        return np.array(found, dtype=np.bool_)

    def like(
        self,
        num_envs: int | None = None,
        *,
        horizon: int | None = None,
        perturbation: Push | ForcePush | None = None,
    ) -> Any:
        """Return another arm at the same drums, or `Arms`, a batch of `num_envs` of them.

        Its horizon and perturbation are its own; there are no pictures.
        """
        arms = [
            DrummingEnv(
                self.demonstrations,
                self.drums,
                control_mode=self.control_mode,
                observe=self.observe,
                horizon=horizon,
                perturbation=perturbation,
            )
            for _ in range(1 if num_envs is None else num_envs)
        ]
        return arms[0] if num_envs is None else Arms(arms)

    # Conversions --------------------------------------------------------------------------

    def velocity_to_action(self, velocity: ArrayLike) -> FloatArray:
        """Return the action of a velocity in m/s, shape (..., 3), scaled to fit the box."""
        self._expect_velocity_mode("velocity_to_action")
        return scaled_into_box(vectors(velocity, "velocity") / MAX_SPEED)

    def action_to_velocity(self, action: ArrayLike) -> FloatArray:
        """Return the velocity in m/s that an action, shape (..., 3), commands."""
        self._expect_velocity_mode("action_to_velocity")
        return scaled_into_box(vectors(action, "action")) * MAX_SPEED

    def command_to_action(
        self, velocity_command: ArrayLike, observation: ArrayLike, dt: float | None = None
    ) -> FloatArray:
        """Return the action that carries out a velocity command, in either control mode.

        In velocity mode that is the command as a fraction of `max_speed`. In torque mode it is what
        the velocity mode's controller would apply; it depends on the joints, and so on the running
        episode's present state, whatever the observation: one command, shape (3,), at a time.

        Parameters
        ----------
        velocity_command : array, shape (..., 3)
            In m/s.
        observation : array, shape (..., size of an observation)
            The state that the command is given in.
        dt : float, seconds, optional
            For the interface's sake: a step is always `dt` long.
        """
        command = vectors(velocity_command, "velocity command")
        state = np.asarray(observation, dtype=np.float64)
        size = cast("tuple[int, ...]", self.observation_space.shape)[0]
        if state.ndim == 0 or state.shape[-1] != size:
            raise ValueError(f"Expected observations of shape (..., {size}), got {state.shape}.")
        if self.control_mode == "velocity":
            return scaled_into_box(command / MAX_SPEED)
        if command.shape != (3,):
            raise ValueError(
                f"Expected one velocity command, shape (3,), in torque mode, got {command.shape}: "
                "its torques depend on the state of this environment's joints."
            )
        if not self._running:
            raise gymnasium.error.ResetNeeded(self._resets_needed)
        wanted = scaled_into_box(command / MAX_SPEED) * MAX_SPEED
        simulation = self.simulation
        controller = simulation.controller
        velocity = controller.joint_command(wanted).velocity
        torque = controller.torque(velocity, simulation.resistance)
        action: FloatArray = torque / TORQUE_LIMITS
        return action

    def _expect_velocity_mode(self, name: str) -> None:
        if self.control_mode != "velocity":
            raise ValueError(
                f"Expected control_mode='velocity' for {name}, got 'torque': there an action is "
                "joint torques; use command_to_action(velocity, observation)."
            )

    # Episodes -----------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Begin an episode; see Starting State for the options."""
        super().reset(seed=seed)
        demos = self.demonstrations
        wanted, start = checked_options(self.demonstrations, options)
        self._running = False
        index = wanted
        if index is None and start is None:
            index = int(self.np_random.integers(len(demos)))
        if start is not None:
            self.simulation.place(start)
        else:
            assert index is not None
            self._place_at_demonstration(index, noisy=wanted is None)
        self._index = -1 if index is None else index
        steps = round(float(demos.durations.mean()) / CONTROL_DT)
        if index is not None:
            steps = len(demos.positions[index]) - 1
        self._length = steps if self.horizon is None else self.horizon
        self._plan_push(steps)
        self._count = 0
        self._running = True
        self._tip = self.simulation.tip
        self._trail = [self._tip] if self.render_mode is not None else []
        return self._observation(), self._info(self._tip, 1.0, (), self._measures(self._tip))

    def _place_at_demonstration(self, index: int, *, noisy: bool) -> None:
        first = self.demonstrations.positions[index][0]
        velocity = self.demonstrations.velocities[index][0]
        if noisy and self.start_noise > 0:
            for _ in range(START_DRAWS):
                noise = self.start_noise * self.diagonal * self.np_random.standard_normal(3)
                try:
                    return self.simulation.place(first + noise, velocity)
                except UnreachableError:
                    continue
        return self.simulation.place(first, velocity)

    def _plan_push(self, steps: int) -> None:
        push = self.perturbation
        self._push_steps = range(0)
        if push is None:
            return
        direction = (
            self.np_random.standard_normal(3)
            if push.direction is None
            else np.asarray(push.direction, dtype=np.float64)
        )
        direction = direction / np.linalg.norm(direction)
        begin = max(1, round(push.fraction * steps))
        if isinstance(push, ForcePush):
            n = max(1, round(push.duration / CONTROL_DT))
            self._push_steps = range(begin, begin + n)
            self._push = push.impulse / (n * CONTROL_DT) * direction
        else:
            self._push_steps = range(begin, begin + 1)
            self._push = push.size * self.diagonal * direction

    def step(
        self, action: FloatArray
    ) -> tuple[FloatArray, SupportsFloat, bool, bool, dict[str, Any]]:
        """Hold an action for a control step."""
        if not self._running:
            raise gymnasium.error.ResetNeeded(self._resets_needed)
        values = np.asarray(action, dtype=np.float64)
        if values.shape != self.action_space.shape:
            raise ValueError(
                f"Expected an action of shape {self.action_space.shape}, got {values.shape}."
            )
        components = values.tolist()
        if not all(map(math.isfinite, components)):
            raise ValueError(
                f"Expected a finite action, got {values}: the policy gave NaN or infinity."
            )
        values = values / excess(FLOATS, components)
        simulation, before = self.simulation, self._tip
        controller = simulation.controller
        if self.control_mode == "velocity":
            velocity = MAX_SPEED * values
            command = controller.joint_command(velocity)
            torque, scale = controller.torque(command.velocity), command.scale
            target = before + CONTROL_DT * velocity
        else:
            torque, scale = controller.guarded(values * TORQUE_LIMITS)
            target = None
        self._count += 1
        pushing = self._count in self._push_steps
        is_force = isinstance(self.perturbation, ForcePush)
        force = self._push if pushing and is_force else None
        hits = simulation.advance(torque, force, holding=self.control_mode == "velocity")
        reached = simulation.tip
        measures = self._measures(reached)
        reward = self._guide.reward(
            FLOATS, before.tolist(), reached.tolist(), CONTROL_DT, measures[0]
        )
        self._tip = reached
        if pushing and not is_force:
            simulation.displace(self._push)
            self._tip = simulation.tip
            measures = self._measures(self._tip)
        truncated = self._count >= self._length
        if truncated:
            hits += simulation.pending_hits()
        if self.render_mode is not None:
            self._trail.append(self._tip)
        info = self._info(reached if target is None else target, scale, tuple(hits), measures)
        return self._observation(), reward, False, truncated, info

    @cached_property
    def _guide(self) -> Guide:
        return guide_for(self.demonstrations.shown)

    def _measures(self, tip: FloatArray) -> tuple[float, ...]:
        return self._guide.measures(FLOATS, tip.tolist())

    def _info(
        self, target: FloatArray, scale: float, hits: tuple[Hit, ...], measures: tuple[float, ...]
    ) -> dict[str, Any]:
        return {
            "is_success": measures[0] <= ON_ORBIT * self.diagonal,
            **dict(zip(self._guide.measured, measures, strict=True)),
            "time": self._count * CONTROL_DT,
            "dt": CONTROL_DT,
            "demonstration": self._index,
            "pushed": len(self._push_steps) > 0 and self._count >= self._push_steps[0],
            "hits": hits,
            "forces": np.array(self.simulation.peak_forces),
            "target": np.array(target),
            "command_scale": scale,
        }

    def _observation(self) -> FloatArray:
        if self.observe == ("tip",):
            return self._tip.copy()
        data = self.simulation.data
        angle = 2 * np.pi * self._count * CONTROL_DT / cast("float", self.demonstrations.period)
        parts: dict[str, Callable[[], FloatArray]] = {
            "tip": lambda: self._tip,
            "tip_velocity": lambda: self.simulation.tip_velocity,
            "joints": lambda: np.concatenate([data.qpos, data.qvel]),
            "force": lambda: np.array(self.simulation.peak_forces),
            "phase": lambda: np.array([np.cos(angle), np.sin(angle)]),
        }
        return np.concatenate([parts[name]() for name in self.observe])

    def _observation_space(self) -> spaces.Space[FloatArray]:
        scene, n = self.simulation.scene, len(self.drums)
        high = {
            "tip": np.full(3, 2.0),
            "tip_velocity": np.full(3, 10.0),
            "joints": np.concatenate([scene.upper + 0.1, np.full(7, 20.0)]),
            "force": np.full(n, 2000.0),
            "phase": np.ones(2),
        }
        low = {name: -bound for name, bound in high.items()}
        low["joints"] = np.concatenate([scene.lower - 0.1, np.full(7, -20.0)])
        low["force"] = np.zeros(n)
        least, most = (np.concatenate([end[name] for name in self.observe]) for end in (low, high))
        return cast("spaces.Space[FloatArray]", spaces.Box(least, most, dtype=np.float64))

    # Data, scores, pictures ---------------------------------------------------------------

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
            ``observations`` and ``next_observations`` (N, size of an observation), ``actions``
            (N, 3) or (N, 7), ``rewards`` (N,), all float64; ``terminals`` (N,), all false;
            ``timeouts`` (N,), true at the last transition of each recording.

        Notes
        -----
        The recordings are played by the arm, without push: the command at each sample is the one
        that leads to the recording's next. So the observations are what the arm did, within
        millimetres of the recording.
        """
        from iflow_gym.envs.drumming.dataset import transitions

        return transitions(self, split, part)

    def score(self, system_or_policy: Any, seed: int) -> dict[str, float | None]:
        """Score a system or a policy on this environment: see `iflow_gym.evaluate.score`."""
        from iflow_gym.evaluate import score

        return score(system_or_policy, self, seed)

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture, shape (height, width, 3)."""
        if self.render_mode is None:
            gymnasium.logger.warn(
                "render() was called without a render_mode: pass render_mode='rgb_array' to "
                "gymnasium.make."
            )
            return None
        if not self._running:
            raise gymnasium.error.ResetNeeded(self._resets_needed)
        if self._renderer is None:
            from iflow_gym.envs.drumming.rendering import Renderer

            self._renderer = Renderer(self.drums, self.width, self.height)
        simulation = self.simulation
        return self._renderer.frame(simulation.data.qpos, self._trail, simulation.peak_forces)

    def close(self) -> None:
        """Free what OpenGL holds."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
