"""Run methods on environments and write a record for each cell; the leaderboard is built of these.

A cell is (method, environment, protocol, seed). A second run redoes only the cells whose key has
changed: their settings, their code, the code that scores, the data, or a library's version. What
failed is tried again. Ctrl-C keeps what is done.

    python baselines/run_all.py --preset smoke
    python baselines/run_all.py --methods 'imitation-*' linear --envs 'LASA-Sharp*' --jobs 2

From any folder, with a method of one's own, also where iflow_gym is installed without its checkout:

    python -m iflow_gym.baselines.run_all --method my_module:MyMethod --output results

On the workers of a Dask cluster (docs/clusters.md), where Ctrl-C and a new run do the same:

    python baselines/run_all.py --backend dask --scheduler tcp://host:8786

Methods that fit several motions together do so in batches of the selected environments, and scores
depend a little on the batch: another selection of environments is another batch, hence a new run.

Exit status: 0 when every cell has scores, 1 when one failed, 2 for a name or a preset that is not
understood, 3 where the run could not go on (the disk is full, another run writes into the folder,
no scheduler is there), 130 after Ctrl-C, 143 after SIGTERM. Whatever ended a run, records are whole
or absent, and the next run goes on from there.
"""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn

from tyro.conf import arg

if TYPE_CHECKING:
    from rich.console import Console

    from iflow_gym.baselines.runner.plan import Job

# What is heavy is imported where it is used: workers import this file, too.


@dataclass(frozen=True)
class RunOptions:
    """What to run and where to write it."""

    preset: Literal["smoke", "standard", "full"] = "standard"
    """smoke: a minute, for CI. standard: the leaderboard's numbers, one seed. full: three seeds."""
    methods: Annotated[tuple[str, ...], arg(aliases=["--method"])] = ()
    """Globs over registered names, references among them; or anyone's package.module:Class, which
    runs with its default settings. All by default."""
    envs: tuple[str, ...] = ()
    """Globs over environments' ids or short names, such as 'LASA-S*'. The preset's by default."""
    seeds: tuple[int, ...] = ()
    """Seeds; the preset's by default. Methods without randomness take the first one only."""
    jobs: int | None = None
    """Worker processes, of one thread each. As many as there are cores by default."""
    protocol: Literal["reproduction", "generalisation", "both"] | None = None
    """What to fit and to score on; the preset's by default."""
    output: Path | None = None
    """Folder of the results. By default leaderboard/results of the checkout that iflow_gym is
    installed from, else of the current folder; for smoke results/smoke, whose few steps are no
    scores for a leaderboard."""
    time_limit: float | None = None
    """Seconds that a cell may take to be fitted and scored; the preset's by default."""
    force: bool = False
    """Redo cells that are up to date."""
    backend: Literal["processes", "dask"] = "processes"
    """Where cells run: in processes of this machine, or on the workers of a Dask cluster."""
    scheduler: str | None = None
    """Address of the Dask scheduler, such as tcp://host:8786."""
    json: Path | None = None
    """File to write what the run did into: cells, seconds, and what each method took of them."""


