"""index.html: the leaderboard in one file, to sort, filter and look into.

The tables are in the HTML and can be read without a script. What a row tells when it is opened lies
in the page as JSON, and a script of the page writes it. Nothing is fetched from anywhere.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from board import HOLDS, MAIN, RANKED, Board, Row
from classes import confusion, fraction_right
from comparisons import FEWEST_ENVIRONMENTS, compared, improvements, rank_comparison, ranked
from drawings import FEWEST_FOR_BOXES, Drawing, first_cell, n_run, number_figures
from inline import Styles, inline_svg, moving_webp, panel_pictures, webp
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure
from page import (
    CAPTIONS,
    HEADLINE,
    KINDS,
    MEMORY,
    NOTES,
    PROTOCOLS,
    WHAT,
    contradictions,
    footnote,
    improvement_in_words,
    ranks_in_words,
    warnings_about,
)
from records import details, guarantees_of, versions_of
from tables import (
    Aggregates,
    Entry,
    aggregates,
    entries_of,
    heading,
    outside,
    percent,
    shape_name,
    shown,
    statistic_of,
    with_unit,
)

from iflow_gym.figures import PALETTE
from iflow_gym.leaderboard.submission import Submission
from iflow_gym.metrics import METRICS, Motion, get_metric, metrics_of
from iflow_gym.results import Result

NAME = "index.html"

TEMPLATES = Path(__file__).resolve().parent / "templates"

REPOSITORY = Path(__file__).resolve().parents[1]

SHOWN_FIRST: dict[Motion, tuple[str, ...]] = {
    "goal": (
        "frechet",
        "rmse",
        "converged",
        "perturbation_recovery",
        "fit_cpu_seconds",
        "step_us",
    ),
    "cycle": (
        "orbit_hausdorff",
        "period_error",
        "attraction",
        "perturbation_recovery",
        "fit_cpu_seconds",
        "step_us",
    ),
    "drumming": (
        "rhythm_f1",
        "hit_f1",
        "attraction",
        "perturbation_recovery",
        "fit_cpu_seconds",
        "step_us",
    ),
}
"""Columns of a table before it is expanded."""

GROUPS = {"accuracy": "Accuracy", "stability": "Stability", "cost": "Cost"}

FIGURES = {
    "accuracy-stability": (
        "Accuracy against stability",
        "To the upper {better} a method follows the demonstrations and ends where they end. Bars "
        "are 95 % intervals.",
    ),
    "accuracy-fit-time": (
        "Accuracy against the time to fit",
        "To the {corner} a method is accurate and cheap. Bars are 95 % intervals.",
    ),
    "profile": ("How many motions are done how well", CAPTIONS["profile"]),
    "boxes": (
        "Every motion's scores",
        "A point for each motion, boxes over the quartiles; the dashed line is the median distance "
        "between the demonstrations themselves.",
    ),
}
"""Heading and caption of a board's figures of numbers, in their order on the page."""

ANIMATION = REPOSITORY / "docs" / "images" / "drumming-learned.gif"
"""The arm as it drums what it has learned, on the page of boards of drumming."""

LARGEST_ANIMATION = 1_500_000
"""Bytes; a larger one stays out of the page."""


