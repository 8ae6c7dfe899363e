"""Results as boards: one for each family and protocol, a row for each method, nothing dropped.

A cell is (method, environment, seed). A cell that failed and a cell that was never run are both nan
here: they count as missing and are listed. One that failed ranks last; ranks are taken where all
that are ranked were run.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from iflow_gym.datasets.lasa import MULTI_MODELS, SINGLE_MOTIONS
from iflow_gym.datasets.letters import LETTERS
from iflow_gym.metrics import (
    Aggregate,
    Motion,
    aggregate_scores,
    get_metric,
    mean_ranks,
    metrics_of,
)
from iflow_gym.registration import lasa_id, letter_id
from iflow_gym.results import Result
from iflow_gym.system import GUARANTEE_KINDS

FAMILIES = {
    "LASA-26": tuple(lasa_id(shape) for shape in SINGLE_MOTIONS),
    "LASA-Multi": tuple(lasa_id(shape) for shape in MULTI_MODELS),
    "Letter": tuple(letter_id(letter) for letter in LETTERS),
}
"""Environments that a family has, run or not; other families have those that were run."""

RANKED: dict[Motion, tuple[str, ...]] = {
    "goal": ("rmse", "frechet", "dtw", "swept_area", "seds_error", "direction_error"),
    "cycle": (
        "orbit_distance",
        "orbit_hausdorff",
        "period_error",
        "phase_rmse",
        "dtw",
        "seds_error",
        "direction_error",
    ),
    "drumming": (
        "rhythm_f1",
        "sequence_f1",
        "hit_f1",
        "timing_error",
        "tempo_error",
        "period_error",
        "orbit_distance",
        "orbit_hausdorff",
    ),
}
"""Metrics whose ranks the mean rank is the mean of: those of the accuracy table."""

MAIN: dict[Motion, str] = {
    "goal": "frechet",
    "cycle": "orbit_hausdorff",
    "drumming": "rhythm_f1",
}
"""The accuracy that figures and tests of one number are of."""

HOLDS: dict[Motion, str] = {
    "goal": "converged",
    "cycle": "attraction",
    "drumming": "attraction",
}
"""The stability that is set against it: the share of the starts that end where they should."""


LEAST_SHARED = 0.5
"""Share of the environments of what was run the most that all ranked rows must have in common."""


@dataclass(frozen=True)
class Row:
    """One method on one family under one protocol."""

    method: str
    title: str
    reference: bool
    uses_time: bool
    """Whether the method follows a clock and has no field."""
    environments: tuple[str, ...]
    """All that the family has."""
    seeds: tuple[int, ...]
    """All that the method was run with, on any environment of the board."""
    cells: Mapping[tuple[str, int], Result]
    """By environment and seed."""
    motion: Motion
    """Whether the family's motions end at a goal or repeat."""

    @property
    def competes(self) -> bool:
        """Whether the row is ranked: a field that is learned from the demonstrations."""
        return not (self.reference or self.uses_time)

    @property
    def n_expected(self) -> int:
        """Cells that should have a score."""
        return len(self.environments) * len(self.seeds)

    @property
    def n_scored(self) -> int:
        """Cells that have scores."""
        return sum(cell.ok for cell in self.cells.values())

    @property
    def complete(self) -> bool:
        """Whether every expected cell has scores."""
        return self.n_scored == self.n_expected

    @property
    def coverage(self) -> str:
        """As "24 of 26"."""
        return f"{self.n_scored} of {self.n_expected}"

    @property
    def ran(self) -> set[str]:
        """Environments that the method was run on, failed or not."""
        return {environment for environment, _ in self.cells}

    @property
    def failed(self) -> list[Result]:
        """Cells that were run and have no scores."""
        return [cell for cell in self.cells.values() if not cell.ok]

    @property
    def n_never_run(self) -> int:
        """Cells that have no record."""
        return self.n_expected - len(self.cells)

    @property
    def guarantees(self) -> tuple[str, ...]:
        """Kinds of guarantee that the cells state, weakest first."""
        kinds = {cell.guarantee.kind for cell in self.cells.values() if cell.guarantee is not None}
        return tuple(kind for kind in GUARANTEE_KINDS if kind in kinds)

    def applies(self, metric: str) -> bool:
        """Whether any cell has a value of the metric."""
        return any(cell.ok and cell.metrics.get(metric) is not None for cell in self.cells.values())

    def scores(self, metric: str) -> dict[str, NDArray[np.float64]]:
        """Return environment -> the seeds' scores, shape (S,), nan where there is none."""
        return {
            environment: np.array([self._score(metric, environment, seed) for seed in self.seeds])
            for environment in self.environments
        }

    def run_scores(self, metric: str) -> dict[str, NDArray[np.float64]]:
        """Return environment -> scores of the seeds that were run there; nan where one failed.

        Environments without a cell are not in it.
        """
        found: dict[str, list[float]] = {}
        for environment in self.environments:
            for seed in self.seeds:
                if (environment, seed) in self.cells:
                    found.setdefault(environment, []).append(self._score(metric, environment, seed))
        return {environment: np.array(scores) for environment, scores in found.items()}

    def run_means(self, metric: str, environments: Sequence[str]) -> NDArray[np.float64]:
        """Return means over the seeds that were run, shape (E,), nan where one failed.

        Of environments that the method was run on.
        """
        found = self.run_scores(metric)
        with np.errstate(invalid="ignore"):
            return np.array([found[environment].mean() for environment in environments])

    def _score(self, metric: str, environment: str, seed: int) -> float:
        cell = self.cells.get((environment, seed))
        value = cell.metrics.get(metric) if cell is not None and cell.ok else None
        return np.nan if value is None else float(value)

    @cached_property
    def _aggregates(self) -> dict[str, Aggregate | None]:
        return {}

    def aggregate(self, metric: str) -> Aggregate | None:
        """Return a metric over all cells; None where it does not apply to the method."""
        if metric not in self._aggregates:  # the bootstrap is what takes the time
            self._aggregates[metric] = (
                aggregate_scores(self.scores(metric)) if self.applies(metric) else None
            )
        return self._aggregates[metric]

    def reward(self) -> Aggregate | None:
        """Return the mean reward a step over all cells; None unless every scored cell has one."""
        cells = [cell for cell in self.cells.values() if cell.ok]
        if not cells or not all("mean" in cell.returns for cell in cells):
            return None
        found = {
            environment: np.array(
                [
                    cell.returns["mean"]
                    if (cell := self.cells.get((environment, seed)))
                    else np.nan
                    for seed in self.seeds
                ]
            )
            for environment in self.environments
        }
        return aggregate_scores(found)

    def by_environment(self, metric: str) -> NDArray[np.float64]:
        """Return means over the seeds, shape (E,); nan where a seed has no score."""
        with np.errstate(invalid="ignore"):
            return np.array([group.mean() for group in self.scores(metric).values()])


