"""What a Dask task runs in a process of its own: `python -m iflow_gym.baselines.runner.remote DIR`.

DIR holds the pickled jobs. Each event of the journal becomes a numbered file in ``DIR/messages``,
with the bytes of the record and the model where a cell is done; the task sends them on. Pickles go
between the processes of one run alone, as everything in Dask does; no result or model is one.
"""

from __future__ import annotations

import pickle
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from iflow_gym.baselines.runner.fingerprint import core_hash, method_code, versions
from iflow_gym.baselines.runner.plan import Job, demonstrations_of, entry_points, task_of
from iflow_gym.evaluate import motion_of
from iflow_gym.metrics import metrics_hash


@dataclass(frozen=True)
class Shipment:
    """What is sent once: every job of the run, and the code of methods from outside."""

    jobs: tuple[Job, ...]
    code: dict[str, bytes]
    """Python files by their path relative to a folder of `sys.path`."""


def read_message(content: bytes) -> dict[str, Any]:
    """Return an event of a journal that a task sent."""
    event: dict[str, Any] = pickle.loads(content)
    return event


def differences(jobs: Sequence[Job]) -> list[str]:
    """Return in what this machine differs from the one that planned the jobs.

    A record names the code, the data and the versions that it was made with, and these are the
    planner's: a worker that has others would make records that are not true.
    """
    found: dict[str, None] = {}
    for cell in (cell for job in jobs for cell in job.batch):
        entry = cell.entry
        here = versions(entry.libraries)
        for name in sorted(here | entry.versions):
            if here.get(name) != entry.versions.get(name):
                found[f"{name} {here.get(name)} instead of {entry.versions.get(name)}"] = None
        hashes = _hashes(entry.target.partition(":")[0], cell.environment)
        for name, value in hashes.items():
            if value != cell.hashes[name]:
                what = {"data": cell.environment, "code": entry.name}.get(name, "iflow_gym")
                found[f"other {name} of {what}"] = None
    return list(found)


@cache
def _hashes(module: str, environment: str) -> dict[str, str]:
    motion = motion_of(task_of(environment))
    return {
        "code": method_code(module).sha256,
        "core": core_hash(entry_points(environment), motion),
        "data": demonstrations_of(environment).sha256,
        "metrics": metrics_hash(motion),
    }


def main(folder: Path) -> int:
    """Run the jobs of a folder; return the exit status."""
    from iflow_gym.baselines.registry import load_class
    from iflow_gym.baselines.runner.pool import Pool
    from iflow_gym.baselines.runner.work import end_with_parent

    end_with_parent()
    jobs: list[Job] = pickle.loads((folder / "jobs").read_bytes())
    for target in sorted({cell.entry.target for job in jobs for cell in job.batch}):
        load_class(target, {})  # its module may register environments of its own
    if found := differences(jobs):
        print(
            f"it has {', '.join(found)}: give all workers the installation that the run is "
            "started from.",
            file=sys.stderr,
        )
        return 3
    messages = folder / "messages"
    messages.mkdir()
    results = folder / "results"
    results.mkdir()
    count = 0

    def send(event: dict[str, Any]) -> None:
        nonlocal count
        if event["event"] == "done":
            record = results / event["path"]
            model = record.with_suffix(".safetensors")
            content = model.read_bytes() if model.exists() else None
            event = {**event, "record": record.read_bytes(), "model": content}
        partial = folder / "partial"
        partial.write_bytes(pickle.dumps(event))
        partial.replace(messages / str(count))
        count += 1

    Pool(results, 1, send).run(jobs)
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
