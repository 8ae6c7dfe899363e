"""Environment ids: every environment of the suite, by name.

Any change that may change a score bumps an id's version.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase

import gymnasium

from iflow_gym.datasets.lasa import SHAPES
from iflow_gym.datasets.letters import LETTERS

POINT_MASS_ID = "iflow/PointMass-v0"
"""The id that takes the caller's own `demonstrations`."""


DRUMMING_ID = "iflow/Drumming-v0"
DRUMMING_RECORDED_ID = "iflow/DrummingRecorded-v0"


def lasa_id(shape: str) -> str:
    """Return the id of a LASA shape."""
    return f"iflow/LASA-{shape}-v0"


def disturbed_id(shape: str) -> str:
    """Return the id of a LASA shape that an unknown mass is to draw in a wind."""
    return f"iflow/Disturbed-{shape}-v0"


def letter_id(letter: str, *, recorded: bool = False) -> str:
    """Return the id of a letter, of the suite's own or of the recorded ones."""
    return f"iflow/Letter{'Recorded' if recorded else ''}-{letter}-v0"


def register_all() -> None:
    """Register every id with Gymnasium; ids that are registered already stay as they are."""
    _register(POINT_MASS_ID, "point_mass:PointMassEnv", "point_mass_vector:PointMassVectorEnv")
    for shape in SHAPES:
        _register(lasa_id(shape), "lasa:LASAEnv", "lasa:LASAVectorEnv", shape=shape)
        points = ("DisturbedLASAEnv", "DisturbedLASAVectorEnv")
        _register(disturbed_id(shape), *(f"disturbed:{name}" for name in points), shape=shape)
    for name in ("Letter", "LetterRecorded"):
        for letter in LETTERS:
            env_id = letter_id(letter, recorded=name == "LetterRecorded")
            _register(env_id, f"letters:{name}Env", f"letters:{name}VectorEnv", letter=letter)
    arms = "drumming.vector:Drumming"
    _register(DRUMMING_ID, "drumming.env:DrummingEnv", f"{arms}VectorEnv")
    recorded = "drumming.recorded:DrummingRecordedEnv"
    _register(DRUMMING_RECORDED_ID, recorded, f"{arms}RecordedVectorEnv")


def registered_ids() -> list[str]:
    """Return the ids of the suite's environments, in the order of their registration."""
    return [i for i in gymnasium.registry if i.startswith("iflow/")]


def matching_ids(patterns: Iterable[str], ids: Sequence[str]) -> list[str]:
    """Return those of some ids that globs match, over ``iflow/LASA-Angle-v0``, ``LASA-Angle-v0`` or
    ``LASA-Angle``.

    Raises
    ------
    UnknownNameError
        For a pattern that matches none, with the nearest ids and how to list all.
    """
    from iflow_gym.baselines.registry import UnknownNameError

    names = {i: (i, i.partition("/")[2], short_name(i)) for i in ids}
    chosen: dict[str, None] = {}
    for pattern in patterns:
        found = [i for i, known in names.items() if any(fnmatchcase(n, pattern) for n in known)]
        if not found:
            raise UnknownNameError(
                f"Unknown environment {pattern!r}.{did_you_mean(pattern, ids)} `iflow-gym envs` "
                "lists them all."
            )
        chosen |= dict.fromkeys(found)
    return list(chosen)


def short_name(env_id: str) -> str:
    """Return an id without its namespace and its version: ``LASA-Angle`` of iflow/LASA-Angle-v0."""
    return env_id.partition("/")[2].rpartition("-v")[0]


def did_you_mean(name: str, ids: Iterable[str]) -> str:
    """Return a sentence with those of some ids that a name is likely to mean; empty if none is."""
    known = [short_name(i) for i in ids]
    words: dict[str, list[str]] = {}  # whole names, and what is after the family
    for short in known:
        for word in {short.lower(), short.lower().rpartition("-")[2]}:
            words.setdefault(word, []).append(short)
    sought = re.sub(r"-v\d*$", "", name.lower().removeprefix("iflow/").strip("*"))
    near = [s for w in difflib.get_close_matches(sought, words, n=3, cutoff=0.7) for s in words[w]]
    near = list(dict.fromkeys(near))[:3]
    return f" Did you mean {' or '.join(near)}?" if near else ""


def _register(
    env_id: str, entry_point: str, vector_entry_point: str | None = None, **kwargs: object
) -> None:
    if env_id not in gymnasium.registry:
        gymnasium.register(
            env_id,
            entry_point=f"iflow_gym.envs.{entry_point}",
            vector_entry_point=vector_entry_point and f"iflow_gym.envs.{vector_entry_point}",
            kwargs=kwargs,
        )
