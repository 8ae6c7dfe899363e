"""``iflow-gym leaderboard``: run its cells, check a submission, compare two runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg, subcommand

from iflow_gym.baselines.run_all import RunOptions
from iflow_gym.recordings.columns import shown


@dataclass(frozen=True)
class Check:
    """Check a submission: method.toml, records, models, and some cells scored again.

    Exit status: 0 when nothing is wrong, 1 when something is refused, 2 when something could not
    be checked.
    """

    path: Positional[Path]
    """Folder of a method, with its method.toml, or a folder of such folders."""
    cells: int = 3
    """Cells that are scored again; 0 looks at files alone."""
    seed: Annotated[int | None, shown("SEED")] = None
    """Seed by which they are chosen; by default one that nobody can foresee."""
    trust: bool = False
    """Import and run classes from outside the suite, which have your rights then."""

    def run(self) -> int:
        """Check."""
        from iflow_gym.leaderboard.__main__ import check

        return check(self.path, cells=self.cells, seed=self.seed, trust=self.trust)


@dataclass(frozen=True)
class Compare:
    """Print, as Markdown, what changed between two folders of results."""

    before: Annotated[Positional[Path], arg(metavar="BEFORE")]
    """Folder of results."""
    after: Annotated[Positional[Path], arg(metavar="AFTER")]
    """Folder of results."""

    def run(self) -> int:
        """Compare."""
        from iflow_gym.leaderboard.__main__ import compare

        return compare(self.before, self.after)


@dataclass(frozen=True)
class Run(RunOptions):
    """Fit methods to environments, score them, and write a record for each cell.

    What is up to date is not done again, and Ctrl-C keeps what is done. Exit status: 0 when every
    cell has scores, 1 when one failed, 2 for what was not understood, 3 where the run could not go
    on, 130 after Ctrl-C.
    """

    def run(self) -> int:
        """Run; `iflow_gym.baselines.run_all` says how each error is told."""
        from iflow_gym.baselines.run_all import run_and_tell

        return run_and_tell(self)


@dataclass(frozen=True)
class Leaderboard:
    """Run the leaderboard's cells, check a submission, compare two runs.

    `python leaderboard/build.py` of the checkout draws the board of what is run.

        iflow-gym leaderboard run --method my_module:MyMethod --envs 'LASA-S*' --output results
        iflow-gym leaderboard check results/my-method
        iflow-gym leaderboard compare before after
    """

    command: (
        Annotated[Run, subcommand("run")]
        | Annotated[Check, subcommand("check")]
        | Annotated[Compare, subcommand("compare")]
    )

    def run(self) -> int:
        """Do it."""
        return self.command.run()