def run_all(options: RunOptions, console: Console) -> int:
    """Run what `options` say; return 1 if a cell failed, else 0.

    Raises
    ------
    ValueError
        If a method, an environment or a preset is unknown.
    FolderInUseError
        If another run writes into the folder.
    CannotWriteError, OSError
        If the disk is full or worse.
    ClusterError
        If there is no scheduler, or its workers run other code, data or libraries.
    KeyboardInterrupt
        On Ctrl-C.
    """
    from iflow_gym.baselines.runner import plan
    from iflow_gym.baselines.runner.lock import output_lock
    from iflow_gym.baselines.runner.presets import load_preset
    from iflow_gym.baselines.runner.report import Reporter, Spent, summary
    from iflow_gym.baselines.runner.store import cannot_write, sweep
    from iflow_gym.demonstrations import PROTOCOLS
    from iflow_gym.results import read_result

    preset = load_preset(options.preset)
    if options.protocol is not None:
        chosen = PROTOCOLS if options.protocol == "both" else (options.protocol,)
        preset = dataclasses.replace(preset, protocols=chosen)
    if options.seeds:
        preset = dataclasses.replace(preset, seeds=options.seeds)
    if options.time_limit is not None:
        preset = dataclasses.replace(preset, time_limit=options.time_limit)
    jobs = os.cpu_count() or 1 if options.jobs is None else options.jobs
    if jobs < 1 or preset.time_limit <= 0:
        raise ValueError(f"Expected jobs >= 1 and time_limit > 0, got {jobs}, {preset.time_limit}.")
    if (options.backend == "dask") != (options.scheduler is not None):
        raise ValueError(
            "Expected --backend dask and --scheduler ADDRESS together, got "
            f"--backend {options.backend} and the scheduler {options.scheduler}."
        )
    folder = (options.output or default_output(options.preset)).resolve()
    entries = plan.select_entries(options.methods, options.preset)
    environments = plan.select_environments(options.envs or preset.environments)
    cells = plan.make_cells(entries, environments, preset)
    if options.json is not None and not options.json.resolve().parent.is_dir():
        raise ValueError(f"Expected a file in a folder that exists for --json, got {options.json}.")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(error, folder) from error

    began = time.monotonic()
    spent = Spent()
    with output_lock(folder):
        sweep(folder)
        broken = [text for cell in cells if (text := plan.what_is_broken(cell, folder)) is not None]
        to_do = [c for c in cells if options.force or not plan.is_up_to_date(c, folder)]
        with Reporter(console, len(to_do)) as reporter:

            def on_event(event: dict[str, Any]) -> None:
                spent.event(event)
                reporter.event(event)

            workers = f"{min(jobs, max(len(to_do), 1))} workers"
            if options.scheduler is not None:
                workers = f"the workers of {options.scheduler}"
            reporter.line(
                f"{len(cells)} cells, {len(cells) - len(to_do)} up to date, {len(to_do)} to do by "
                f"{workers}, into {folder}"
            )
            for text in broken:
                reporter.line(f"Done again: {text}")
            for name, count in plan.not_learned(entries, environments).items():
                reporter.line(
                    f"{name}: not applicable to {count} of {len(environments)} environments"
                )
            _run(options, folder, jobs, on_event, plan.make_jobs(cells, to_do))
        results = [read_result(folder / cell.path) for cell in cells]
    console.print(summary(results))
    if spent.methods:
        console.print(spent.table())
    failed = [result for result in results if not result.ok]
    for result in failed:
        reporter.line(f"FAILED {result.path}: {(result.reason or '').splitlines()[0]}")
    seconds = time.monotonic() - began
    reporter.line(
        f"{len(to_do)} cells in {seconds:.0f} s, {len(failed)} failed. "
        f"Now build the tables: python leaderboard/build.py --results {folder} --output <folder>"
    )
    if options.json is not None:
        said = {
            "preset": options.preset,
            "backend": options.backend,
            "workers": jobs if options.scheduler is None else None,
            "cells": len(cells),
            "up_to_date": len(cells) - len(to_do),
            "failed": len(failed),
            "wall_seconds": seconds,
            "methods": spent.methods,
        }
        options.json.write_text(json.dumps(said, indent=1) + "\n", encoding="utf-8")
    return 1 if failed else 0


def _run(
    options: RunOptions,
    folder: Path,
    jobs: int,
    on_event: Callable[[dict[str, Any]], object],
    to_do: Sequence[Job],
) -> None:
    """Do jobs where the options say."""
    if options.scheduler is None:
        from iflow_gym.baselines.runner.pool import Pool

        Pool(folder, jobs, on_event).run(to_do)
    elif to_do:
        from iflow_gym.baselines.runner.cluster import Cluster

        Cluster(folder, options.scheduler, on_event).run(to_do)


def default_output(preset: str) -> Path:
    """Return the folder of results of a preset where none is given."""
    import iflow_gym

    checkout = Path(iflow_gym.__file__).resolve().parents[1]
    is_checkout = (checkout / "pyproject.toml").is_file() and (checkout / "leaderboard").is_dir()
    root = checkout if is_checkout else Path.cwd()
    return root / ("results/smoke" if preset == "smoke" else "leaderboard/results")


def main() -> None:
    """Run from the command line."""
    import tyro

    sys.exit(run_and_tell(tyro.cli(RunOptions, description=__doc__)))


def run_and_tell(options: RunOptions) -> int:
    """Run what `options` say, tell what went wrong on standard error, return the exit status."""
    from rich.console import Console

    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # for --methods my_module:MyMethod
    signal.signal(signal.SIGTERM, _stop)  # so that workers do not outlive this process
    try:
        # A log has no width; the table at the end needs some.
        return run_all(options, Console(width=None if sys.stdout.isatty() else 140))
    except KeyboardInterrupt:
        print("Stopped. What is done is kept; the next run goes on from there.", file=sys.stderr)
        return 130
    except ValueError as error:
        print(f"run_all.py: {error}", file=sys.stderr)
        return 2
    except (RuntimeError, OSError) as error:
        text = _why_it_ended(error)
        if text is None:
            raise
        print(f"run_all.py: {text}", file=sys.stderr)
        return 3


def _why_it_ended(error: RuntimeError | OSError) -> str | None:
    """Say what kept a run from going on; None for an error that has to be looked into."""
    from iflow_gym.baselines.runner.cluster_errors import ClusterError
    from iflow_gym.baselines.runner.lock import FolderInUseError
    from iflow_gym.baselines.runner.pool import WorkersError
    from iflow_gym.baselines.runner.store import CannotWriteError, no_room

    if isinstance(error, CannotWriteError) or no_room(error):
        to_do = "make room and run again" if no_room(error) else "run again then"
        return (
            f"Results cannot be written ({error}): {to_do}. "
            "What is done is kept; the next run goes on from there."
        )
    if isinstance(error, FolderInUseError | ClusterError | WorkersError):
        return str(error)
    return None


def _stop(signal_number: int, frame: object) -> NoReturn:
    sys.exit(128 + signal_number)


if __name__ == "__main__":
    main()
