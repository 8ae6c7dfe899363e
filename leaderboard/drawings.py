"""The leaderboard's figures: of numbers, a set for each board, and sheets of learned fields."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from board import HOLDS, MAIN, Board, Row
from classes import confusion
from comparisons import is_logarithmic, profiles, rank_comparison, ranked
from matplotlib.figure import Figure
from page import HEADLINE
from tables import PERCENT, heading, shape_name

import iflow_gym  # noqa: F401 (registers the environments)
from iflow_gym.baselines.registry import METHODS, load_method
from iflow_gym.comparison_figures import profile_figure, rank_figure
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
    scatter_figure,
)
from iflow_gym.metrics import Motion, get_metric
from iflow_gym.results import Result
from iflow_gym.system import GUARANTEE_KINDS, Method

BOXES: dict[Motion, tuple[str, ...]] = {
    "goal": ("seds_error", "frechet", "swept_area", "dtw"),
    "cycle": ("orbit_hausdorff", "orbit_distance", "period_error", "phase_rmse"),
    "drumming": ("orbit_hausdorff", "orbit_distance", "period_error", "phase_rmse"),
}
"""Metrics of the figures of boxes; of motions that end those of the ImitationFlow paper's
figure 3."""

FEWEST_FOR_BOXES = 4
"""Environments that a box takes at least."""

SHEET_METHOD = "imitation-flow"
"""Method that every shape is shown of."""

COMPARED_SHAPE = "Sshape"
"""Shape that every method is shown on."""

REFERENCE = "nearest-demonstration"
"""Row that figures mark with a dashed line."""


@dataclass(frozen=True)
class Spec:
    """What a panel of a sheet shows: a method's first seed on an environment."""

    row: Row
    environment: str
    title: str


@dataclass(frozen=True)
class Drawing:
    """A figure that is drawn when asked for."""

    suffix: str
    """Of its file."""
    make: Callable[[], Figure]
    specs: tuple[Spec, ...] = ()
    """Of a sheet's panels."""


def drawings_of(boards: Iterable[Board], results_folder: Path) -> dict[str, Drawing]:
    """Return the figures beside LEADERBOARD.md by the names of their files."""
    by_key = {(board.family, board.protocol): board for board in boards}
    found: dict[str, Drawing] = {}
    headline = by_key.get((HEADLINE, "reproduction"))
    if headline is not None:
        for name, make in number_figures(headline).items():
            found[name] = Drawing(".svg", make)
    return found | sheets(by_key, results_folder) | confusions(by_key)


def confusions(by_key: Mapping[tuple[str, str], Board]) -> dict[str, Drawing]:
    """Return which motion is taken for which, where models have densities."""
    found = {}
    for (family, protocol), board in by_key.items():
        counts = {row.title: c for row in board.methods if (c := confusion(row)) is not None}
        if protocol == "generalisation" and board.motion == "cycle" and counts:
            labels = [shape_name(environment) for environment in board.environments]
            make = functools.partial(confusion_figure, counts, labels)
            found[f"{family}-classes"] = Drawing(".svg", make)
    return found


# Fields -------------------------------------------------------------------------------------


def sheets(by_key: Mapping[tuple[str, str], Board], results_folder: Path) -> dict[str, Drawing]:
    """Return the sheets of fields that have a fitted model on any of their panels."""
    found = {}
    headline = by_key.get((HEADLINE, "reproduction"))
    every_shape = [
        b for f in (HEADLINE, "LASA-Multi") if (b := by_key.get((f, "reproduction"))) is not None
    ]
    wanted: dict[str, tuple[list[Spec], int, float]] = {}
    if headline is not None:
        wanted["methods"] = (method_specs(headline), 4, 3.0)
        wanted["fields"] = (shape_specs(every_shape), 6, 1.9)
    for (family, protocol), board in by_key.items():
        if board.motion == "cycle" and protocol == "reproduction":
            specs = [
                Spec(row, environment, row.title)
                for environment in board.environments
                for row in board.methods
            ]
            wanted[f"{family}-fields"] = (specs, len(board.methods), 2.2)
    for name, (specs, n_columns, size) in wanted.items():
        planar = tuple(spec for spec in specs if is_planar(spec.environment))
        if any(model_path(first_cell(spec), results_folder) for spec in planar):
            make = functools.partial(draw_sheet, planar, results_folder, n_columns, size)
            found[name] = Drawing(".png", make, planar)
    return found


