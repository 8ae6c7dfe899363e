"""``iflow-gym envs``: the environments and whether their data are here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

from tyro.conf import Positional

from iflow_gym.cli.console import UsageError, print_json
from iflow_gym.recordings.columns import shown


class Family(NamedTuple):
    """Environments of one kind, by how their ids begin."""

    name: str
    motion: str
    data: str
    """Name of the data set, as `iflow-gym data` has it."""


FAMILIES = {
    "iflow/LASA-Multi": Family("LASA-Multi", "ends", "lasa"),
    "iflow/LASA-": Family("LASA-26", "ends", "lasa"),
    "iflow/Disturbed-": Family("Disturbed", "ends, with an unknown mass in a wind", "lasa"),
    "iflow/Letter-": Family("Letter", "repeats", "letters"),
    "iflow/LetterRecorded-": Family("LetterRecorded", "repeats", "recorded-letters"),
    "iflow/DrummingRecorded": Family(
        "DrummingRecorded", "repeats, an arm in MuJoCo", "recorded-drums"
    ),
    "iflow/Drumming-": Family("Drumming", "repeats, an arm in MuJoCo", "drums"),
    "iflow/PointMass": Family("PointMass", "ends or repeats", "your own"),
}
"""The first that an id begins with counts."""


@dataclass(frozen=True)
class Envs:
    """List the environments: family, kind of motion, and whether the data are on this machine.

    PATTERNS are globs over ids or short names, in quotes for the shell.

        iflow-gym envs
        iflow-gym envs 'LASA-S*' 'Letter*'
        iflow-gym envs --json | jq -r '.[].id'
    """

    patterns: Annotated[Positional[tuple[str, ...]], shown("[PATTERN...]")] = ()
    """Globs over ids or short names; all by default."""
    json: bool = False
    """Print JSON."""

    def run(self) -> int:
        """List them."""
        from iflow_gym.baselines.registry import UnknownNameError
        from iflow_gym.cli.datasets import STATUSES, status_of
        from iflow_gym.registration import matching_ids, register_all, registered_ids

        register_all()
        try:
            chosen = matching_ids(self.patterns or ("*",), registered_ids())
        except UnknownNameError as error:
            raise UsageError(str(error)) from error
        rows = []
        statuses = {name: status_of(name).state for name in STATUSES}
        for env_id in chosen:
            family = next(f for prefix, f in FAMILIES.items() if env_id.startswith(prefix))
            rows.append(
                {
                    "id": env_id,
                    "family": family.name,
                    "motion": family.motion,
                    "data": family.data,
                    "status": statuses.get(family.data, "your own file"),
                }
            )
        if self.json:
            print_json(rows)
            return 0
        wide = max(len(r["id"]) for r in rows) + 2
        long = max(len(r["family"]) for r in rows) + 2
        for r in rows:
            print(f"{r['id']:<{wide}}{r['family']:<{long}}{r['status']:<16}{r['motion']}")
        return 0
