"""Markdown tables of a board: a row for each method, or for each shape."""

from __future__ import annotations

import math
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from board import Board, Row

from iflow_gym.baselines.registry import METHODS, load_method
from iflow_gym.metrics import Aggregate, get_metric, metrics_of
from iflow_gym.metrics.aggregate import Interval
from iflow_gym.results import short_name

PERCENT = frozenset(
    {
        "converged",
        "diverged",
        "perturbation_recovery",
        "lyapunov_violation",
        "attraction",
        "period_error",
    }
)
"""Fractions that are shown in percent."""


BY_MEAN = (PERCENT - {"period_error"}) | {"spurious_attractors"}
"""Metrics of which a table shows the mean: an interquartile mean would hide the shapes that fail
just where that is what is asked."""


ROUNDING = 1e-9
"""Numbers below this are what is left of a difference of equal numbers."""


Aggregates = dict[tuple[str, str], "Aggregate | None"]
"""By method and metric."""


# Numbers ------------------------------------------------------------------------------------


SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float | None) -> str:
    """Return three significant digits, "∞" for a runaway, "≈ 0" for rounding, "–" for nothing."""
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    if value == 0:
        return "0"
    if abs(value) < ROUNDING:
        return "≈ 0"
    if 1e-4 <= abs(value) < 1e-3:
        return f"{value:.2g}"
    if abs(value) < 1e-4 or abs(value) >= 1e6:
        digits, _, power = f"{value:.1e}".partition("e")
        return f"{digits}·10{str(int(power)).translate(SUPERSCRIPTS)}"
    if value == int(value):
        return f"{value:.0f}"
    decimals = max(0, 2 - math.floor(math.log10(abs(value))))
    return f"{value:.{decimals}f}"


def percent(value: float | None) -> str:
    """Return a fraction in percent; 100 and 0 are exact, never rounded to."""
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞"
    if value in (0.0, 1.0):
        return f"{100 * value:.0f}"
    if value > 1:
        return f"{100 * value:.0f}"
    return f"{min(max(100 * value, 0.01), 99.99):.2f}"


def shown(metric: str, value: float | None) -> str:
    """Return a value as its metric is shown: in percent, or below a millisecond with that unit."""
    if value is not None and get_metric(metric).unit == "s" and ROUNDING <= value < 1e-3:
        return f"{number(1e3 * value)} ms" if value >= 1e-4 else f"{number(1e6 * value)} µs"
    return percent(value) if metric in PERCENT else number(value)


def with_unit(metric: str, value: float) -> str:
    """Return a value as it is shown, with its metric's unit unless that is said already."""
    text = shown(metric, value)
    return text if text.endswith("s") else f"{text} {get_metric(metric).unit}"


def heading(metric: str, length_unit: str) -> str:
    """Return a metric's title with its unit, for a column."""
    found = get_metric(metric)
    if metric in PERCENT:
        return f"{found.title} (%)"
    unit = found.unit.replace("length", length_unit)
    short = {"demonstration durations": "durations", "-": ""}.get(unit, unit)
    return f"{found.title} ({short})" if short else found.title


TEXT_COLUMNS = frozenset(
    {"Method", "Shape", "Guarantee", "Cell", "Reason", "Metric", "Unit", "Better", "Definition"}
)
"""Headings of columns that are aligned to the left."""


def table(header: Sequence[str], lines: Iterable[Sequence[str]]) -> list[str]:
    """Return a Markdown table; numbers are aligned to the right."""
    rule = ["---" if name in TEXT_COLUMNS else "---:" for name in header]
    return [f"| {' | '.join(cells)} |" for cells in (header, rule, *lines)] + [""]


def escaped(text: str) -> str:
    """Return text in one line, without what Markdown takes for a table, a tag, a link, emphasis."""
    text = " ".join(text.split()).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return re.sub(r"[\\|*_`\[\]]", r"\\\g<0>", text)


# Tables of a board --------------------------------------------------------------------------


def aggregates(board: Board) -> Aggregates:
    """Return every row's aggregate of every metric; the bootstrap runs once for each."""
    return {
        (row.method, metric.name): row.aggregate(metric.name)
        for row in board.rows
        for metric in metrics_of(board.motion)
    }


def aggregate_table(
    board: Board,
    found: Aggregates,
    metrics: Sequence[str],
    length_unit: str,
    *,
    statistic: str | None = None,
    extra: Mapping[str, Callable[[Row], str]] | None = None,
    references: bool = True,
) -> list[str]:
    """Return a table of aggregates, a row for each method.

    Parameters
    ----------
    board, found
        The board and its `aggregates`.
    metrics
        Columns.
    length_unit
        What "length" is in.
    statistic
        "mean" or "iqm" for all columns; None takes the mean for `BY_MEAN` and else the iqm.
    extra
        Columns before the metrics: heading to a function of a row.
    references
        Whether rows that do not compete are in it.
    """
    columns = []
    for metric in metrics:
        chosen = statistic or statistic_of(metric)
        entries = entries_of(board, found, metric, chosen)
        columns.append({name: _marked(entry) for name, entry in entries.items()})
    before = extra or {}
    header = ["Method", *before, *(heading(metric, length_unit) for metric in metrics)]
    lines = [
        emphasised(
            row,
            [
                named(row),
                *(function(row) for function in before.values()),
                *(column[row.method] for column in columns),
            ],
        )
        for row in board.rows
        if references or not row.reference
    ]
    return table(header, lines)


@dataclass(frozen=True)
class Entry:
    """One number of a table."""

    value: float
    """nan where there is none."""
    text: str
    interval: str
    """Its ends, as "1 to 2"; nothing where there are none, or they are the number itself."""
    best: bool
    """Whether it is the best of those that compete, as it is shown."""


