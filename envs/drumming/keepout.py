r"""Where a command does not lead the stick: into a drum's side, or deep into its head.

A head gives way, and a stroke follows through it; but a policy that sees the tip alone may command
it on and on into the drum, and there it would stay pressed. So below `FOLLOW_THROUGH` under a head
the drum counts as a solid cylinder, along which the command slides: what of it leads towards the
cylinder faster than (distance) / `BRAKING_TIME` is taken off, the rest remains. The tip is a
sphere, so the cylinder is wider than the drum by its radius.

With r the horizontal distance from the drum's axis, outside means above the face, r <= R and
z >= f, or beside the wall, r >= R. Below the face and within the wall, the nearer of the two leads
out, at up to `CLIMB`, however deep it is. Beside the wall r is that of the stick, which lies behind
the tip and rises: of its point nearest to the axis among those below the face. Its orientation is
held, so that all of it moves as the tip does. Where a wall takes off of a command, the tip rises at
least as fast as was taken off, up to `CLIMB`: over a drum the way is free, and a command that leads
into a wall and down it, or into the wedge between a wall and the border of the workspace, would
come to rest there for ever.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot
from typing import Final

import numpy as np

from iflow_gym.datasets.drums import TIP_RADIUS, Drum
from iflow_gym.demonstrations import FloatArray
from iflow_gym.envs.drumming.scene import STICK_BACK, STICK_FRONT, STICK_PITCH

FOLLOW_THROUGH: Final = 0.016
"""How far a command may lead into a head, in m; the demonstrations' strokes end 11 to 14 mm in."""

BRAKING_TIME: Final = 0.03
"""The tip may approach a drum at the distance to it over this many seconds: a stroke is not
slowed before it meets the head."""

CLIMB: Final = 0.1
"""Speed in m/s up to which a tip that is led into a wall rises, and out of a drum it is led."""

REACH: Final = float((STICK_FRONT + STICK_BACK) * np.cos(STICK_PITCH))
"""Horizontal length of the stick behind the tip, along -x, in m."""

RISE: Final = float(np.tan(STICK_PITCH))
"""By how much the stick is higher, a metre behind the tip."""

RIM: Final = 0.007
"""How much wider than its head a drum is, in m."""


class KeepOut:
    """The drums as obstacles of a tip's commands."""

    def __init__(self, drums: Sequence[Drum]) -> None:
        self._solids = [
            (*drum.head[:2], drum.head[2] + TIP_RADIUS - FOLLOW_THROUGH,
             drum.radius + RIM + TIP_RADIUS)
            for drum in drums
        ]  # fmt: skip

    def slid(self, point: FloatArray, velocity: FloatArray) -> FloatArray:
        """Return the part of a velocity, shape (3,), that is allowed with the tip at a point."""
        x, y, z = point.tolist()
        for centre_x, centre_y, face, wall in self._solids:
            across, along = x - centre_x, y - centre_y
            r = hypot(across, along)
            above, beside = z - face, r - wall
            if beside <= 0.0 and above >= beside:
                least = min(-above / BRAKING_TIME, CLIMB)
                if velocity[2] < least:
                    velocity = np.array([velocity[0], velocity[1], least])
            elif above < 0.0:
                # The stick's nearest point below the face is where it touches.
                across -= min(max(across, 0.0), REACH, -above / RISE)
                r = hypot(across, along)
                beside = r - wall
                # On the axis every way out is as short.
                out = np.array([across / r, along / r, 0.0] if r else [1.0, 0.0, 0.0])
                least, towards = min(-beside / BRAKING_TIME, CLIMB), float(out @ velocity)
                if towards < least:
                    velocity = velocity + (least - towards) * out
                    velocity[2] = max(velocity[2], min(least - towards, CLIMB))
        return velocity
