"""Checks a submission: its files, what made them, and some of its scores, made again."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from iflow_gym.baselines.registry import METHODS, UnknownNameError
from iflow_gym.baselines.runner.fingerprint import method_code
from iflow_gym.baselines.runner.plan import family
from iflow_gym.leaderboard.contradictions import Contradiction, examine
from iflow_gym.leaderboard.records import label, read_records, wrong_with
from iflow_gym.leaderboard.rescoring import (
    differences,
    evaluate_again,
    load_model,
    tolerance_for,
)
from iflow_gym.leaderboard.submission import Submission, SubmissionError, read_submission
from iflow_gym.registration import POINT_MASS_ID, registered_ids
from iflow_gym.results import Result

N_CELLS = 3
"""Cells that are scored again where no other number is asked for."""

N_SUSPECTS = 3
"""Cells beyond these whose own records speak against a proof: each is scored again, too."""

STATES_SHOWN = 2
"""States of a cell that contradict a proof in one way and are told, with where each leads."""

MOST_SHOWN = 5
"""Differences of one cell that are told one by one."""

Verdict = Literal["ok", "note", "unchecked", "refused"]


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at."""

    what: str
    verdict: Verdict
    text: str


@dataclass
class Report:
    """What a check found."""

    folder: Path
    seed: int
    """By which cells were chosen: the same seed chooses the same ones."""
    findings: list[Finding] = field(default_factory=list)

    def add(self, what: str, verdict: Verdict, text: str) -> None:
        """Add a finding."""
        self.findings.append(Finding(what, verdict, text))

    @property
    def status(self) -> int:
        """0 where all is well, 1 where something is refused, 2 where something was not checked."""
        verdicts = {finding.verdict for finding in self.findings}
        return 1 if "refused" in verdicts else 2 if "unchecked" in verdicts else 0


