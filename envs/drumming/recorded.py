"""The ImitationFlow authors' own recording of drumming, before the robot of this suite.

Placement. The recording is in the frame of another robot. It is shifted by `SHIFT`, neither turned
nor scaled, so that the middle between the drums is straight ahead and the strokes lie where the arm
moves well. Then a drum is set under the strokes of either side: its centre is their mean, and its
head so high that the highest of them reaches 2 mm beyond first contact. The recorded turns differ
in height by 1.5 cm on the right and 3.3 cm on the left, so others follow through up to 3.5 cm into
the head; the arm lets the deepest of them go less deep.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.signal import find_peaks

from iflow_gym.datasets.drums import TIP_RADIUS, Drum
from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.envs.drumming.env import DrummingEnv

SHIFT: Final = np.array([0.115, 0.3275, -0.87])
"""From the recording's frame to that of the arm's base, in m."""
CONTACT: Final = 0.002
"""How far beyond first contact the shallowest stroke of a drum reaches, in m."""
PROMINENCE: Final = 0.02
"""A turn is a lowest point that the hand lifts at least so far from, in m."""


class DrummingRecordedEnv(DrummingEnv):
    """A `DrummingEnv` with the authors' own recording, and drums under its strokes.

    ## Description
    Six kinesthetic recordings of a person leading a robot's arm, 10 s each, published with the
    ImitationFlow paper. They are shifted by (0.115, 0.3275, -0.87) m into the arm's workspace. A
    drum is set under the strokes of either side; `iflow_gym.envs.drumming.recorded` says how. Each
    recording but the last ends with the round that the next one begins with, so that a split of
    them holds nothing back. Actions, observations, rewards and the rest are `DrummingEnv`'s.

    ## Arguments
    | argument | default | meaning |
    | --- | --- | --- |
    | `mirror` | `None` | folder with the recordings, in place of a download |
    | the rest | | as in `DrummingEnv`, but `demonstrations` and `drums` |

    ## Version History
    * v0: Initial version.
    """

    def __init__(self, mirror: str | Path | None = None, **kwargs: Any) -> None:
        recording = import_module("iflow_gym.datasets.recorded").load_recorded_drums(mirror)
        demonstrations = placed(recording)
        super().__init__(demonstrations, drums_under(demonstrations), **kwargs)


def placed(recording: Demonstrations) -> Demonstrations:
    """Return the recording, shape (T, 3) each and in its own frame, shifted before the arm."""
    return Demonstrations.from_arrays(
        [positions + SHIFT for positions in recording.positions],
        velocities=list(recording.velocities),
        dt=recording.dt,
        period=recording.period,
        name=recording.name,
        source=f"{recording.source}, shifted by {SHIFT.tolist()} m",
    )


def drums_under(demonstrations: Demonstrations) -> tuple[Drum, Drum]:
    """Return a drum under the strokes on the right, y < 0, and one under those on the left."""
    turns = np.concatenate([_turns(positions) for positions in demonstrations.positions])
    drums = []
    for name, side in (("right", turns[:, 1] < 0), ("left", turns[:, 1] >= 0)):
        x, y = turns[side, :2].mean(axis=0).round(4).tolist()
        height = float(turns[side, 2].max()) + CONTACT - TIP_RADIUS
        drums.append(Drum(name, (x, y, round(height, 4))))
    return drums[0], drums[1]


def _turns(positions: FloatArray) -> FloatArray:
    """Return the lowest points between one lift and the next, shape (n, 3)."""
    lowest, _ = find_peaks(-positions[:, 2], prominence=PROMINENCE)
    turns: FloatArray = positions[lowest]
    return turns