@dataclass(frozen=True)
class Board:
    """All methods on one family under one protocol."""

    family: str
    protocol: str
    environments: tuple[str, ...]
    motion: Motion
    """Whether its motions end at a goal or repeat."""
    rows: tuple[Row, ...]
    """Competitors by mean rank, best first, then those that have none; then by name those that use
    time, the references."""

    @property
    def competitors(self) -> tuple[Row, ...]:
        """Rows that are ranked."""
        return tuple(row for row in self.rows if row.competes)

    @property
    def fullest(self) -> tuple[Row, ...]:
        """Competitors that have scores of as many of their cells as any."""
        share = {row.method: row.n_scored / row.n_expected for row in self.competitors}
        most = max(share.values(), default=0.0)
        return tuple(row for row in self.competitors if share[row.method] == most > 0)

    @property
    def methods(self) -> tuple[Row, ...]:
        """Rows that were fitted: all but the references."""
        return tuple(row for row in self.rows if not row.reference)

    @cached_property
    def mean_rank(self) -> dict[str, float]:
        """Name of each competitor that is ranked -> mean of its ranks, by `ranks_of`."""
        return ranks_of(self.competitors)

    @property
    def first(self) -> set[str]:
        """Names of the competitors of the best mean rank."""
        best = np.nanmin([*self.mean_rank.values(), np.inf])
        return {name for name, rank in self.mean_rank.items() if rank == best}

    def best(self, values: Mapping[str, float], metric: str) -> set[str]:
        """Return the methods whose value is the best, of those that compete.

        Only rows that cover as many cells as the fullest one compete: a mean over the three
        easiest environments is no better than one over all.
        """
        full = {row.method for row in self.fullest}
        sign = 1.0 if get_metric(metric).better == "lower" else -1.0
        fit = {
            name: sign * value
            for name, value in values.items()
            if name in full and not np.isnan(value)
        }
        return {name for name, value in fit.items() if value == min(fit.values())}