def draw_sheet(specs: Sequence[Spec], results_folder: Path, n_columns: int, size: float) -> Figure:
    """Return a sheet, its axes in the order of the specs."""
    panels = [panel_of(spec, results_folder) for spec in specs]
    return field_sheet(panels, n_columns=n_columns, size=size)


def shape_specs(boards: Iterable[Board]) -> list[Spec]:
    """Return a panel for each shape of `SHEET_METHOD`; none where it was not run."""
    return [
        Spec(row, environment, shape_name(environment))
        for board in boards
        for row in board.rows
        if row.method == SHEET_METHOD
        for environment in row.environments
    ]


def method_specs(board: Board) -> list[Spec]:
    """Return a panel for each method on `COMPARED_SHAPE`."""
    return [
        Spec(row, environment, row.title)
        for environment in board.environments
        if shape_name(environment) == COMPARED_SHAPE
        for row in board.methods
    ]


@functools.cache
def demonstrations_of(environment: str) -> Demonstrations | None:
    """Return an environment's demonstrations; None for one that is not installed here."""
    try:
        env: Any = gymnasium.make(environment).unwrapped
    except (gymnasium.error.Error, FileNotFoundError):
        return None
    found: Demonstrations | None = getattr(env, "demonstrations", None)
    env.close()
    return found


def is_planar(environment: str) -> bool:
    """Whether an environment is installed here and its motion can be drawn."""
    demonstrations = demonstrations_of(environment)
    return demonstrations is not None and demonstrations.n_dims == 2


def units_of(boards: Iterable[Board]) -> dict[str, str]:
    """Return each family's unit of length, as its environments' demonstrations have it."""
    units: dict[str, str] = {}
    for board in boards:
        demonstrations = demonstrations_of(board.environments[0])
        units[board.family] = "length" if demonstrations is None else demonstrations.length_unit
    return units


def first_cell(spec: Spec) -> Result | None:
    """Return the record of a method's first seed on a panel's environment."""
    return spec.row.cells.get((spec.environment, spec.row.seeds[0]))


def model_path(cell: Result | None, results_folder: Path) -> Path | None:
    """Return where a cell's fitted model lies; None where there is none."""
    if cell is None or cell.model is None:
        return None
    path = results_folder / cell.path.parent / cell.model
    return path if path.is_file() else None


def panel_of(spec: Spec, results_folder: Path) -> FieldPanel:
    """Return the picture of a method's first seed on a planar environment."""
    demonstrations = demonstrations_of(spec.environment)
    assert demonstrations is not None
    cell = first_cell(spec)
    if cell is None:
        return FieldPanel(spec.title, demonstrations, None, "never run")
    if not cell.ok:
        return FieldPanel(spec.title, demonstrations, None, "failed")
    system, problem = load_model(cell, results_folder)
    return FieldPanel(spec.title, demonstrations, system, problem)


def load_model(cell: Result, results_folder: Path) -> tuple[Method | None, str]:
    """Return the fitted model beside a record, or None, and in a few words why there is none.

    A method that is not in the registry is imported by the ``module:Class`` that the record names.
    """
    path = model_path(cell, results_folder)
    if path is None:
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


# Numbers ------------------------------------------------------------------------------------


def number_figures(board: Board) -> dict[str, Callable[[], Figure]]:
    """Return a board's figures of numbers; none where no competitor has scores."""
    if not any(row.n_scored for row in board.competitors):
        return {}
    styles = styles_of(board)
    unit = units_of([board])[board.family]
    found: dict[str, Callable[[], Figure]] = {
        "accuracy-stability": lambda: accuracy_stability(board, styles, unit),
        "accuracy-fit-time": lambda: accuracy_fit_time(board, styles, unit),
    }
    if n_run(board) >= FEWEST_FOR_BOXES:
        found["boxes"] = lambda: boxes(board, styles, unit)
        found["profile"] = lambda: profile(board, styles, unit)
    if rank_comparison(board) is not None:
        found["ranks"] = lambda: ranks(board)
    return found


def n_run(board: Board) -> int:
    """Return the number of environments that a method was run on."""
    return len({environment for row in board.methods for environment, _ in row.cells})


