"""Build the leaderboard: read the records of a folder of results, write tables and figures.

    python leaderboard/build.py
    python leaderboard/build.py --results results/smoke --output results/smoke-board

Exit status: 0 when it is written, 2 when there is nothing to build it of.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from board import Board, Row, make_boards
from classes import confusion
from matplotlib.figure import Figure
from page import HEADLINE, render
from tables import heading, shape_name

import iflow_gym  # noqa: F401 (registers the environments)
from iflow_gym.baselines.registry import METHODS, load_method
from iflow_gym.demonstrations import Demonstrations
from iflow_gym.figures import (
    USES_TIME,
    FieldPanel,
    MethodStyle,
    Point,
    box_figure,
    confusion_figure,
    field_sheet,
    method_styles,
    save_figure,
    scatter_figure,
)
from iflow_gym.results import Result, ResultFileError, read_results
from iflow_gym.system import GUARANTEE_KINDS, Method

HERE = Path(__file__).resolve().parent

FIGURES = "figures"
"""Folder of the figures, beside the page."""

BOXES = ("seds_error", "frechet", "swept_area", "dtw")
"""Metrics of the ImitationFlow paper's figure 3."""

SHEET_METHOD = "imitation-flow"
"""Method that every shape is shown of."""

COMPARED_SHAPE = "Sshape"
"""Shape that every method is shown on."""

REFERENCE = "nearest-demonstration"
"""Row that figures mark with a dashed line."""


class NothingToBuildError(ValueError):
    """There are no records to build a leaderboard of."""


def build(results_folder: Path, output: Path) -> list[Path]:
    """Write LEADERBOARD.md and its figures into a folder, and return their paths.

    Raises
    ------
    FileNotFoundError
        If there is no folder of results.
    NothingToBuildError
        If it holds no records.
    ResultFileError
        If a file in it is no whole record.
    """
    results = read_results(results_folder)
    if not results:
        raise NothingToBuildError(
            f"Expected records in {results_folder}, got none: run `python baselines/run_all.py "
            f"--output {results_folder}` first."
        )
    boards = make_boards(results)
    folder = output / FIGURES
    folder.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    paths: dict[str, str] = {}
    for name, (figure, suffix) in draw(boards, results_folder).items():
        written.append(save_figure(figure, folder / f"{name}{suffix}"))
        paths[name] = f"{FIGURES}/{name}{suffix}"
    page = output / "LEADERBOARD.md"
    page.write_text(
        render(boards, results, paths, units_of(boards)), encoding="utf-8", newline="\n"
    )
    return [page, *written]


def units_of(boards: Iterable[Board]) -> dict[str, str]:
    """Return each family's unit of length, as its environments' demonstrations have it."""
    units: dict[str, str] = {}
    for board in boards:
        demonstrations = demonstrations_of(board.environments[0])
        units[board.family] = "length" if demonstrations is None else demonstrations.length_unit
    return units


def demonstrations_of(environment: str) -> Demonstrations | None:
    """Return an environment's demonstrations; None for one that is not installed here."""
    try:
        env: Any = gymnasium.make(environment).unwrapped
    except (gymnasium.error.Error, FileNotFoundError):
        return None
    return getattr(env, "demonstrations", None)


# Figures ------------------------------------------------------------------------------------


def draw(boards: Iterable[Board], results_folder: Path) -> dict[str, tuple[Figure, str]]:
    """Return the figures by name, each with the suffix of its file."""
    by_key = {(board.family, board.protocol): board for board in boards}
    return _headline_figures(by_key, results_folder) | _cycle_figures(by_key, results_folder)


