"""The LASA handwriting motions as environments: `iflow/LASA-<Shape>-v0`."""

from __future__ import annotations

from typing import Any

from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.envs.point_mass import PointMassEnv
from iflow_gym.envs.point_mass_vector import PointMassVectorEnv


class LASAEnv(PointMassEnv):
    """A `PointMassEnv` with the seven recordings of a LASA shape; lengths are millimetres.

    ## Description
    The point mass is a pen: 30 planar handwriting motions, 7 recordings of 1000 samples each, all
    ending at the origin. Actions, observations, rewards and the rest are `PointMassEnv`'s.

    ## Arguments
    | argument | default | meaning |
    | --- | --- | --- |
    | `shape` | required | one of `iflow_gym.datasets.lasa.SHAPES`; given by the id |
    | the rest | | as in `PointMassEnv` |

    ## Version History
    * v0: Initial version, on LASA version 2.
    """

    def __init__(self, shape: str, **kwargs: Any) -> None:
        super().__init__(load_lasa(shape), **kwargs)


class LASAVectorEnv(PointMassVectorEnv):
    """A `PointMassVectorEnv` with the seven recordings of a LASA shape."""

    def __init__(self, shape: str, num_envs: int = 1, **kwargs: Any) -> None:
        super().__init__(load_lasa(shape), num_envs, **kwargs)
