"""What a run tells a person: bars on a terminal, stamped lines elsewhere, a table at the end."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from datetime import datetime
from types import TracebackType
from typing import Any, Self

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from iflow_gym.metrics import get_metric
from iflow_gym.results import Result

COLUMNS = ("rmse", "frechet", "dtw", "swept_area", "converged", "perturbation_recovery")
"""Metrics of the table at the end."""


class Reporter:
    """Follows the events of a run; a context manager."""

    def __init__(self, console: Console, total: int) -> None:
        self._console = console
        self._total = total
        self._n_done = 0
        self._progress: Progress | None = None
        if console.is_terminal and total:
            self._progress = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                TextColumn("{task.fields[count]}"),
                TimeElapsedColumn(),
                console=console,
            )
            self._bar = self._progress.add_task("cells", total=total, count=f"0/{total}")
            self._workers: dict[int, TaskID] = {}

    def __enter__(self) -> Self:
        if self._progress is not None:
            self._progress.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._progress is not None:
            self._progress.stop()

    def line(self, text: str) -> None:
        """Say something."""
        stamp = "" if self._console.is_terminal else f"{datetime.now():%H:%M:%S} "
        self._console.print(escape(stamp + text), highlight=False, soft_wrap=True)

    def event(self, event: dict[str, Any]) -> None:
        """Show an event of a worker's journal."""
        kind = event["event"]
        if kind == "note":
            self.line(event["text"])
        elif kind == "batch":
            self._doing(event, f"{event['label']}: fitting {event['cells']} cells together")
        elif kind == "begin":
            if self._progress is not None:
                self._doing(event, event["label"])
        elif kind == "done":
            self._n_done += 1
            if self._progress is not None:
                count = f"{self._n_done}/{self._total}"
                self._progress.update(self._bar, completed=self._n_done, count=count)
                if event["pid"] in self._workers:
                    self._progress.update(self._workers[event["pid"]], visible=False)
            if event["reason"]:
                reason, *frames = event["reason"].splitlines()
                where = f" (where: {event['path']}, reason)" if frames else ""
                self.line(f"{event['label']}: FAILED, {reason}{where}")
            elif infinite := event.get("infinite"):
                titles = ", ".join(get_metric(name).title for name in infinite)
                why = "a rollout ran away, or a velocity was nan or infinite"
                if infinite == ["timing_error"]:
                    why = "from one of the starts no hit was near a note"
                self.line(f"{event['label']}: done, but {titles} infinite: {why}")
            elif self._progress is None:
                self.line(
                    f"{event['label']}: done in {event['seconds']:.1f} s "
                    f"({self._n_done}/{self._total})"
                )

    def _doing(self, event: dict[str, Any], text: str) -> None:
        if self._progress is None:
            self.line(text)
            return
        worker = event["pid"]
        if worker not in self._workers:
            self._workers[worker] = self._progress.add_task(text, total=None, count="")
        self._progress.reset(self._workers[worker], description=escape(text), visible=True)


class Spent:
    """Adds up what each method took of a run, by the events of its workers.

    Seconds are those of workers: two that work side by side for a minute spend two. Work that a
    killed worker did not finish is not in them.
    """

    def __init__(self) -> None:
        self.methods: dict[str, dict[str, float]] = {}

    def event(self, event: dict[str, Any]) -> None:
        """Count an event of a worker's journal."""
        if event["event"] not in ("fitted", "done"):
            return
        fresh = {"cells": 0, "failed": 0, "seconds": 0.0, "cpu_seconds": 0.0}
        row = self.methods.setdefault(event["method"], fresh)
        if event["event"] == "done":
            row["cells"] += 1
            row["failed"] += event["reason"] is not None
        row["seconds"] += event["seconds"]
        row["cpu_seconds"] += event["cpu_seconds"]

    def table(self) -> Table:
        """Return a row for each method, the dearest first."""
        table = Table(title="What each method took of this run, to fit and to score")
        table.add_column("Method", no_wrap=True)
        for title in ("Cells", "Worker s", "CPU s", "CPU s a cell", "Share"):
            table.add_column(title, justify="right")
        total = math.fsum(row["seconds"] for row in self.methods.values())
        for name, row in sorted(self.methods.items(), key=lambda item: -item[1]["seconds"]):
            each = row["cpu_seconds"] / max(1, row["cells"])
            table.add_row(
                escape(name),
                f"{row['cells']:.0f}",
                f"{row['seconds']:.1f}",
                f"{row['cpu_seconds']:.1f}",
                f"{each:.2f}",
                f"{row['seconds'] / total:.1%}" if total else "-",
            )
        return table


def summary(results: Sequence[Result]) -> Table:
    """Return a table of mean scores, a row for each method and protocol."""
    units = "lengths are the demonstrations' own, times in seconds"
    table = Table(title=f"Means over the cells that have a score; {units}")
    table.add_column("Method", no_wrap=True)
    table.add_column("Protocol", no_wrap=True)
    table.add_column("Cells", justify="right")
    for name in COLUMNS:
        table.add_column(get_metric(name).title, justify="right")
    table.add_column("Fit", justify="right")
    table.add_column("Scoring", justify="right")
    rows: dict[tuple[str, str], list[Result]] = defaultdict(list)
    for result in results:
        rows[result.title, result.protocol].append(result)
    for (title, protocol), group in rows.items():
        good = [r for r in group if r.ok]
        table.add_row(
            escape(title),
            protocol,
            f"{len(good)}/{len(group)}",
            *(_mean([r.metrics.get(name) for r in good]) for name in COLUMNS),
            _mean_seconds([r.metrics.get("fit_seconds") for r in good]),
            _mean_seconds([r.fit.get("evaluate_seconds") for r in good]),
        )
    return table


def _mean_seconds(values: Sequence[float | None]) -> str:
    """Return a mean in seconds, or with its unit below a millisecond."""
    text = _mean(values)
    if text == "-" or not 0 < float(text) < 1e-3:
        return text
    milliseconds = _mean([None if v is None else 1e3 * v for v in values])
    return f"{milliseconds} ms"


def _mean(values: Sequence[float | None]) -> str:
    present = [v for v in values if v is not None]
    return f"{math.fsum(present) / len(present):.3g}" if present else "-"
