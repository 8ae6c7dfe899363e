"""Which environments' demonstrations can be exported, and which of them globs mean."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase

import gymnasium

from iflow_gym.minari_datasets.export import dataset_id_of


def exportable() -> list[str]:
    """Return the ids of the environments that have demonstrations of their own."""
    import iflow_gym  # noqa: F401 (registers them)

    found = []
    for env_id in (i for i in gymnasium.registry if i.startswith("iflow/")):
        try:
            dataset_id_of(env_id)
        except ValueError:
            continue
        found.append(env_id)
    return found


def chosen_environments(patterns: Sequence[str]) -> list[str]:
    """Return the exportable environments that globs over ids or short names match.

    Raises ValueError for a pattern that matches none.
    """
    known = exportable()
    chosen: dict[str, None] = {}
    for pattern in patterns:
        found = [
            i
            for i in known
            if any(fnmatchcase(n, pattern) for n in (i, i[6:], i[6:].rpartition("-v")[0]))
        ]
        if not found:
            raise ValueError(
                f"Expected environments with demonstrations of their own that match {pattern!r}, "
                "got none: `iflow-gym envs` lists all."
            )
        chosen |= dict.fromkeys(found)
    return list(chosen)