def render(
    boards: Sequence[Board],
    results: Sequence[Result],
    units: Mapping[str, str],
    output: Path,
    *,
    drawings: Mapping[str, Drawing],
    figures: Mapping[str, Figure],
    submissions: Mapping[str, Submission],
) -> str:
    """Return the page.

    Parameters
    ----------
    boards
        From `make_boards`.
    results
        The records that the boards are of.
    units
        Family to its unit of length.
    output
        Folder that the page is for: links to the repository's documents are relative to it.
    drawings, figures
        The sheets and what was drawn of them, whose panels make the gallery; without figures the
        page has no pictures at all, and is quick to make.
    submissions
        What methods' folders say of them, by the methods' names.
    """
    pictures = bool(figures) or not drawings
    styles = Styles()
    data: dict[str, dict[str, Any]] = {}
    families: dict[str, list[dict[str, Any]]] = {}
    for board in boards:
        unit = units.get(board.family, "length")
        key = identifier(f"{board.family}-{board.protocol}")
        data[key] = {
            row.method: details(board, row, unit, submissions.get(row.method)) for row in board.rows
        }
        families.setdefault(board.family, []).append(
            board_context(board, unit, key, drawings, figures, styles if pictures else None)
        )
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    text = environment.get_template("index.html.j2").render(
        families=[
            {"name": name, "key": identifier(name), "boards": entries}
            for name, entries in families.items()
        ],
        protocols=[name for name in PROTOCOLS if any(b.protocol == name for b in boards)],
        protocol_meanings=PROTOCOLS,
        kinds=_kinds(boards),
        data=Markup(as_script_data(data)),
        glossary=[
            {"metric": m, "group": GROUPS[m.family], "unit": "" if m.unit == "-" else m.unit}
            for m in METRICS
        ],
        ranked={KINDS[m]: [get_metric(n).title for n in RANKED[m]] for m in _motions(boards)},
        trial=all(result.preset == "smoke" for result in results),
        warnings=[plain(note) for note in warnings_about(results)],
        memory=MEMORY,
        versions=versions_of(results),
        days=_days(results),
        links=links(output),
        n_records=len(results),
        palette=range(len(PALETTE)),
        style=Markup((TEMPLATES / "page.css").read_text(encoding="utf-8")),
        figure_style=Markup(styles.css()),
        script=Markup((TEMPLATES / "page.js").read_text(encoding="utf-8")),
    )
    return "\n".join(line.rstrip() for line in text.splitlines() if line.strip()) + "\n"


def without_pictures(page: str) -> str:
    """Return a page's text without its figures and pictures, which differ between machines."""
    page = re.sub(r'<style id="figure-style">.*?</style>\n?', "", page, flags=re.S)
    return re.sub(r" *<figure.*?</figure>\n?", "", page, flags=re.S)


def as_script_data(value: Any) -> str:
    """Return JSON that may stand inside a script element whatever its strings hold."""
    text = json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    for character in "<>&\u2028\u2029":  # ends a script, opens a comment, ends a line
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def identifier(name: str) -> str:
    """Return a name as an id: letters, digits and "-"."""
    return re.sub(r"[^A-Za-z0-9]+", "-", name).strip("-")


def plain(text: str) -> str:
    """Return a sentence of the Markdown page without its marks."""
    text = re.sub(r"\*([^*]+)\*", r"\1", text)
    text = re.sub(r"\\([\\|*_`\[\]])", r"\1", text.replace("`", ""))
    return text.replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&")


def links(output: Path) -> dict[str, str]:
    """Return addresses of documents relative to the page; none from another drive."""
    folder = output.resolve()
    if folder.drive != REPOSITORY.drive:
        return {}
    targets = {
        "adding": "docs/adding-a-method.md",
        "submissions": "docs/submissions.md",
        "metrics": "docs/metrics.md",
        "environments": "docs/environments.md",
        "readme": "README.md",
    }
    return {"markdown": "LEADERBOARD.md"} | {
        name: Path(os.path.relpath(REPOSITORY / target, folder)).as_posix()
        for name, target in targets.items()
    }


def _motions(boards: Sequence[Board]) -> list[Motion]:
    return list(dict.fromkeys(board.motion for board in boards))


def _kinds(boards: Sequence[Board]) -> list[str]:
    """Return the kinds of guarantee that any row states, strongest first."""
    found = {kind for board in boards for row in board.rows for kind in row.guarantees}
    return [kind for kind in ("proved", "verified", "sampled", "none") if kind in found]


def _days(results: Sequence[Result]) -> str:
    days = sorted(result.created[:10] for result in results)
    return days[0] if days[0] == days[-1] else f"{days[0]} to {days[-1]}"


# A board ------------------------------------------------------------------------------------


def board_context(
    board: Board,
    unit: str,
    key: str,
    drawings: Mapping[str, Drawing],
    figures: Mapping[str, Figure],
    styles: Styles | None,
) -> dict[str, Any]:
    """Return what the template says of a board; without styles, all but figures and pictures."""
    found = aggregates(board)
    columns = columns_of(board, found, unit)
    return {
        "key": key,
        "family": board.family,
        "protocol": board.protocol,
        "n": len(board.environments),
        "what": WHAT.get(board.family, "motions"),
        "note": NOTES.get((board.family, board.protocol), ""),
        "warnings": [plain(note) for note in contradictions(board)],
        "cards": cards(board, found, unit),
        "columns": columns,
        "groups": row_groups(board, columns),
        "n_columns": len(columns) + 4,
        "footnote": plain(footnote(board, found)),
        "outside": outside(board),
        "figures": [] if styles is None else number_pictures(board, styles),
        "left_out": left_out(board),
        "ranks": rank_context(board, styles),
        "improvements": improvement_context(board),
        "confusions": confusions(board),
        "galleries": galleries(board, drawings, figures, unit),
        "animation": animation() if styles is not None and board.motion == "drumming" else None,
    }


