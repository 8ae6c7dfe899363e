"""What the page tells of one row when asked: settings, machines, every motion's own scores."""

from __future__ import annotations

import json
import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from board import Board, Row
from tables import heading, shape_name, shown

from iflow_gym.leaderboard.submission import Submission
from iflow_gym.metrics import Metric, metrics_of
from iflow_gym.results import Result, short_name
from iflow_gym.statistics import mean_intervals

SETTING_LENGTH = 200
"""Characters of a setting that are shown."""


def details(
    board: Board, row: Row, length_unit: str, submission: Submission | None = None
) -> dict[str, Any]:
    """Return what is known of a row, in words, for JSON; a fact's third entry is its address."""
    cells = [row.cells[key] for key in sorted(row.cells)]
    metrics = [m for m in metrics_of(board.motion) if row.applies(m.name)]
    scores = motion_scores(board, row, metrics)
    return {
        "facts": [
            ["Method", f"{row.title} ({row.method})"],
            *origin(submission),
            ["Class", _listed(cell.target for cell in cells)],
            ["Seeds", ", ".join(map(str, row.seeds))],
            ["Cells with scores", row.coverage],
            ["Presets", _listed(cell.preset for cell in cells)],
            ["Integration", _listed(cell.integrator for cell in cells)],
            ["Records made", _days(cells)],
            ["Hardware", _listed(map(hardware_of, cells))],
            ["Versions", versions_of(cells)],
        ],
        "settings": settings_of(cells),
        "guarantees": guarantees_of(row),
        "missing": missing(row),
        "metrics": [heading(m.name, length_unit) for m in metrics],
        "scores": scores,
    }


def origin(submission: Submission | None) -> list[list[str]]:
    """Return paper, code and note of a method, each with its address where it has one."""
    if submission is None:
        return []
    paper, link = submission.paper, address(submission.link)
    found = []
    if paper != "none":
        found.append(["Paper", paper, link])
    elif link:
        found.append(["Paper", link, link])
    found.append(["Code", submission.code, address(submission.code)])
    if submission.note is not None:
        found.append(["Note", submission.note, ""])
    return [entry if entry[2] else entry[:2] for entry in found]


def address(text: str | None) -> str:
    """Return text that may be a link's address, of the web; else nothing."""
    return text if text is not None and text.startswith(("https://", "http://")) else ""


def motion_scores(board: Board, row: Row, metrics: Sequence[Metric]) -> list[list[Any]]:
    """Return a line for each environment that was run: name, and a number and interval a metric.

    The number is the mean over the seeds. The interval is a 95 % bootstrap interval over the scored
    demonstrations, each its mean over the seeds; of what has one number a cell it is the least
    and the greatest of the seeds.
    """
    names = [metric.name for metric in metrics]
    intervals = _over_demonstrations(row, names)
    lines = []
    for environment in board.environments:
        ran = [row.cells[environment, s] for s in row.seeds if (environment, s) in row.cells]
        if not ran:
            continue
        good = [cell for cell in ran if cell.ok]
        if not good:
            lines.append([shape_name(environment), "failed"])
            continue
        line: list[Any] = [shape_name(environment)]
        for name in names:
            values = [v for cell in good if (v := cell.metrics.get(name)) is not None]
            if not values:
                line.append("–")
                continue
            with np.errstate(invalid="ignore"):
                text = shown(name, float(np.mean(values)))
            ends = intervals.get((environment, name))
            if ends is None and len(values) > 1:
                ends = (min(values), max(values))
            words = "" if ends is None else " to ".join(shown(name, end) for end in ends)
            line.append([text, words] if words and words != f"{text} to {text}" else text)
        if len(good) < len(ran):
            line[0] += f" ({len(good)} of {len(ran)} seeds)"
        lines.append(line)
    return lines


def _over_demonstrations(
    row: Row, names: Iterable[str]
) -> dict[tuple[str, str], tuple[float, float]]:
    """Return intervals over the demonstrations by environment and metric, all in few calls."""
    by_count: dict[int, list[tuple[tuple[str, str], np.ndarray[Any, Any]]]] = defaultdict(list)
    for environment in row.environments:
        cells = [c for s in row.seeds if (c := row.cells.get((environment, s))) and c.ok]
        for name in names:
            lists = [cell.per_demonstration.get(name) for cell in cells]
            values = [entries for entries in lists if entries]
            if not values or len({len(entries) for entries in values}) > 1:
                continue
            table = np.array(
                [[np.nan if v is None else v for v in entries] for entries in values], dtype=float
            )
            with np.errstate(invalid="ignore"):
                by_count[table.shape[1]].append(((environment, name), table.mean(axis=0)))
    found = {}
    for entries in by_count.values():
        low, high = mean_intervals(np.stack([values for _, values in entries]))
        for (key, _), a, b in zip(entries, low, high, strict=True):
            if not np.isnan(a):
                found[key] = (float(a), float(b))
    return found


