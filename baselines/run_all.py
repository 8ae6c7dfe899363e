"""Run methods on environments and write a record for each cell; the leaderboard is built of these.

A cell is (method, environment, protocol, seed). A second run redoes only the cells whose key has
changed: their settings, their code, the code that scores, the data, or a library's version. What
failed is tried again. Ctrl-C keeps what is done.

    python baselines/run_all.py --preset smoke
    python baselines/run_all.py --methods 'imitation-*' linear --envs 'LASA-Sharp*' --jobs 2

From any folder, with a method of one's own, also where iflow_gym is installed without its checkout:

    python -m iflow_gym.baselines.run_all --methods my_module:MyMethod --output results

Methods that fit several motions together do so in batches of the selected environments, and scores
depend a little on the batch: another selection of environments is another batch, hence a new run.

Exit status: 0 when every cell has scores, 1 when one failed, 2 for a name or a preset that is not
understood, 130 after Ctrl-C.
"""

from __future__ import annotations

import dataclasses
import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NoReturn

if TYPE_CHECKING:
    from rich.console import Console

# What is heavy is imported where it is used: workers import this file, too.


@dataclass(frozen=True)
class RunOptions:
    """What to run and where to write it."""

    preset: Literal["smoke", "standard", "full"] = "standard"
    """smoke: a minute, for CI. standard: the leaderboard's numbers, one seed. full: three seeds."""
    methods: tuple[str, ...] = ()
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


def run_all(options: RunOptions, console: Console) -> int:
    """Run what `options` say; return 1 if a cell failed, else 0.

    Raises
    ------
    ValueError
        If a method, an environment or a preset is unknown.
    KeyboardInterrupt
        On Ctrl-C.
    """
    from iflow_gym.baselines.runner import plan
    from iflow_gym.baselines.runner.pool import Pool
    from iflow_gym.baselines.runner.presets import load_preset
    from iflow_gym.baselines.runner.report import Reporter, summary
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
    folder = (options.output or default_output(options.preset)).resolve()
    entries = plan.select_entries(options.methods, options.preset)
    environments = plan.select_environments(options.envs or preset.environments)
    cells = plan.make_cells(entries, environments, preset)
    to_do = [c for c in cells if options.force or not plan.is_up_to_date(c, folder)]
    folder.mkdir(parents=True, exist_ok=True)

    began = time.monotonic()
    with Reporter(console, len(to_do)) as reporter:
        reporter.line(
            f"{len(cells)} cells, {len(cells) - len(to_do)} up to date, {len(to_do)} to do by "
            f"{min(jobs, max(len(to_do), 1))} workers, into {folder}"
        )
        for name, count in plan.not_learned(entries, environments).items():
            reporter.line(f"{name}: not applicable to {count} of {len(environments)} environments")
        Pool(folder, jobs, reporter.event).run(plan.make_jobs(cells, to_do))
    results = [read_result(folder / cell.path) for cell in cells]
    console.print(summary(results))
    failed = [result for result in results if not result.ok]
    for result in failed:
        reporter.line(f"FAILED {result.path}: {(result.reason or '').splitlines()[0]}")
    reporter.line(
        f"{len(to_do)} cells in {time.monotonic() - began:.0f} s, {len(failed)} failed. "
        f"Now build the tables: python leaderboard/build.py --results {folder} --output <folder>"
    )
    return 1 if failed else 0


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
    from rich.console import Console

    options = tyro.cli(RunOptions, description=__doc__)
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # for --methods my_module:MyMethod
    signal.signal(signal.SIGTERM, _stop)  # so that workers do not outlive this process
    try:
        # A log has no width; the table at the end needs some.
        status = run_all(options, Console(width=None if sys.stdout.isatty() else 140))
    except KeyboardInterrupt:
        print("Stopped. What is done is kept; the next run goes on from there.", file=sys.stderr)
        status = 130
    except ValueError as error:
        print(f"run_all.py: {error}", file=sys.stderr)
        status = 2
    sys.exit(status)


def _stop(signal_number: int, frame: object) -> NoReturn:
    sys.exit(128 + signal_number)


if __name__ == "__main__":
    main()