def columns_of(board: Board, found: Aggregates, unit: str) -> list[dict[str, Any]]:
    """Return the columns of every metric that a row has a value of."""
    first = SHOWN_FIRST[board.motion]
    columns = []
    names = [m.name for m in metrics_of(board.motion)]
    places = {name: place for place, name in enumerate(first)}
    names.sort(key=lambda n: (list(GROUPS).index(get_metric(n).family), places.get(n, len(first))))
    for name in names:
        if not any(found[row.method, name] is not None for row in board.rows):
            continue
        metric = get_metric(name)
        statistic = statistic_of(name)
        label = heading(name, unit)
        title, _, bracket = label.partition(" (")
        columns.append(
            {
                "name": name,
                "title": title if bracket else label,
                "unit": bracket.rstrip(")"),
                "arrow": "↓" if metric.better == "lower" else "↑",
                "better": f"{metric.better} is better",
                "definition": metric.definition,
                "group": metric.family,
                "first": name in first,
                "statistic": "mean" if statistic == "mean" else "interquartile mean",
                "entries": entries_of(board, found, name, statistic),
            }
        )
    return columns


def row_groups(board: Board, columns: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows in three groups: competitors, what follows a clock, references."""
    groups = [
        ("competitors", "", [row for row in board.rows if row.competes]),
        (
            "clock",
            "Follow a clock: no field, and not ranked",
            [row for row in board.rows if row.uses_time and not row.reference],
        ),
        (
            "references",
            "References: no methods, and not ranked",
            [row for row in board.rows if row.reference],
        ),
    ]
    return [
        {
            "kind": kind,
            "title": title,
            "rows": [row_context(board, row, columns) for row in rows],
        }
        for kind, title, rows in groups
        if rows
    ]


def row_context(board: Board, row: Row, columns: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a line of the table."""
    rank = board.mean_rank.get(row.method) if row.competes else None
    entries: list[Entry] = [column["entries"][row.method] for column in columns]
    return {
        "method": row.method,
        "title": row.title,
        "uses_time": row.uses_time,
        "reference": row.reference,
        "guarantees": guarantees_of(row),
        "strength": _strength(row),
        "rank": None if rank is None else f"{rank:.2f}",
        "rank_best": row.method in board.first,
        "coverage": row.coverage,
        "complete": row.complete,
        "share": row.n_scored / row.n_expected,
        "cells": [
            {"entry": entry, "sort": sortable(entry.value), "column": column}
            for entry, column in zip(entries, columns, strict=True)
        ],
    }


def _strength(row: Row) -> int:
    order = ("none", "sampled", "verified", "proved")
    kinds = [order.index(kind) for kind in row.guarantees if kind in order]
    return min(kinds, default=-1)


def sortable(value: float) -> str:
    """Return a number for the script to sort by; nothing for nan."""
    if math.isnan(value):
        return ""
    return f"{value:.8g}".replace("inf", "Infinity")


def cards(board: Board, found: Aggregates, unit: str) -> list[dict[str, str]]:
    """Return what a reader should see first: the most accurate, the proved, the cost."""
    metric = MAIN[board.motion]
    title, label = get_metric(metric).title, heading(metric, unit)
    bracket = label.partition(" (")[2].rstrip(")")
    entries = entries_of(board, found, metric, statistic_of(metric))
    sign = 1.0 if get_metric(metric).better == "lower" else -1.0
    order = sorted(
        (row for row in board.fullest if not math.isnan(entries[row.method].value)),
        key=lambda row: sign * entries[row.method].value,
    )
    if not order:
        return []
    first = order[0]
    entry = entries[first.method]
    level = [row for row in order if entries[row.method].text == entry.text]
    text = f"{title} {entry.text} {bracket}".rstrip()
    if entry.interval:
        text += f" ({entry.interval})"
    text += f", over {first.coverage} cells"
    beside = ""
    if len(level) > 1:
        text = f"Level: {title} {entry.text} {bracket}".rstrip()
    elif len(order) > 1:
        second = order[1]
        beside = f"Next: {second.title}, {entries[second.method].text} {bracket}".rstrip()
        chance = improvements(board).get((first.method, second.method))
        if chance is not None and chance.n_environments > 1:
            beside += (
                f"; on a motion drawn at random {first.title} is the better one with "
                f"{100 * chance.probability:.0f} % probability"
            )
        beside += "."
    if less := [row for row in board.competitors if row not in board.fullest]:
        names = ", ".join(f"{row.title} ({row.coverage})" for row in less)
        beside += f" Not compared here, since incomplete: {names}."
    if board.first and first.method not in board.first:
        titles = " and ".join(row.title for row in board.competitors if row.method in board.first)
        beside += f" Best mean rank over all metrics of accuracy: {titles}."
    beside = beside.strip()
    result = [
        {
            "label": "Most accurate",
            "value": ", ".join(row.title for row in level),
            "text": text,
            "beside": beside,
        },
        proved_card(board, found),
    ]
    fit, step = found[first.method, "fit_cpu_seconds"], found[first.method, "step_us"]
    if fit is not None and step is not None:
        cost = f"{with_unit('fit_cpu_seconds', fit.iqm)} of CPU to fit a motion"
        beside = f"For {first.title}; a step takes {with_unit('step_us', step.iqm)}."
        quick = [
            (a.iqm, row.title)
            for row in board.fullest
            if (a := found[row.method, "fit_cpu_seconds"]) is not None
        ]
        if quick and min(quick)[1] != first.title:
            seconds, name = min(quick)
            beside += f" Quickest: {name}, {with_unit('fit_cpu_seconds', seconds)}."
        result.append({"label": "Its cost", "value": cost, "text": beside, "beside": ""})
    return result


def proved_card(board: Board, found: Aggregates) -> dict[str, str]:
    """Return which competitors have a proof on every cell, and what was measured of them."""
    holds = HOLDS[board.motion]
    proved = [row for row in board.competitors if row.guarantees == ("proved",)]
    measured = {row.method: found[row.method, holds] for row in proved}
    whole = [row for row in proved if (a := measured[row.method]) is not None and a.mean == 1]
    rest = [row for row in proved if row not in whole]
    converge = "converged" if holds == "converged" else "were attracted"
    text = f"Proved, and all starts {converge}." if whole else ""
    if less := [f"{row.title} {row.coverage} cells" for row in whole if not row.complete]:
        text = f"{text[:-1]}, of what was run: {', '.join(less)}."
    if rest:
        shares = ", ".join(
            f"{row.title} {percent(a.mean)} %"
            for row in rest
            if (a := measured[row.method]) is not None
        )
        begin = " Also proved" if whole else "Proved"
        text += f"{begin}, but not all starts {converge} within the horizon: {shares}."
    value = ", ".join(row.title for row in whole) or "No method without exception"
    return {
        "label": "Stable for sure",
        "value": value,
        "text": text.strip() or "No competitor has a proof on every cell.",
        "beside": "",
    }


# Figures ------------------------------------------------------------------------------------


def number_pictures(board: Board, styles: Styles) -> list[dict[str, Any]]:
    """Return a board's figures of numbers, in the page's colours."""
    makers = number_figures(board)
    lower = get_metric(MAIN[board.motion]).better == "lower"
    words = {
        "better": "left" if lower else "right",
        "corner": "lower left" if lower else "upper left",
    }
    return [
        {
            "title": title,
            "caption": caption.format(**words),
            "svg": Markup(
                inline_svg(makers[name](), f"{title}, {board.family}, {board.protocol}", styles)
            ),
            "wide": name == "boxes",
        }
        for name, (title, caption) in FIGURES.items()
        if name in makers
    ]


def left_out(board: Board) -> str:
    """Say why a board has no figures of all motions; nothing where it has them."""
    n = n_run(board)
    if n >= FEWEST_FOR_BOXES:
        return ""
    return (
        f"How many motions are done how well, and boxes of every motion's scores, are drawn of "
        f"{FEWEST_FOR_BOXES} motions or more; of this family {n} {'was' if n == 1 else 'were'} run."
    )


def rank_context(board: Board, styles: Styles | None) -> dict[str, Any] | None:
    """Return the tests of ranks and their figure."""
    comparison = rank_comparison(board)
    if comparison is None:
        return None
    svg = ""
    if styles is not None:
        svg = inline_svg(number_figures(board)["ranks"](), "Mean ranks", styles)
    return {
        "words": plain(ranks_in_words(board, comparison)),
        "caption": CAPTIONS["ranks"],
        "svg": Markup(svg),
    }


def improvement_context(board: Board) -> dict[str, Any] | None:
    """Return the table of the probabilities of improvement."""
    found = improvements(board)
    if not found:
        return None
    rows = compared(board)
    has, ground = len(board.environments), len(ranked(board)[1])
    of_them = f"has {has}" if has < FEWEST_ENVIRONMENTS else f"has {ground} that all were run on"

    def entry(one: Row, other: Row) -> dict[str, str] | None:
        p = found.get((one.method, other.method))
        if p is None:
            return {"text": "–", "interval": "", "share": "0"} if one is not other else None
        low, high = (f"{100 * end:.0f}" for end in p.interval)
        return {
            "text": f"{100 * p.probability:.0f}",
            "interval": "" if low == high or "nan" in low else f"{low} to {high}",
            "share": f"{p.probability:.3f}",
        }

    return {
        "metric": get_metric(MAIN[board.motion]).title,
        "words": improvement_in_words(found),
        "few": (
            f"Friedman's and Nemenyi's tests take at least {FEWEST_ENVIRONMENTS} environments, and "
            f"this family {of_them}."
            if ground < FEWEST_ENVIRONMENTS
            else ""
        ),
        "titles": [row.title for row in rows],
        "rows": [
            {"title": one.title, "cells": [entry(one, other) for other in rows]} for one in rows
        ],
    }


def confusions(board: Board) -> list[dict[str, Any]]:
    """Return which motion is taken for which, by each method whose models have densities."""
    found = []
    for row in board.methods:
        counts = confusion(row)
        if counts is not None and board.protocol == "generalisation":
            n = counts.sum(axis=1, keepdims=True).clip(min=1)
            found.append(
                {
                    "title": row.title,
                    "right": percent(fraction_right(counts)),
                    "n": int(counts.sum()),
                    "names": [shape_name(environment) for environment in row.environments],
                    "rows": [
                        [{"count": int(c), "share": f"{s:.3f}"} for c, s in zip(*pair, strict=True)]
                        for pair in zip(counts, counts / n, strict=True)
                    ],
                }
            )
    return found


def galleries(
    board: Board, drawings: Mapping[str, Drawing], figures: Mapping[str, Figure], unit: str
) -> list[dict[str, Any]]:
    """Return the pictures of learned fields that belong to a board."""
    names = {
        "methods": "One shape by every method",
        "fields": "Every shape by one method",
        f"{board.family}-fields": "Every motion by every method",
    }
    if board.protocol != "reproduction":
        return []
    found = []
    for name, title in names.items():
        drawing, figure = drawings.get(name), figures.get(name)
        if drawing is None or (name in ("methods", "fields") and board.family != HEADLINE):
            continue
        pictures = [""] * len(drawing.specs) if figure is None else panel_pictures(
            figure, len(drawing.specs)
        )  # fmt: skip
        panels = []
        for spec, picture in zip(drawing.specs, pictures, strict=True):
            cell = first_cell(spec)
            metric = MAIN[spec.row.motion]
            score = None if cell is None or not cell.ok else cell.metrics.get(metric)
            panels.append(
                {
                    "shape": shape_name(spec.environment),
                    "method": spec.row.title,
                    "score": f"{get_metric(metric).title} {shown(metric, score)} {unit}"
                    if score is not None
                    else "no score",
                    "picture": picture,
                }
            )
        found.append({"title": title, "caption": CAPTIONS.get(name, ""), "panels": panels})
    return found


def animation() -> dict[str, Any] | None:
    """Return the drumming arm, as a still and as what moves; None where it is not there."""
    if not ANIMATION.is_file() or ANIMATION.stat().st_size > LARGEST_ANIMATION:
        return None
    import numpy as np
    from PIL import Image

    with Image.open(ANIMATION) as image:
        size = image.size
        still = webp(np.asarray(image.convert("RGB")))
    return {
        "moving": moving_webp(ANIMATION),
        "still": still,
        "width": size[0],
        "height": size[1],
    }
