"""Check a submission to the leaderboard; compare two folders of results.

    python -m iflow_gym.leaderboard check leaderboard/results/gmr
    python -m iflow_gym.leaderboard check my_results/my-method --cells 10 --seed 0 --trust

    python -m iflow_gym.leaderboard compare before/results after/results

PATH is the folder of a method, or a folder of such folders. Its method.toml, records and models are
read, nothing in them is run; then some cells, chosen at random, are scored again from their models.
That imports the method's class: one from outside the suite is its author's code, which runs with
your rights, and --trust says that you let it. Its module has to be importable from where you are.

Exit status: 0 when nothing is wrong, 1 when something is refused, 2 when something could not be
checked: there is no such folder, or a class is not trusted.
"""

from __future__ import annotations

import os
import sys
from collections import Counter
from pathlib import Path
from typing import get_args

from tyro.conf import Positional


def check(
    path: Positional[Path],
    /,
    cells: int = 3,
    seed: int | None = None,
    trust: bool = False,
) -> int:
    """Check a submission.

    Parameters
    ----------
    path
        Folder of a method, with its method.toml, or a folder of such folders.
    cells
        Cells that are scored again; 0 looks at files alone.
    seed
        Seed by which they are chosen; by default one that nobody can foresee.
    trust
        Import and run classes from outside the suite.
    """
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from iflow_gym.leaderboard.check import Verdict
    from iflow_gym.leaderboard.check import check as check_folder

    console = Console(width=None if sys.stdout.isatty() else 140)
    status = 0
    try:
        for folder in _folders(path):
            report = check_folder(folder, n_cells=cells, seed=seed, trust=trust)
            table = Table(title=f"{folder}, cells chosen by seed {report.seed}")
            table.add_column("Checked")
            table.add_column("Verdict", no_wrap=True)
            table.add_column("Found", overflow="fold")
            for finding in report.findings:
                table.add_row(escape(finding.what), finding.verdict, escape(_plain(finding.text)))
            console.print(table)
            counts = Counter(finding.verdict for finding in report.findings)
            said = ", ".join(f"{counts[v]} {v}" for v in get_args(Verdict) if counts[v])
            console.print(f"{folder}: {said}.", highlight=False, markup=False)
            status = 1 if 1 in (status, report.status) else max(status, report.status)
    except (OSError, ValueError) as error:
        print(f"iflow_gym.leaderboard: {error}", file=sys.stderr)
        return 2
    return status


def compare(before: Positional[Path], after: Positional[Path], /) -> int:
    """Print, as Markdown, what changed between two folders of results.

    Parameters
    ----------
    before
        Folder of results.
    after
        Folder of results.
    """
    from iflow_gym.leaderboard.compare import changes

    try:
        print(changes(before, after))
    except (OSError, ValueError) as error:
        print(f"iflow_gym.leaderboard: {error}", file=sys.stderr)
        return 2
    return 0


def _folders(path: Path) -> list[Path]:
    """Return the folder itself, or those in it where it is none of a method."""
    if not path.is_dir():
        raise FileNotFoundError(f"Expected the folder of a submission at {path}, got none.")
    if any(path.glob("*.json")) or (path / "method.toml").exists():
        return [path]
    return sorted(child for child in path.iterdir() if child.is_dir()) or [path]


def _plain(text: str) -> str:
    """Return text that cannot steer a terminal: a submission's own words may be in it."""
    return "".join(c if c.isprintable() or c == "\n" else "?" for c in text)


def main() -> None:
    """Run from the command line."""
    import tyro

    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # for the classes of submissions
    app = tyro.extras.SubcommandApp()
    app.command(check)
    app.command(compare)
    sys.exit(app.cli(description=__doc__, use_underscores=False))


if __name__ == "__main__":
    main()
