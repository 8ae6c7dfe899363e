r"""The task-space controller: from a velocity of the stick's tip to torques of the joints.

With the Jacobian J of tip position and orientation, shape (6, 7), the tip's command v, the rotation
vector e that turns the stick back to its fixed orientation, and the posture q_0,

    dq = dq_0 + J^T (J J^T + lambda^2 I)^-1 ([v, k e] - J dq_0),     dq_0 = k_0 (q_0 - q):

damped least squares with the posture in the null space (Siciliano et al., *Robotics*, 2009,
eqs. 3.54 and 3.59; the damping grows towards a singularity as in Nakamura & Hanafusa 1986:
lambda = lambda_0 (1 - w / w_0) where the manipulability w = sqrt(det J J^T) is below w_0, else 0).

Limits. dq = a + s b, b the part that v commands and a the rest. s in [0, 1] is the largest number
with which every joint keeps its speed limit and its distance to its stops: near a stop the allowed
approach is (distance) / 0.1 s. So a command that cannot be carried out is slowed as a whole, and
never bent. The border of the workspace and the drums alone are slid along: what of v leads out of
it faster than (distance) / 0.1 s is taken off, and the rest remains; for drums see `keepout`.
Slowed as a whole a policy would stand still there for ever, since the tip's position is all that it
goes by.

Acceleration. v is not the command itself but the tip's present velocity plus the change to the
command, shortened, along the command and across it, to `TIP_ACCELERATION` dt each. Far below what
the motors could do, it is what makes the arm gentle: on a drum head, which stops the tip, it pushes
with at most about the tip's inertia (1.2 kg) times that, 25 N, whatever is commanded.

Torques. tau = M (dq - dq_now) / dt + h brings the joints to dq within one control step, M the
inertia and h what the arm needs to go on as it goes (gravity is compensated anyway). Where the
stick presses on a head, what that resists is held against by J^T times it a millisecond later, up
to `HELD_AGAINST`: a stroke follows through a soft head as commanded, and what presses harder gives
way. (The real arm has torque sensors in its joints, and a loop of 1 kHz around them.) Each joint's
torque is cut at its motor's limit; commands in free space stay well below.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np

from iflow_gym.demonstrations import FloatArray
from iflow_gym.envs.drumming.engine import mujoco
from iflow_gym.envs.drumming.keepout import KeepOut
from iflow_gym.envs.drumming.scene import SPEED_LIMITS, TORQUE_LIMITS, Scene

CONTROL_DT: Final = 0.01
"""Seconds a control step."""

POSTURE: Final = np.array([0.0, -0.72, 0.0, -2.4, 0.0, 0.47, 0.0])
"""q_0 in rad: elbow up, the arm in its plane of symmetry."""

TIP_ACCELERATION: Final = 20.0
"""Greatest acceleration of the tip that a command brings about, in m/s^2."""

PROJECTIONS: Final = 8
"""Times that a command is projected onto the borders; what is left over is slowed as a whole."""

HELD_AGAINST: Final = 10.0
"""Greatest force of a head that the motors hold against, in N."""

ORIENTATION_GAIN: Final = 15.0
"""k in 1/s."""
POSTURE_GAIN: Final = 1.0
"""k_0 in 1/s."""
DAMPING: Final = 0.1
"""lambda_0."""
MANIPULABILITY: Final = 0.02
"""w_0; between the drums w is 0.1."""
BRAKING_TIME: Final = 0.1
"""A joint or the tip may approach its limit at the distance to it over this many seconds."""
JOINT_MARGIN: Final = 0.02
"""Rad that the controller stays away from a joint's stop."""


class JointCommand(NamedTuple):
    """What the controller asks of the joints."""

    velocity: FloatArray
    """rad/s, shape (7,)."""
    scale: float
    """In [0, 1]: how much of the command is carried out, s times what the border lets through."""