def styles_of(board: Board) -> dict[str, MethodStyle]:
    """Return the methods' styles, in the board's order."""
    return _styles([row for row in board.methods if row.n_scored])


def _styles(rows: Sequence[Row]) -> dict[str, MethodStyle]:
    methods = {
        row.method: (row.title, USES_TIME if row.uses_time else weakest(row)) for row in rows
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
    """Draw the main accuracy against the share of starts that end where they should."""
    metric, holds = MAIN[board.motion], HOLDS[board.motion]
    points = []
    for row in _drawn(board, styles):
        x, y = row.aggregate(metric), row.aggregate(holds)
        if x is not None and y is not None:
            low, high = y.mean_interval
            points.append(
                Point(row.method, x.iqm, 100 * y.mean, x.iqm_interval, (100 * low, 100 * high))
            )
    between = reference_median(board, metric)
    converge = "converge" if holds == "converged" else "are attracted"
    return scatter_figure(
        points,
        styles,
        x_label=f"{_axis(metric, unit)}, interquartile mean",
        y_label=f"starts that {converge} (%), mean",
        x_log=_is_error(metric),
        y_limits=(-9.0, 116.0),  # room for names above and below the points
        references=None if between is None else {"between demonstrations": between},
    )


def accuracy_fit_time(board: Board, styles: Mapping[str, MethodStyle], unit: str) -> Figure:
    """CPU time of a fit against the main accuracy: the clock of a busy machine says little."""
    metric = MAIN[board.motion]
    points = []
    for row in _drawn(board, styles):
        x, y = row.aggregate("fit_cpu_seconds"), row.aggregate(metric)
        if x is not None and y is not None:
            points.append(Point(row.method, x.iqm, y.iqm, x.iqm_interval, y.iqm_interval))
    return scatter_figure(
        points,
        styles,
        x_label="CPU time to fit a motion (s), interquartile mean",
        y_label=f"{_axis(metric, unit)}, interquartile mean",
        x_log=True,
        y_log=_is_error(metric),
    )


def _is_error(metric: str) -> bool:
    return get_metric(metric).better == "lower"


def _axis(metric: str, unit: str) -> str:
    """Return a metric's label on an axis, which says the direction where it is not an error's."""
    label = heading(metric, unit)
    return label if _is_error(metric) else f"{label}, higher is better"


def boxes(board: Board, styles: Mapping[str, MethodStyle], unit: str) -> Figure:
    """Four metrics, a box over the shapes for each method."""
    metrics = BOXES[board.motion]
    references = {
        heading(metric, unit): _scale(metric) * value
        for metric in metrics
        if (value := reference_median(board, metric)) is not None
    }
    panels = {
        heading(metric, unit): {
            row.method: _scale(metric) * np.array([v for v, ran in _tried(row, metric) if ran])
            for row in _drawn(board, styles)
            if row.applies(metric)  # what has no field has no box for it, and has not failed
        }
        for metric in metrics
    }
    return box_figure(
        panels, styles, references, reference_label="between demonstrations (median over shapes)"
    )


def _scale(metric: str) -> float:
    """Return what a metric is multiplied by to be shown: fractions are in percent."""
    return 100.0 if metric in PERCENT else 1.0


def profile(board: Board, styles: Mapping[str, MethodStyle], unit: str) -> Figure:
    """Share of the cells that reach a threshold of the main accuracy."""
    found = profiles(board)
    label = _axis(MAIN[board.motion], unit)
    return profile_figure(found, styles, x_label=label, x_log=is_logarithmic(found))


def ranks(board: Board) -> Figure:
    """Mean ranks by the main accuracy, with the critical difference."""
    comparison = rank_comparison(board)
    assert comparison is not None
    rows, _ = ranked(board)
    styles = _styles(rows)
    return rank_figure(comparison, [styles[row.method] for row in rows])


def _drawn(board: Board, styles: Mapping[str, MethodStyle]) -> list[Row]:
    return [row for row in board.methods if row.method in styles]


def _tried(row: Row, metric: str) -> list[tuple[float, bool]]:
    """Return each environment's score and whether the method was run there at all."""
    ran = {environment for environment, _ in row.cells}
    scores = row.by_environment(metric)
    return [(float(v), e in ran) for v, e in zip(scores, row.environments, strict=True)]
