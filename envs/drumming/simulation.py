"""The arm in motion: MuJoCo's state, the contacts of stick and heads, hits as they happen."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from iflow_gym.datasets.drums import Drum
from iflow_gym.demonstrations import FloatArray
from iflow_gym.envs.drumming.control import CONTROL_DT, POSTURE, Controller, Workspace
from iflow_gym.envs.drumming.engine import mujoco
from iflow_gym.envs.drumming.scene import PHYSICS_DT, load_scene
from iflow_gym.metrics.drumming import Hit, HitDetector

SUBSTEPS: Final = round(CONTROL_DT / PHYSICS_DT)

IK_ITERATIONS: Final = 200
IK_TOLERANCE: Final = 1e-6
"""In m and rad."""
IK_STEP: Final = 0.3
"""Longest step of an iteration, in m and rad."""
OVERLAP: Final = 0.0005
"""A posture in which stick and drum overlap by more than this, in m, is no start."""


class UnreachableError(ValueError):
    """A position that the arm cannot take with the tip of its stick."""


class Simulation:
    """One arm before its drums.

    Attributes
    ----------
    data : mujoco.MjData
        As `mujoco.mj_step1` leaves it: kinematics, inertia and contacts belong to the present
        positions and velocities.
    peak_forces : list of float
        Largest force on each head in the last control step, in N.
    """

    def __init__(self, drums: tuple[Drum, ...]) -> None:
        self.scene = load_scene(drums)
        self.model = self.scene.model
        self.data = mujoco.MjData(self.model)
        self.controller = Controller(self.scene, self.data)
        self.peak_forces = [0.0] * len(drums)
        self._silent = (0.0,) * len(drums)
        self._detector = HitDetector(len(drums), PHYSICS_DT)
        self._force = np.zeros(6)
        self._resistance = np.zeros(3)

    # State --------------------------------------------------------------------------------

    @property
    def tip(self) -> FloatArray:
        """Position of the stick's tip in m, shape (3,), a copy."""
        return np.array(self.data.site_xpos[self.scene.tip])

    @property
    def tip_velocity(self) -> FloatArray:
        """Velocity of the tip in m/s, shape (3,)."""
        velocity: FloatArray = self.controller.jacobian()[:3] @ self.data.qvel
        return velocity

    def place(self, tip: FloatArray, velocity: FloatArray | None = None) -> None:
        """Begin anew with the tip at a position, moving with a velocity; no hit has happened.

        Raises
        ------
        UnreachableError
            If the arm cannot hold the tip there, or the stick would be in a drum.
        """
        self._detector.reset()
        self.peak_forces = [0.0] * len(self._silent)
        self._resistance = np.zeros(3)
        mujoco.mj_resetData(self.model, self.data)
        self._solve(tip, POSTURE)
        self._check_clear(tip)
        if velocity is not None:
            jacobian = self.controller.jacobian()
            twist = np.concatenate([velocity, np.zeros(3)])
            self.data.qvel[:] = np.linalg.lstsq(jacobian, twist, rcond=1e-3)[0]
        mujoco.mj_step1(self.model, self.data)

    def displace(self, by: FloatArray) -> None:
        """Move the tip aside at once, joint velocities kept, as far as arm and drums allow."""
        start, posture = self.tip, self.data.qpos.copy()
        self._resistance = np.zeros(3)
        for share in np.linspace(1.0, 0.0, 21):
            self.data.qpos[:] = posture
            try:
                self._solve(start + share * by, posture)
                self._check_clear(start + share * by)
            except UnreachableError:
                continue
            break
        else:
            self.data.qpos[:] = posture
        mujoco.mj_step1(self.model, self.data)

    def _solve(self, tip: FloatArray, posture: FloatArray) -> None:
        """Put the tip at a position, in the posture nearest to a given one.

        The controller's own equation, iterated with unit gain (Newton's method), within the joints'
        limits.
        """
        if not Workspace.contains(tip):
            raise UnreachableError(
                f"Expected a position within the arm's reach, got {_shown(tip)}: x, y, z from "
                f"{_shown(Workspace.low)} to {_shown(Workspace.high)}, and at most "
                f"{Workspace.radius} m from {_shown(Workspace.centre)}."
            )
        model, data, scene = self.model, self.data, self.scene
        data.qpos[:] = posture
        for _ in range(IK_ITERATIONS):
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            jacobian = self.controller.jacobian()
            error = np.concatenate(
                [tip - data.site_xpos[scene.tip], self.controller.rotation_error()]
            )
            size = float(np.linalg.norm(error))
            drift = POSTURE_STEP * (posture - data.qpos)
            gram = jacobian @ jacobian.T + 1e-8 * np.eye(6)
            towards = np.linalg.solve(
                gram,
                np.stack([min(1.0, IK_STEP / max(size, IK_STEP)) * error, jacobian @ drift], 1),
            )
            side = drift - jacobian.T @ towards[:, 1]
            step = jacobian.T @ towards[:, 0] + side
            if size < IK_TOLERANCE and float(np.abs(side).max()) < 1e-4:
                return
            data.qpos[:] = np.clip(data.qpos + step, scene.lower + 0.02, scene.upper - 0.02)
        if size >= IK_TOLERANCE:
            raise UnreachableError(
                f"Expected a position that the arm can take, got {_shown(tip)}: a joint's limit "
                f"keeps the tip {1000 * size:.1f} mm (or mrad) away."
            )

    def _check_clear(self, tip: FloatArray) -> None:
        mujoco.mj_fwdPosition(self.model, self.data)
        if self.data.ncon and float(self.data.contact.dist.min()) < -OVERLAP:
            raise UnreachableError(
                f"Expected a position clear of the drums, got {_shown(tip)}: there the stick would "
                "be inside a drum or the floor; start higher or further away."
            )

    # Motion -------------------------------------------------------------------------------

    @property
    def resistance(self) -> FloatArray:
        """Force of the heads on the stick in N, shape (3,), at the end of the last step."""
        return self._resistance.copy()

    def advance(
        self, torque: FloatArray, push: FloatArray | None = None, *, holding: bool = False
    ) -> list[Hit]:
        """Hold torques, and a force in N on the tip, for a control step.

        With `holding` the motors hold against the heads' resistance at each physics step. Returns
        the hits that were decided: a hit is reported when the window of its peak force has passed.
        """
        model, data, detector = self.model, self.data, self._detector
        data.ctrl[:] = torque
        data.qfrc_applied[:] = 0.0 if push is None else self.controller.jacobian()[:3].T @ push
        peaks = list(self._silent)
        hits: list[Hit] = []
        resisted = holding and bool(self._resistance.any())
        for _ in range(SUBSTEPS):
            if resisted:
                data.ctrl[:] = self.controller.held(torque, self._resistance)
            mujoco.mj_step2(model, data)
            if data.ncon:
                forces: Sequence[float] = self._head_forces()
                peaks = list(map(max, peaks, forces))
                resisted = holding
            else:
                forces = self._silent
                self._resistance[:] = 0.0
            hits += detector.update(forces)
            mujoco.mj_step1(model, data)
        self.peak_forces = peaks
        return hits

    def pending_hits(self) -> list[Hit]:
        """Return the hits whose window of peak force is still open, with the force so far."""
        return self._detector.flush()

    def _head_forces(self) -> list[float]:
        """Return the normal force of the stick on each head in N; note what they do to the tip."""
        scene, forces = self.scene, list(self._silent)
        self._resistance[:] = 0.0
        for index, (first, second) in enumerate(self.data.contact.geom.tolist()):
            drum = scene.head_geoms.get(first, scene.head_geoms.get(second, -1))
            if drum >= 0 and (first in scene.stick_geoms or second in scene.stick_geoms):
                mujoco.mj_contactForce(self.model, self.data, index, self._force)
                forces[drum] += float(self._force[0])
                # In a contact's frame the force is that of the first geom on the second.
                on_stick = 1.0 if second in scene.stick_geoms else -1.0
                frame = self.data.contact.frame[index].reshape(3, 3)
                self._resistance += on_stick * self._force[:3] @ frame
        return forces


POSTURE_STEP: Final = 0.2
"""Share of the way to the posture that an iteration of the inverse kinematics takes."""


def _shown(vector: FloatArray) -> str:
    return np.array2string(np.asarray(vector), precision=3, separator=", ")