def _cycle_figures(
    by_key: Mapping[tuple[str, str], Board], results_folder: Path
) -> dict[str, tuple[Figure, str]]:
    """Return every motion by every method, and which motion is taken for which."""
    figures: dict[str, tuple[Figure, str]] = {}
    for (family, protocol), board in by_key.items():
        if board.motion != "cycle":
            continue
        if protocol == "generalisation":
            found = {row.title: confusion(row) for row in board.methods}
            counts = {title: matrix for title, matrix in found.items() if matrix is not None}
            if counts:
                labels = [shape_name(environment) for environment in board.environments]
                figures[f"{family}-classes"] = (confusion_figure(counts, labels), ".svg")
            continue
        panels = [
            panel
            for environment in board.environments
            for row in board.methods
            if (panel := panel_of(row, environment, row.title, results_folder)) is not None
        ]
        if any(panel.system is not None for panel in panels):
            sheet = field_sheet(panels, n_columns=len(board.methods), size=2.2)
            figures[f"{family}-fields"] = (sheet, ".png")
    return figures


def _headline_figures(
    by_key: Mapping[tuple[str, str], Board], results_folder: Path
) -> dict[str, tuple[Figure, str]]:
    """Return the figures of the headline family's reproduction board; none where it has not run."""
    board = by_key.get((HEADLINE, "reproduction"))
    if board is None or not any(row.n_scored for row in board.competitors):
        return {}
    styles = styles_of(board)
    unit = units_of([board])[board.family]
    figures = {
        "accuracy-stability": (accuracy_stability(board, styles, unit), ".svg"),
        "accuracy-fit-time": (accuracy_fit_time(board, styles, unit), ".svg"),
        "boxes": (boxes(board, styles, unit), ".svg"),
    }
    every_shape = [
        b for key in (HEADLINE, "LASA-Multi") if (b := by_key.get((key, "reproduction")))
    ]
    sheets = {
        "methods": (method_panels(board, results_folder), 3.0),
        "fields": (shape_panels(every_shape, results_folder), 1.9),
    }
    for name, (panels, size) in sheets.items():
        if any(panel.system is not None for panel in panels):
            columns = 6 if name == "fields" else 4
            figures[name] = (field_sheet(panels, n_columns=columns, size=size), ".png")
    return figures


def styles_of(board: Board) -> dict[str, MethodStyle]:
    """Return the methods' styles, in the board's order."""
    methods = {
        row.method: (row.title, USES_TIME if row.uses_time else weakest(row))
        for row in board.methods
        if row.n_scored
    }
    return method_styles(methods, order=tuple(METHODS))


def weakest(row: Row) -> str:
    """Return the weakest kind of guarantee that a row's cells state."""
    return row.guarantees[0] if row.guarantees else GUARANTEE_KINDS[0]


def reference_median(board: Board, metric: str) -> float | None:
    """Return the median over the shapes of the distance between the demonstrations."""
    for row in board.rows:
        if row.method == REFERENCE and row.applies(metric):
            return float(np.nanmedian(row.by_environment(metric)))
    return None


def accuracy_stability(board: Board, styles: Mapping[str, MethodStyle], unit: str) -> Figure:
    """Fréchet distance against the share of starts that converge."""
    points = []
    for row in _drawn(board, styles):
        x, y = row.aggregate("frechet"), row.aggregate("converged")
        if x is not None and y is not None:
            low, high = y.mean_interval
            points.append(
                Point(row.method, x.iqm, 100 * y.mean, x.iqm_interval, (100 * low, 100 * high))
            )
    between = reference_median(board, "frechet")
    return scatter_figure(
        points,
        styles,
        x_label=f"Fréchet distance ({unit}), interquartile mean",
        y_label="starts that converge (%), mean",
        x_log=True,
        y_limits=(-9.0, 116.0),  # room for names above and below the points
        references=None if between is None else {"between demonstrations": between},
    )


def accuracy_fit_time(board: Board, styles: Mapping[str, MethodStyle], unit: str) -> Figure:
    """Time to fit against Fréchet distance."""
    points = []
    for row in _drawn(board, styles):
        x, y = row.aggregate("fit_seconds"), row.aggregate("frechet")
        if x is not None and y is not None:
            points.append(Point(row.method, x.iqm, y.iqm, x.iqm_interval, y.iqm_interval))
    return scatter_figure(
        points,
        styles,
        x_label="time to fit a shape (s), interquartile mean",
        y_label=f"Fréchet distance ({unit}), interquartile mean",
        x_log=True,
        y_log=True,
    )


