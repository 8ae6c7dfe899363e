"""What changed between two folders of results, in words for a pull request."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from iflow_gym.leaderboard.records import label
from iflow_gym.leaderboard.rescoring import NOT_COMPARED, SAME, differences_of_scores
from iflow_gym.metrics import get_metric
from iflow_gym.results import Result, read_results

COLUMNS = (
    "rmse",
    "frechet",
    "dtw",
    "converged",
    "diverged",
    "orbit_hausdorff",
    "attraction",
    "fit_cpu_seconds",
)
"""Metrics of the table; a change of any other one is counted."""

MOST_FAILURES = 20


def changes(before: Path, after: Path) -> str:
    """Return Markdown: what appeared, vanished, failed, and the means of what scores otherwise.

    Scores are the same within `rescoring.SAME`; costs are shown and never count as a change.

    Raises
    ------
    FileNotFoundError
        If one of the folders is none.
    ResultFileError
        If a record cannot be read.
    """
    old = {result.path: result for result in read_results(before)}
    new = {result.path: result for result in read_results(after)}
    both = sorted(old.keys() & new.keys())
    changed = [path for path in both if _scores_differ(old[path], new[path])]
    appeared, vanished = sorted(new.keys() - old.keys()), sorted(old.keys() - new.keys())
    lines = [
        f"{len(new)} cells: {len(both) - len(changed)} with the same scores, {len(changed)} with "
        f"others, {len(appeared)} new, {len(vanished)} gone."
    ]
    if vanished:
        names = sorted({path.parts[0] for path in vanished})
        lines += ["", f"Gone: cells of {', '.join(names)}."]
    failed = [path for path in sorted(new) if not new[path].ok]
    if failed:
        lines += ["", "Failed:", ""]
        for path in failed[:MOST_FAILURES]:
            was = " (before, too)" if path in old and not old[path].ok else ""
            reason = (new[path].reason or "").splitlines()[0]
            lines.append(f"- {new[path].method}, {label(new[path])}{was}: {_safe(reason)}")
        if len(failed) > MOST_FAILURES:
            lines.append(f"- and {len(failed) - MOST_FAILURES} more")
    rows = defaultdict[tuple[str, str, str], list[Path]](list)
    for path in (*changed, *appeared):
        rows[new[path].title, new[path].family, new[path].protocol].append(path)
    if rows:
        lines += ["", *_table(rows, old, new)]
    return "\n".join(lines)


def _scores_differ(old: Result, new: Result) -> bool:
    if old.ok != new.ok:
        return True
    return any(differences_of_scores(old.metrics, new.metrics, SAME))


def _table(
    rows: dict[tuple[str, str, str], list[Path]], old: dict[Path, Result], new: dict[Path, Result]
) -> list[str]:
    titles = [get_metric(name).title for name in COLUMNS]
    lines = [
        "Means over the cells that changed or are new, before → after:",
        "",
        "| Method | Family | Protocol | Cells | " + " | ".join(titles) + " |",
        "| --- | --- | --- | ---: | " + " | ".join("---:" for _ in titles) + " |",
    ]
    for (title, family, protocol), paths in sorted(rows.items()):
        cells = []
        for name in COLUMNS:
            was = _mean([old[p] for p in paths if p in old], name)
            now = _mean([new[p] for p in paths], name)
            same = was == now and name not in NOT_COMPARED
            cells.append(now if was == "-" or same else f"{was} → {now}")
        shown = (_safe(title), _safe(family), protocol, str(len(paths)), *cells)
        lines.append("| " + " | ".join(shown) + " |")
    return lines


def _mean(results: Sequence[Result], name: str) -> str:
    values = [value for result in results if (value := result.metrics.get(name)) is not None]
    return f"{math.fsum(values) / len(values):.3g}" if values else "-"


def _safe(text: str) -> str:
    """Return a record's own words as Markdown that is text alone."""
    shown = "".join(c if c.isprintable() else "?" for c in text)[:200]
    for sign in "\\`*_[]<>|@#":
        shown = shown.replace(sign, f"&#{ord(sign)};" if sign in "<>@#" else "\\" + sign)
    return shown
