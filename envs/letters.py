"""Letters traced round and round: `iflow/Letter-<Letter>-v0` and the recorded ones."""

from __future__ import annotations

from typing import Any

from iflow_gym.datasets.letters import LETTERS, load_letter
from iflow_gym.datasets.recorded import load_recorded_letter
from iflow_gym.envs.point_mass import PointMassEnv
from iflow_gym.envs.point_mass_vector import PointMassVectorEnv

RIVALS = tuple(f"iflow/Letter-{letter}-v0" for letter in LETTERS)
"""The letters that a model of one is to be told apart from."""


class LetterEnv(PointMassEnv):
    """A `PointMassEnv` with twenty demonstrations of a letter, the last ten held out.

    ## Description
    The point mass is a pen that traces the outline of I, R, O or S round and round, four rounds a
    demonstration, as a person does: slower where the outline bends, and from round to round a
    little larger, aslant, elsewhere, faster. The outline never crosses itself, so that it can be
    the limit cycle of a system in the plane. Demonstrations begin anywhere on it. Both protocols
    fit on the first ten; generalisation scores on the last ten, which no method has seen. See
    `iflow_gym.datasets.letters` for the model of handwriting. `rivals` are the four ids: a model of
    one letter is asked how likely it finds the others.

    Actions, observations, rewards and the rest are `PointMassEnv`'s for a motion that repeats.

    ## Arguments
    | argument | default | meaning |
    | --- | --- | --- |
    | `letter` | required | one of `iflow_gym.datasets.letters.LETTERS`; given by the id |
    | the rest | | as in `PointMassEnv` |

    ## Version History
    * v0: Initial version.
    """

    rivals = RIVALS

    def __init__(self, letter: str, **kwargs: Any) -> None:
        super().__init__(load_letter(letter), **kwargs)


class LetterVectorEnv(PointMassVectorEnv):
    """A `PointMassVectorEnv` with the demonstrations of a letter."""

    rivals = RIVALS

    def __init__(self, letter: str, num_envs: int = 1, **kwargs: Any) -> None:
        super().__init__(load_letter(letter), num_envs, **kwargs)


class LetterRecordedEnv(PointMassEnv):
    """A `PointMassEnv` with the recordings of a letter that ImitationFlow's authors published.

    ## Description
    Three recordings of I, two of R, one of O and of S, of about four rounds each, at 100 Hz (Urain
    et al. 2020, sec. IV-B; MIT licence, Copyright (c) 2020 Julen Urain). They are downloaded when
    first asked for and kept; without a network see `iflow_gym.datasets.recorded` for a mirror. O
    and S have one recording, and so no generalisation protocol.

    Actions, observations, rewards and the rest are `PointMassEnv`'s for a motion that repeats.

    ## Arguments
    | argument | default | meaning |
    | --- | --- | --- |
    | `letter` | required | one of `iflow_gym.datasets.letters.LETTERS`; given by the id |
    | `mirror` | `None` | folder that holds the files, in place of a download |
    | the rest | | as in `PointMassEnv` |

    ## Version History
    * v0: Initial version.
    """

    def __init__(self, letter: str, mirror: str | None = None, **kwargs: Any) -> None:
        super().__init__(load_recorded_letter(letter, mirror=mirror), **kwargs)


class LetterRecordedVectorEnv(PointMassVectorEnv):
    """A `PointMassVectorEnv` with the recordings of a letter."""

    def __init__(
        self, letter: str, num_envs: int = 1, mirror: str | None = None, **kwargs: Any
    ) -> None:
        super().__init__(load_recorded_letter(letter, mirror=mirror), num_envs, **kwargs)