def boxes(board: Board, styles: Mapping[str, MethodStyle], unit: str) -> Figure:
    """Four metrics, a box over the shapes for each method."""
    references = {
        heading(metric, unit): value
        for metric in BOXES
        if (value := reference_median(board, metric)) is not None
    }
    panels = {
        heading(metric, unit): {
            row.method: np.array([v for v, ran in _tried(row, metric) if ran])
            for row in _drawn(board, styles)
            if row.applies(metric)  # what has no field has no box for it, and has not failed
        }
        for metric in BOXES
    }
    return box_figure(
        panels, styles, references, reference_label="between demonstrations (median over shapes)"
    )


def _drawn(board: Board, styles: Mapping[str, MethodStyle]) -> list[Row]:
    return [row for row in board.methods if row.method in styles]


def _tried(row: Row, metric: str) -> list[tuple[float, bool]]:
    """Return each environment's score and whether the method was run there at all."""
    ran = {environment for environment, _ in row.cells}
    scores = row.by_environment(metric)
    return [(float(v), e in ran) for v, e in zip(scores, row.environments, strict=True)]


def shape_panels(boards: Iterable[Board], results_folder: Path) -> list[FieldPanel]:
    """Return a panel for each shape of `SHEET_METHOD`; none where it was not run."""
    panels = []
    for board in boards:
        for row in board.rows:
            if row.method == SHEET_METHOD:
                panels += [
                    panel_of(row, e, shape_name(e), results_folder) for e in row.environments
                ]
    return [panel for panel in panels if panel is not None]


def method_panels(board: Board, results_folder: Path) -> list[FieldPanel]:
    """Return a panel for each method on `COMPARED_SHAPE`."""
    environments = [e for e in board.environments if shape_name(e) == COMPARED_SHAPE]
    panels = [
        panel_of(row, environment, row.title, results_folder)
        for environment in environments
        for row in board.methods
    ]
    return [panel for panel in panels if panel is not None]


def panel_of(row: Row, environment: str, title: str, results_folder: Path) -> FieldPanel | None:
    """Return the picture of a method's first seed on an environment; None where it has no data."""
    demonstrations = demonstrations_of(environment)
    if demonstrations is None or demonstrations.n_dims != 2:
        return None
    cell = row.cells.get((environment, row.seeds[0]))
    if cell is None:
        return FieldPanel(title, demonstrations, None, "never run")
    if not cell.ok:
        return FieldPanel(title, demonstrations, None, "failed")
    system, problem = load_model(cell, results_folder)
    return FieldPanel(title, demonstrations, system, problem)


def load_model(cell: Result, results_folder: Path) -> tuple[Method | None, str]:
    """Return the fitted model beside a record, or None, and in a few words why there is none.

    A method that is not in the registry is imported by the ``module:Class`` that the record names.
    """
    if cell.model is None:
        return None, "no model file"
    path = results_folder / cell.path.parent / cell.model
    if not path.is_file():
        return None, "no model file"
    target = cell.method if cell.method in METHODS else cell.target
    try:
        if target is None:
            return None, "unknown method"
        method = load_method(target)
    except Exception as error:  # whatever a module does on import
        _complain(path, error)
        return None, f"{target}\nis not importable"
    try:
        return method.load(path), ""
    except Exception as error:  # ModelFileError, and whatever a method's own code raises
        _complain(path, error)
        return None, "no usable model file"


def _complain(path: Path, error: Exception) -> None:
    print(f"build.py: no picture of {path.name}: {error}", file=sys.stderr)


def main() -> int:
    """Build from the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--results", type=Path, default=HERE / "results", help="folder of records")
    parser.add_argument("--output", type=Path, default=HERE, help="where the page is written")
    options = parser.parse_args()
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # for the models of methods that are not in the registry
    try:
        written = build(options.results, options.output)
    except (FileNotFoundError, NothingToBuildError, ResultFileError) as error:
        print(f"build.py: {error}", file=sys.stderr)
        return 2
    for path in written:
        print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