def check(
    folder: Path, *, n_cells: int = N_CELLS, seed: int | None = None, trust: bool = False
) -> Report:
    """Check the submission in a folder: a ``method.toml``, records and models.

    Parameters
    ----------
    folder
        Named as the method; `iflow_gym.leaderboard.submission` says what belongs there.
    n_cells
        How many cells are scored again from their models, chosen at random among those with scores.
        Cells that claim a proof and record a divergence, a spurious attractor or a growing Lyapunov
        function are scored again beside them, a few. 0 looks at files alone.
    seed
        Of the choice; None takes one that nobody can foresee. The report names it.
    trust
        Whether to import a class from outside the suite, which runs its author's code with this
        user's rights. Without, its cells are not scored again.

    Raises
    ------
    FileNotFoundError
        If there is no such folder.
    ValueError
        If `n_cells` is negative.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"Expected the folder of a submission at {folder}, got none.")
    if n_cells < 0:
        raise ValueError(f"Expected to score 0 cells or more again, got {n_cells}.")
    chosen_seed = int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else seed
    folder = folder.resolve()
    report = Report(folder, chosen_seed)
    submission = _check_description(report)
    records = _check_records(report, submission)
    _check_again(report, records, n_cells, trust=trust)
    return report


def _check_description(report: Report) -> Submission | None:
    try:
        submission = read_submission(report.folder)
    except SubmissionError as error:
        report.add("method.toml", "refused", str(error))
        return None
    if submission.name != report.folder.name:
        report.add(
            "method.toml",
            "refused",
            f"expected the name of its folder, {report.folder.name!r}, got {submission.name!r}",
        )
    else:
        text = f"{submission.title}, guarantee {submission.guarantee}"
        report.add("method.toml", "ok", text)
    return submission


def _check_records(report: Report, submission: Submission | None) -> list[Result]:
    """Return the records that nothing is wrong with."""
    before = len(report.findings)
    records = read_records(report.folder, lambda text: report.add("files", "refused", text))
    if not records and len(report.findings) == before:
        report.add("files", "refused", "expected records, got none")
    targets = sorted({str(result.target) for result in records})
    if len(targets) > 1:
        text = f"expected one class in all records, got {', '.join(targets)}"
        report.add("records", "refused", text)
    good: list[Result] = []
    for result in records:
        wrong = list(wrong_with(result, submission, report.folder))
        for text in wrong:
            report.add(label(result), "refused", text)
        if not wrong:
            good.append(result)
    if records and len(report.findings) == before:
        failed = [result for result in good if not result.ok]
        text = f"{len(records)} whole and plausible, by this suite's metrics, data and evaluation"
        report.add("records", "ok", text)
        if len(failed) == len(records):
            report.add("records", "refused", "expected scores, got failed cells alone")
        elif failed:
            report.add("records", "note", f"{len(failed)} of them are of cells that failed")
        note_extent(report, records)
    return [result for result in good if result.ok]


def note_extent(report: Report, records: list[Result]) -> None:
    """Note families that are there in part, and records of the smoke preset."""
    all_of = Counter(family(i) for i in registered_ids() if i != POINT_MASS_ID)
    came = Counter(f for f, _ in {(r.family, r.environment) for r in records})
    for name, n in sorted(came.items()):
        if n < all_of[name]:
            text = f"of {name}, {n} of {all_of[name]} environments: the row will be incomplete"
            report.add("records", "note", text)
    if n_smoke := sum(result.preset == "smoke" for result in records):
        text = f"{n_smoke} of {len(records)} are of the smoke preset, which is a trial: run the "
        text += "standard preset with --force"
        report.add("records", "note", text)


def _check_again(report: Report, records: list[Result], n_cells: int, *, trust: bool) -> None:
    if n_cells == 0:
        return
    rng = np.random.default_rng(report.seed)
    order = rng.permutation(len(records))
    chosen = [records[i] for i in sorted(order[:n_cells].tolist())]
    suspects = [records[i] for i in order[n_cells:] if _speaks_against_itself(records[i])]
    chosen += suspects[:N_SUSPECTS]
    for result in chosen:
        if not (trust or result.reference or result.target == METHODS.get(result.method)):
            report.add(
                "scores",
                "unchecked",
                f"{result.target} is no class of the suite: to score it again is to run its code. "
                "Read it, or use a machine that has nothing to lose, and pass --trust.",
            )
            return
    for result in chosen:
        for finding in _again(result, report.folder):
            report.findings.append(finding)


def _speaks_against_itself(result: Result) -> bool:
    names = ("diverged", "spurious_attractors", "lyapunov_violation")
    seen = any(result.metrics.get(name) for name in names)
    return _proved(result) and (seen or result.metrics.get("converged") == 0)


def _proved(result: Result) -> bool:
    return result.guarantee is not None and result.guarantee.kind == "proved"


def _again(result: Result, folder: Path) -> Iterator[Finding]:
    """Score a cell again; whatever its class raises is a finding, too."""
    what = label(result)
    tolerance, why = tolerance_for(result)
    try:
        module = str(result.target).partition(":")[0]
        if method_code(module).sha256 != result.hashes.get("code"):
            yield Finding(what, "note", "made by another version of its method's code than is here")
        system = None if result.reference else load_model(result, folder)
        found = evaluate_again(result, system)
        other = list(differences(result, found, tolerance))
        for text in other[:MOST_SHOWN]:
            yield Finding(what, "refused", text)
        if len(other) > MOST_SHOWN:
            yield Finding(what, "refused", f"and {len(other) - MOST_SHOWN} more")
        if not other:
            text = f"scored again: the same to {tolerance.relative:g} ({why})"
            yield Finding(what, "ok", text)
        if system is None:
            return
        said = result.guarantee
        if said is None or system.guarantee.kind != said.kind:
            text = f"the model claims {system.guarantee.kind!r}, its record {said and said.kind!r}"
            yield Finding(what, "refused", text)
        elif system.guarantee != said:
            yield Finding(what, "note", "its class gives another reason for its guarantee by now")
        if "proved" in (system.guarantee.kind, getattr(result.guarantee, "kind", None)):
            told: Counter[str] = Counter()
            for against in examine(system, result.environment, result.seed, found.metrics):
                if not isinstance(against, Contradiction):
                    yield Finding(what, "note", str(against))
                    continue
                told[against.what] += 1
                if told[against.what] <= STATES_SHOWN:
                    yield Finding(what, "refused", f"claimed proved, but it {against}")
            for kind, n in told.items():
                if n > STATES_SHOWN:
                    text = f"{kind}: from {n - STATES_SHOWN} more states"
                    yield Finding(what, "refused", text)
    except UnknownNameError as error:
        yield Finding(what, "unchecked", str(error))
    except Exception as error:
        yield Finding(
            what, "refused", f"could not be scored again: {type(error).__name__}: {error}"
        )