class Workspace:
    """Where the tip may be: a box, within reach of the arm.

    Reach is a ball for the wrist, which stands at a fixed offset from the tip since the
    orientation is fixed.
    """

    low: Final = np.array([0.58, -0.40, 0.13])
    high: Final = np.array([0.88, 0.40, 0.70])
    centre: Final = np.array([0.36, 0.0, -0.03])
    """Of the ball, in the tip's coordinates: the shoulder less the wrist's offset."""
    radius: Final = 0.77

    @classmethod
    def contains(cls, points: FloatArray) -> Any:
        """Which points, shape (..., 3), are inside; shape (...)."""
        inside = ((points >= cls.low) & (points <= cls.high)).all(axis=-1)
        near = np.linalg.norm(points - cls.centre, axis=-1) <= cls.radius
        return inside & near

    @classmethod
    def slid(cls, point: FloatArray, velocity: FloatArray) -> FloatArray:
        """Return the part of a velocity that is allowed at a point: what leads out is cut down."""
        velocity = cls._boxed(point, velocity)
        arm = point - cls.centre
        length = float(np.sqrt(arm @ arm))
        allowed = max(cls.radius - length, 0.0) / BRAKING_TIME
        for _ in range(PROJECTIONS):  # onto both in turn: near an edge one undoes the other
            excess = float(arm @ velocity) / length - allowed
            if excess <= 0.0:
                return velocity
            velocity = cls._boxed(point, velocity - (excess / length) * arm)
        outward = float(arm @ velocity) / length
        return velocity if outward <= allowed else velocity * (allowed / outward)

    @staticmethod
    def _boxed(point: FloatArray, velocity: FloatArray) -> FloatArray:
        allowed = [
            min(max(v, min(low - x, 0.0) / BRAKING_TIME), max(high - x, 0.0) / BRAKING_TIME)
            for x, v, low, high in zip(point.tolist(), velocity.tolist(), _LOW, _HIGH, strict=True)
        ]
        return np.array(allowed)


_LOW: Final = Workspace.low.tolist()
_HIGH: Final = Workspace.high.tolist()


