"""Build the leaderboard: read the records of a folder of results, write tables, figures, a page.

    python leaderboard/build.py
    python leaderboard/build.py --results results/smoke --output results/smoke-board
    python leaderboard/build.py --check

Written are LEADERBOARD.md with its figures, for a forge, and index.html, which holds everything in
one file, for a browser. With `--check` nothing is written: what the records say is compared with
the words and numbers of both files, pictures aside.

Exit status: 0 when it is written, or as it should be; 1 when a check found a difference; 2 when
there is nothing to build it of.
"""

from __future__ import annotations

import argparse
import difflib
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import web
from board import Board, make_boards
from drawings import Drawing, drawings_of, units_of
from matplotlib.figure import Figure
from page import render

from iflow_gym.figures import save_figure
from iflow_gym.leaderboard.submission import (
    SUBMISSION_FILE,
    Submission,
    SubmissionError,
    read_submission,
)
from iflow_gym.results import Result, ResultFileError, read_results

HERE = Path(__file__).resolve().parent

FIGURES = "figures"
"""Folder of the figures, beside the page."""

SHOWN_DIFFERENCES = 30
"""Lines of a difference that a check prints."""


class NothingToBuildError(ValueError):
    """There are no records to build a leaderboard of."""


@dataclass(frozen=True)
class Plan:
    """All that the files are made of, before anything is drawn."""

    results: Sequence[Result]
    boards: Sequence[Board]
    units: Mapping[str, str]
    drawings: Mapping[str, Drawing]
    submissions: Mapping[str, Submission]
    """By method's name, of those whose folder says what the method is."""

    @property
    def paths(self) -> dict[str, str]:
        """Where figures lie, relative to LEADERBOARD.md."""
        return {name: f"{FIGURES}/{name}{d.suffix}" for name, d in self.drawings.items()}

    def markdown(self) -> str:
        """Return LEADERBOARD.md."""
        return render(self.boards, self.results, self.paths, self.units, self.submissions)

    def html(self, output: Path, figures: Mapping[str, Figure]) -> str:
        """Return index.html for a folder; without figures, the page without pictures."""
        return web.render(
            self.boards,
            self.results,
            self.units,
            output,
            drawings=self.drawings,
            figures=figures,
            submissions=self.submissions,
        )


def plan(results_folder: Path) -> Plan:
    """Read the records and say what is to be written.

    Raises
    ------
    FileNotFoundError
        If there is no folder of results.
    NothingToBuildError
        If it holds no records.
    ResultFileError
        If a file in it is no whole record.
    SubmissionError
        If a method's `method.toml` is not what it should be.
    """
    results = read_results(results_folder)
    if not results:
        raise NothingToBuildError(
            f"Expected records in {results_folder}, got none: run `python baselines/run_all.py "
            f"--output {results_folder}` first."
        )
    boards = make_boards(results)
    submissions = {
        name: read_submission(results_folder / name)
        for name in sorted({result.method for result in results})
        if (results_folder / name / SUBMISSION_FILE).is_file()
    }
    drawings = drawings_of(boards, results_folder)
    return Plan(results, boards, units_of(boards), drawings, submissions)


def build(results_folder: Path, output: Path) -> list[Path]:
    """Write LEADERBOARD.md, its figures and index.html into a folder, and return their paths.

    Raises as `plan` does.
    """
    planned = plan(results_folder)
    folder = output / FIGURES
    folder.mkdir(parents=True, exist_ok=True)
    figures = {name: drawing.make() for name, drawing in planned.drawings.items()}
    written = [
        save_figure(figure, folder / f"{name}{planned.drawings[name].suffix}")
        for name, figure in figures.items()
    ]
    pages = {
        output / "LEADERBOARD.md": planned.markdown(),
        output / web.NAME: planned.html(output, figures),
    }
    for path, text in pages.items():
        path.write_text(text, encoding="utf-8", newline="\n")
    return [*pages, *written]


def check(results_folder: Path, output: Path) -> list[str]:
    """Return the lines by which what is written differs from what the records say, as a diff.

    Raises as `plan` does.
    """
    planned = plan(results_folder)
    found: list[str] = []
    for name, made in (
        ("LEADERBOARD.md", planned.markdown()),
        (web.NAME, planned.html(output, {})),
    ):
        path = output / name
        there = path.read_text(encoding="utf-8") if path.is_file() else ""
        if name == web.NAME:
            there, made = web.without_pictures(there), web.without_pictures(made)
        lines = (there.splitlines(), made.splitlines())
        found += difflib.unified_diff(*lines, f"{name} as it is", f"{name} of the records", n=0)
    return [line.rstrip("\n") for line in found]


def main() -> int:
    """Build from the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--results", type=Path, default=HERE / "results", help="folder of records")
    parser.add_argument("--output", type=Path, default=HERE, help="where the pages are written")
    parser.add_argument(
        "--check", action="store_true", help="write nothing; compare what is written"
    )
    options = parser.parse_args()
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # for the models of methods that are not in the registry
    try:
        if options.check:
            return _report(check(options.results, options.output))
        written = build(options.results, options.output)
    except (FileNotFoundError, NothingToBuildError, ResultFileError, SubmissionError) as error:
        print(f"build.py: {error}", file=sys.stderr)
        return 2
    for path in written:
        print(path)
    return 0


def _report(difference: Sequence[str]) -> int:
    if not difference:
        return 0
    for line in difference[:SHOWN_DIFFERENCES]:
        print(line if len(line) <= 300 else f"{line[:300]} ...", file=sys.stderr)
    if (more := len(difference) - SHOWN_DIFFERENCES) > 0:
        print(f"... and {more} more lines", file=sys.stderr)
    print(
        "build.py: what is written is not what the records say: run `python leaderboard/build.py` "
        "and commit the result.",
        file=sys.stderr,
    )
    return 1


if __name__ == "__main__":
    sys.exit(main())