def common_ground(rows: Sequence[Row]) -> tuple[list[Row], list[str]]:
    """Return which of the rows can be ranked, and the environments that all of these were run on.

    Rows are taken in turn, what was run the most first. One is left out with which fewer than
    `LEAST_SHARED` of the first one's environments would be common to all.
    """
    taken: set[str] = set()
    ground: set[str] = set()
    least = LEAST_SHARED * max((len(row.ran) for row in rows), default=0)
    for row in sorted(rows, key=lambda row: (-len(row.ran), row.method)):
        common = ground & row.ran if taken else row.ran
        if len(common) >= least:
            taken.add(row.method)
            ground = common
    ranked = [row for row in rows if row.method in taken]
    return ranked, [e for row in ranked[:1] for e in row.environments if e in ground]


def ranks_of(rows: Sequence[Row]) -> dict[str, float]:
    """Return mean ranks of competitors over the environments that all of them were run on.

    Of `RANKED`, the metrics that apply to every one of them: a policy that has no field to be asked
    for velocities does not rank last for it. A method without any score ranks last by all. Those
    that `common_ground` leaves out have no rank.
    """
    rows, ground = common_ground(rows)
    if not rows:
        return {}
    ranks = [
        mean_ranks(
            np.stack([row.run_means(metric, ground) for row in rows]), get_metric(metric).better
        )
        for metric in RANKED[rows[0].motion]
        if (scored := [row for row in rows if row.n_scored])
        and all(row.applies(metric) for row in scored)
    ]
    means = np.mean(ranks, axis=0) if ranks else np.full(len(rows), np.nan)
    return {row.method: float(mean) for row, mean in zip(rows, means, strict=True)}


def make_boards(results: Iterable[Result]) -> list[Board]:
    """Return a board for each family and protocol that has results.

    Families in the order of `FAMILIES`, then by name; reproduction before generalisation.
    """
    groups: dict[tuple[str, str], list[Result]] = {}
    for result in results:
        groups.setdefault((result.family, result.protocol), []).append(result)
    known = list(FAMILIES)

    def order(key: tuple[str, str]) -> tuple[int, str, bool]:
        family, protocol = key
        place = known.index(family) if family in known else len(known)
        return place, family, protocol != "reproduction"

    return [_board(*key, groups[key]) for key in sorted(groups, key=order)]


def _board(family: str, protocol: str, results: Sequence[Result]) -> Board:
    came = sorted({result.environment for result in results})
    known = FAMILIES.get(family, ())
    environments = (*known, *(e for e in came if e not in known))
    motion = motion_of(results)
    rows = [
        _row(environments, [r for r in results if r.method == method], motion)
        for method in sorted({result.method for result in results})
    ]
    ranks = ranks_of([row for row in rows if row.competes])
    rows.sort(
        key=lambda row: (row.reference, row.uses_time, ranks.get(row.method, np.inf), row.method)
    )
    return Board(family, protocol, environments, motion, tuple(rows))


def motion_of(results: Iterable[Result]) -> Motion:
    """Return the kind of motion that records are of: their metrics tell."""
    names = [set(result.metrics) for result in results]
    kinds: tuple[Motion, ...] = ("drumming", "cycle")  # drumming has the metrics of a cycle, too
    for motion in kinds:
        if any({metric.name for metric in metrics_of(motion)} <= own for own in names):
            return motion
    return "goal"


def _row(environments: tuple[str, ...], results: Sequence[Result], motion: Motion) -> Row:
    first = results[0]
    return Row(
        method=first.method,
        title=first.title,
        reference=first.reference,
        uses_time=first.uses_time,
        environments=environments,
        seeds=tuple(sorted({result.seed for result in results})),
        cells={(result.environment, result.seed): result for result in results},
        motion=motion,
    )