@dataclass(frozen=True)
class Unscored:
    """Cells of a row that have no scores for the same reason."""

    reason: str
    """Of the first of them; nothing where they were never run."""
    n: int
    names: str
    """Which, as "Angle, Line (seed 0)"."""
    differ: bool
    """Whether the others' reasons are other words than the first one's."""


def unscored(row: Row) -> list[Unscored]:
    """Return the cells without scores in groups: those never run, and by reason those that failed.

    Reasons are alike whose first lines differ in numbers and in the motion's name alone.
    """
    groups: dict[str, list[tuple[str, int, str]]] = defaultdict(list)
    for environment in row.environments:
        for seed in row.seeds:
            cell = row.cells.get((environment, seed))
            if cell is not None and cell.ok:
                continue
            reason = "" if cell is None else (cell.reason or "").strip() or "no reason given"
            groups[_alike(reason, environment)].append((shape_name(environment), seed, reason))
    return [
        Unscored(
            reason=cells[0][2],
            n=len(cells),
            names=_names((name, seed) for name, seed, _ in cells),
            differ=len({reason for *_, reason in cells}) > 1,
        )
        for cells in groups.values()
    ]


def _alike(reason: str, environment: str) -> str:
    """Return the first line of a reason without numbers and without the motion's name."""
    first = reason.partition("\n")[0]
    for name in (environment, short_name(environment), shape_name(environment)):
        first = re.sub(rf"(?<!\w){re.escape(name)}(?!\w)", "…", first)
    return re.sub(r"[-+]?\d+(?:\.\d*)?(?:e[-+]?\d+)?", "#", first)


def _names(cells: Iterable[tuple[str, int]]) -> str:
    """Return motions and seeds in words, those of the same seeds together."""
    seeds: dict[str, list[int]] = defaultdict(list)
    for name, seed in cells:
        seeds[name].append(seed)
    together: dict[tuple[int, ...], list[str]] = defaultdict(list)
    for name, own in seeds.items():
        together[tuple(own)].append(name)
    return "; ".join(
        f"{', '.join(names)} (seed{'s' * (len(own) > 1)} {', '.join(map(str, own))})"
        for own, names in together.items()
    )


def missing(row: Row) -> list[list[str]]:
    """Return a line for each group of cells without scores: what became of them, which, and why."""
    lines = []
    for group in unscored(row):
        text = f"{group.n} {'cell' if group.n == 1 else 'cells'}: {group.names}"
        if group.reason:
            others = "\nThe others' reasons read alike." if group.differ else ""
            text += f"\n{group.reason}{others}"
        lines.append(["failed" if group.reason else "never run", text])
    return lines


def guarantees_of(row: Row) -> list[list[str]]:
    """Return kind and reason of each guarantee, weakest first, as the first cell states it."""
    found: dict[str, tuple[str, int]] = {}
    for cell in row.cells.values():
        if cell.guarantee is not None:
            kind = cell.guarantee.kind
            reason, n = found.get(kind, (cell.guarantee.reason, 0))
            found[kind] = (reason, n + 1)
    several = len(found) > 1
    return [
        [kind, f"{found[kind][0]}" + (f" ({found[kind][1]} cells)" if several else "")]
        for kind in row.guarantees
    ]


def settings_of(cells: Sequence[Result]) -> list[list[str]]:
    """Return the method's settings; one that is not the same in all cells has all its values."""
    names = sorted({name for cell in cells for name in cell.config})
    lines = []
    for name in names:
        values = sorted({json.dumps(c.config.get(name), sort_keys=True) for c in cells if c.config})
        text = " or ".join(values).replace('"', "").replace("null", "default")
        lines.append([name, text if len(text) <= SETTING_LENGTH else text[:SETTING_LENGTH] + " …"])
    return lines


def hardware_of(cell: Result) -> str:
    """Return a record's machine in words."""
    h = cell.hardware
    return (
        f"{h.get('cpu')}, {h.get('cores')} cores, {h.get('threads')} thread(s) a fit, "
        f"{h.get('platform')}"
    )


def versions_of(cells: Iterable[Result]) -> str:
    """Return the versions that records were made with."""
    used: dict[str, set[str]] = defaultdict(set)
    for cell in cells:
        for name, version in cell.versions.items():
            used[name.replace("_", "-")].add(version)  # a module is of its distribution
    return ", ".join(f"{name} {'/'.join(sorted(used[name]))}" for name in sorted(used))


def _listed(values: Iterable[str | None]) -> str:
    return "; ".join(sorted({value for value in values if value})) or "–"


def _days(cells: Sequence[Result]) -> str:
    days = sorted(cell.created[:10] for cell in cells)
    return days[0] if days[0] == days[-1] else f"{days[0]} to {days[-1]}"