def statistic_of(metric: str) -> str:
    """Return which statistic a metric is shown by, "mean" or "iqm"."""
    return "mean" if metric in BY_MEAN else "iqm"


def entries_of(board: Board, found: Aggregates, metric: str, statistic: str) -> dict[str, Entry]:
    """Return a column by method; what is shown alike with the best is best, too."""
    values = {
        row.method: float(getattr(aggregate, statistic))
        for row in board.rows
        if (aggregate := found[row.method, metric]) is not None
    }
    # Where all have run away, none is the best.
    best = {shown(metric, values[name]) for name in board.best(values, metric)} - {"∞"}
    eligible = eligible_methods(board)
    entries = {}
    for row in board.rows:
        aggregate = found[row.method, metric]
        if aggregate is None:
            entries[row.method] = Entry(math.nan, "–", "", False)
            continue
        text = shown(metric, values[row.method])
        ends = interval(metric, getattr(aggregate, f"{statistic}_interval"), text)
        is_best = row.method in eligible and text in best
        entries[row.method] = Entry(values[row.method], text, ends, is_best)
    return entries


def _marked(entry: Entry) -> str:
    """Return a number in Markdown, its interval below it."""
    text = f"**{entry.text}**" if entry.best else entry.text
    return f"{text}<br><sub>{entry.interval}</sub>" if entry.interval else text


def reward_of(row: Row) -> str:
    """Return a row's mean reward a step, with its interval below; "–" where none was measured."""
    found = row.reward()
    if found is None:
        return "–"
    text = f"{found.mean:.3f}"
    low, high = (f"{end:.3f}" for end in found.mean_interval)
    return text if "nan" in (low, high) else f"{text}<br><sub>{low} to {high}</sub>"


def outside(board: Board) -> list[tuple[str, str]]:
    """Return which registered methods cannot learn a board's motions, and why: titles, reason."""
    if board.motion == "goal":
        asked = [(load_method(name), "learns_goals") for name in METHODS]
    else:
        asked = [(load_method(name), "learns_cycles") for name in METHODS]
    here = {row.method for row in board.rows}
    titles: dict[str, list[str]] = defaultdict(list)
    for method, attribute in asked:
        if method.name not in here and not getattr(method, attribute):
            titles[method.not_learned].append(method.title)
    return [(", ".join(names), why) for why, names in titles.items()]


def named(row: Row) -> str:
    """Return a row's name as tables show it, with the mark of what follows a clock."""
    mark = "<br><sub>uses time</sub>" if row.uses_time and not row.reference else ""
    return escaped(row.title) + mark


def eligible_methods(board: Board) -> set[str]:
    """Return the competitors that may have the best value: those that cover the most cells."""
    return {row.method for row in board.fullest}


def interval(metric: str, ends: Interval, value: str) -> str:
    """Return an interval's ends; nothing where it is none, or the number itself."""
    low, high = (shown(metric, end) for end in ends)
    return "" if "–" in (low, high) or low == high == value else f"{low} to {high}"


def emphasised(row: Row, cells: Sequence[str]) -> list[str]:
    """Return a row's cells: in italics for a reference."""
    if not row.reference:
        return list(cells)
    return [_italic(cell) for cell in cells]


def _italic(cell: str) -> str:
    value, rule, rest = cell.partition("<br>")
    return cell if value in ("", "–") else f"*{value}*{rule}{rest}"


def rank_of(board: Board, row: Row) -> str:
    """Return a row's mean rank, bold if it is the best; nothing for what does not compete."""
    if not row.competes:
        return ""
    if row.method not in board.mean_rank:
        return "–"
    text = f"{board.mean_rank[row.method]:.2f}"
    return f"**{text}**" if row.method in board.first else text


def guarantee_of(row: Row) -> str:
    """Return the weakest kind of guarantee of the cells, and how many state a stronger one."""
    if not row.guarantees:
        return "–"
    if len(row.guarantees) == 1:
        return row.guarantees[0]
    counts = Counter(cell.guarantee.kind for cell in row.cells.values() if cell.guarantee)
    return ", ".join(f"{kind} ({counts[kind]})" for kind in row.guarantees)


def shape_table(board: Board, metric: str) -> list[str]:
    """Return a table of one metric, a row for each environment, a column for each method."""
    rows = [row for row in board.rows if row.applies(metric) or not row.reference]
    values = {row.method: row.by_environment(metric) for row in rows}
    lines = []
    for i, environment in enumerate(board.environments):
        here = {row.method: float(values[row.method][i]) for row in rows if row.competes}
        finite = [value for value in here.values() if not math.isnan(value)]
        better = get_metric(metric).better
        best = (min if better == "lower" else max)(finite) if finite else math.nan
        cells = []
        for row in rows:
            text = shown(metric, float(values[row.method][i]))
            if text == "–" and any((environment, seed) in row.cells for seed in row.seeds):
                ran = [
                    row.cells[environment, s] for s in row.seeds if (environment, s) in row.cells
                ]
                text = "failed" if not all(cell.ok for cell in ran) else "–"
            if row.reference:
                text = _italic(text)
            elif row.competes and text not in ("–", "failed") and text == shown(metric, best):
                text = f"**{text}**"
            cells.append(text)
        lines.append([shape_name(environment), *cells])
    titles = [f"*{escaped(row.title)}*" if row.reference else named(row) for row in rows]
    return table(["Shape", *titles], lines)


def shape_name(environment: str) -> str:
    """Return the name of the motion in an id."""
    name = short_name(environment).rpartition("-v")[0]
    suite, _, motion = name.partition("-")
    return motion if suite in ("LASA", "Letter", "LetterRecorded") else name