class Controller:
    """The controller of one arm; `data` is to be as `mujoco.mj_step1` leaves it."""

    def __init__(self, scene: Scene, data: Any) -> None:
        self.scene, self.data = scene, data
        self._drums = KeepOut(scene.drums)
        self._jacobian = np.zeros((6, 7))
        self._lower = scene.lower + JOINT_MARGIN
        self._upper = scene.upper - JOINT_MARGIN
        self._moved = np.zeros(7)
        self._wanted = np.zeros((6, 2))
        self._task = np.zeros((7, 2))

    def jacobian(self) -> FloatArray:
        """Return J at the present state, shape (6, 7), in an array that the next call reuses."""
        mujoco.mj_jacSite(
            self.scene.model, self.data, self._jacobian[:3], self._jacobian[3:], self.scene.tip
        )
        return self._jacobian

    def joint_command(self, velocity: FloatArray, posture: FloatArray = POSTURE) -> JointCommand:
        """Return joint velocities that move the tip with `velocity`, in m/s, shape (3,)."""
        data = self.data
        q = data.qpos
        jacobian = self.jacobian()
        resting = POSTURE_GAIN * (posture - q)
        wanted = self._wanted
        wanted[:, 0] = -jacobian @ resting
        wanted[3:, 0] += ORIENTATION_GAIN * self.rotation_error()
        velocity = self._eased(velocity, jacobian)
        tip = data.site_xpos[self.scene.tip]
        allowed = Workspace.slid(tip, self._drums.slid(tip, velocity))
        wanted[:3, 1] = allowed
        task = jacobian.T @ np.linalg.solve(self._damped(jacobian), wanted)
        low, high = self.speed_limits()
        free = np.minimum(np.maximum(resting + task[:, 0], low), high)
        commanded = task[:, 1]
        scale = _largest_scale(free, commanded, low, high)
        speed = float(np.sqrt(velocity @ velocity))
        share = float(np.sqrt(allowed @ allowed)) / speed if speed > 0 else 1.0
        return JointCommand(free + scale * commanded, scale * min(share, 1.0))

    def _eased(self, velocity: FloatArray, jacobian: FloatArray) -> FloatArray:
        """Return the velocity that the tip's acceleration limit lets it have after this step."""
        present = jacobian[:3] @ self.data.qvel
        change = velocity - present
        most = TIP_ACCELERATION * CONTROL_DT
        if float(change @ change) <= most**2:
            return velocity
        # Along the command and across it apart: pressing on a head must not let the tip slide.
        speed = float(np.sqrt(velocity @ velocity))
        along = velocity * (float(change @ velocity) / speed**2) if speed > 0 else np.zeros(3)
        eased = present + _shortened(along, most) + _shortened(change - along, most)
        return np.asarray(eased, dtype=np.float64)

    def rotation_error(self) -> FloatArray:
        """Return e, which turns the stick back into its fixed orientation, in rad, shape (3,)."""
        r = self.data.site_xmat[self.scene.tip].tolist()
        return np.array([0.5 * (r[5] - r[7]), 0.5 * (r[6] - r[2]), 0.5 * (r[1] - r[3])])

    def _damped(self, jacobian: FloatArray) -> FloatArray:
        gram = jacobian @ jacobian.T
        square = float(np.linalg.det(gram))
        if square < MANIPULABILITY**2:
            w = np.sqrt(max(square, 0.0))
            gram[np.diag_indices(6)] += (DAMPING * (1.0 - w / MANIPULABILITY)) ** 2
        return gram

    def speed_limits(self) -> tuple[FloatArray, FloatArray]:
        """Return the least and the greatest velocity of each joint that its limits allow now."""
        q = self.data.qpos
        low = np.maximum((self._lower - q) / BRAKING_TIME, -SPEED_LIMITS)
        high = np.minimum((self._upper - q) / BRAKING_TIME, SPEED_LIMITS)
        return np.minimum(low, SPEED_LIMITS), np.maximum(high, -SPEED_LIMITS)

    def torque(self, velocity: FloatArray, resistance: FloatArray | None = None) -> FloatArray:
        """Return the torques that bring the joints to `velocity` within a control step.

        `resistance` is a force on the tip in N, shape (3,), that is held against.
        """
        data = self.data
        change = (velocity - data.qvel) / CONTROL_DT
        mujoco.mj_mulM(self.scene.model, data, self._moved, change)
        torque = self.going_on() + self._moved
        if resistance is not None:
            torque += self._holding(resistance)
        return _limited(torque)

    def held(self, torque: FloatArray, resistance: FloatArray) -> FloatArray:
        """Return torques with what holds against a force on the tip, shape (3,) in N."""
        return _limited(torque + self._holding(resistance))

    def _holding(self, resistance: FloatArray) -> FloatArray:
        torque: FloatArray = -self.jacobian()[:3].T @ _shortened(resistance, HELD_AGAINST)
        return torque

    def going_on(self) -> FloatArray:
        """Return h, the torques that keep the joint velocities, shape (7,)."""
        going_on: FloatArray = self.data.qfrc_bias - self.data.qfrc_passive
        return going_on

    def guarded(self, torque: FloatArray) -> tuple[FloatArray, float]:
        """Return what is applied of commanded torques, within the joints' limits, and the share.

        The joint velocities that the torques would bring about within a control step obey the
        limits that commands of the tip obey; the torques are scaled as a whole until they do.
        """
        data = self.data
        low, high = self.speed_limits()
        going_on = self.going_on()
        both = np.stack([-going_on, torque])
        mujoco.mj_solveM(self.scene.model, data, both, both.copy())
        free = data.qvel + CONTROL_DT * both[0]
        kept = np.minimum(np.maximum(free, low), high)
        scale = _largest_scale(kept, CONTROL_DT * both[1], low, high)
        target = kept + scale * CONTROL_DT * both[1]
        return self.torque(target), scale


def _limited(torque: FloatArray) -> FloatArray:
    limited: FloatArray = np.minimum(np.maximum(torque, -TORQUE_LIMITS), TORQUE_LIMITS)
    return limited


def _shortened(vector: FloatArray, most: float) -> FloatArray:
    size = float(np.sqrt(vector @ vector))
    return vector if size <= most else (most / size) * vector


def _largest_scale(free: FloatArray, part: FloatArray, low: FloatArray, high: FloatArray) -> float:
    """Return the largest s in [0, 1] with low <= free + s part <= high; free is within."""
    scale = 1.0
    ends = zip(part.tolist(), free.tolist(), low.tolist(), high.tolist(), strict=True)
    for by, begin, least, most in ends:
        room = most - begin if by > 0 else begin - least
        if abs(by) > room:
            scale = min(scale, room / abs(by))
    return max(scale, 0.0)
