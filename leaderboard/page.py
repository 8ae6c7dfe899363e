"""LEADERBOARD.md: tables that GitHub renders without scrolling, and what their numbers mean."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import get_args

from board import MAIN, RANKED, Board, Row, common_ground, motion_of
from classes import confusion, fraction_right
from comparisons import compared, improvements, rank_comparison, ranked
from records import origin, unscored, versions_of
from tables import (
    BY_MEAN,
    Aggregates,
    aggregate_table,
    aggregates,
    escaped,
    guarantee_of,
    outside,
    percent,
    rank_of,
    reward_of,
    shape_name,
    shape_table,
    shown,
    table,
)

from iflow_gym.baselines.registry import METHODS, REFERENCES
from iflow_gym.leaderboard.submission import Submission
from iflow_gym.metrics import METRICS, Motion, get_metric, metrics_hash, metrics_of
from iflow_gym.results import Result
from iflow_gym.statistics import Improvement, RankComparison

ACCURACY = RANKED
"""Columns of the accuracy tables."""

STABILITY: dict[Motion, tuple[str, ...]] = {
    "goal": (
        "converged",
        "spurious_attractors",
        "diverged",
        "perturbation_recovery",
        "lyapunov_violation",
        "settling_time",
    ),
    "cycle": ("attraction", "diverged", "perturbation_recovery", "lyapunov_violation"),
    "drumming": ("attraction", "diverged", "perturbation_recovery", "lyapunov_violation"),
}
"""Columns of the stability table, after the guarantee."""

COST = ("fit_seconds", "fit_cpu_seconds", "step_us", "n_parameters", "peak_memory_mb")
"""Columns of the cost table."""

DENSITY = ("velocity_rmse", "nll_1", "nll_10")
"""Columns of the smaller table of what else is measured."""

BY_SHAPE: dict[Motion, tuple[str, ...]] = {
    "goal": ("frechet", "rmse", "dtw", "converged"),
    "cycle": ("orbit_hausdorff", "orbit_distance", "period_error", "attraction"),
    "drumming": ("rhythm_f1", "hit_f1", "period_error", "attraction"),
}
"""Metrics that are tabled shape by shape."""

SMALL = ("frechet", "rmse", "dtw", "seds_error", "converged", "spurious_attractors")
"""Columns of a family that is reported beside the headline, in one table."""

MEMORY = (
    "Memory is the rise of the worker's resident memory during the fit, above what it held before; "
    "a batch's is shared by its cells."
)
"""What `peak_memory_mb` of a record is."""

RESIDUAL = "residual"
"""Preset in the records of `baselines/residual.py`."""

NOTE_LENGTH = 200
"""Characters of the longest note on a method that is in the page."""

HEADLINE = "LASA-26"
"""The family that the figures of all methods are of."""

BESIDE = ("LASA-Multi",)
"""Families that have one table, beside the headline's."""

PROTOCOLS = {
    "reproduction": "fitted on all demonstrations that are shown, and scored on them",
    "generalisation": "fitted on demonstrations 1-4 of LASA's seven and scored on 5-7; of a "
    "letter's twenty on 1-10 and 11-20; of the six of drumming on 1-3 and 4-6",
}

KINDS: dict[Motion, str] = {
    "goal": "of motions that end",
    "cycle": "of motions that repeat",
    "drumming": "of drumming",
}
"""Kinds of motion, in words."""

WHAT = {
    "LASA-26": "handwriting motions, each in one way",
    "LASA-Multi": "handwriting motions that are done in several ways",
    "Letter": "letters that are traced round and round, limit cycles in the plane",
    "Disturbed": "handwriting motions that a mass of unknown weight is to draw in a wind",
    "Drumming": "arm that drums in MuJoCo, scored on the tip that the physics moved",
    "LetterRecorded": "letters that ImitationFlow's authors recorded, limit cycles in the plane",
}
"""What the motions of a family are."""

NOTES = {
    ("LASA-Multi", "generalisation"): "These shapes hold two or three motions, one after another, "
    "so that the recordings scored here are of motions that hardly any fitted one shows: the "
    "numbers say what a method makes of unseen places, not how well it learned.",
}
"""What a reader of a family's table under a protocol must know."""


# Notes --------------------------------------------------------------------------------------


def footnote(board: Board, found: Aggregates) -> str:
    """Say what the intervals are intervals of, and where cells are missing."""
    drawn = {a.resampled for a in found.values() if a is not None} - {"nothing"}
    what = {
        "environments": "with one seed they resample the shapes, and say how much the choice of "
        "shapes matters",
        "seeds": "with several seeds they resample the seeds within each shape, and say how much "
        "the seed matters",
    }
    who = {
        name: sorted(
            escaped(row.title)
            for row in board.rows
            if any(
                (a := found[row.method, m.name]) is not None and a.resampled == name
                for m in metrics_of(board.motion)
            )
        )
        for name in ("environments", "seeds")
    }
    if drawn == {"environments"}:
        text = f"Intervals are 95 % bootstrap intervals: {what['environments']}."
    elif drawn == {"seeds"}:
        text = f"Intervals are 95 % bootstrap intervals: {what['seeds']}."
    elif not drawn:
        text = "There are no intervals: one score is nothing to resample."
    else:
        text = (
            f"Intervals are 95 % bootstrap intervals: {what['environments']} "
            f"({', '.join(who['environments'])}); {what['seeds']} ({', '.join(who['seeds'])}). The "
            "two kinds are not to be compared."
        )
    incomplete = [row for row in board.rows if not row.complete]
    if incomplete:
        text += " Incomplete: " + "; ".join(
            f"{escaped(row.title)} {row.coverage} "
            f"({len(row.failed)} failed, {row.n_never_run} never run)"
            for row in incomplete
        )
        text += (
            ". An incomplete row is aggregated over the cells it has, ranks last where it failed, "
            "and competes for the bold value only with rows as full."
        )
    rows, ground = common_ground(board.competitors)
    if rows and len(ground) < len(board.environments):
        text += (
            f" Mean ranks are over {len(ground)} of {len(board.environments)} environments, those "
            "that all ranked methods were run on."
        )
    return text + not_ranked(board.competitors, rows)


def not_ranked(rows: Sequence[Row], ranked: Sequence[Row]) -> str:
    """Say which rows are not ranked, and why, with a space before; nothing where all are."""
    names = {row.method for row in ranked}
    left = [
        f"{escaped(row.title)} (on {len(row.ran)} of {len(row.environments)} environments)"
        for row in rows
        if row.method not in names
    ]
    if not left:
        return ""
    return f" Not ranked, since run on too few of the others' environments: {'; '.join(left)}."


def failures(boards: Sequence[Board]) -> list[str]:
    """Return the section of cells that have no scores."""
    lines = [
        [f"{escaped(row.title)} on {group.names}, {board.protocol}", _one_line(group.reason)]
        for board in boards
        for row in board.rows
        for group in unscored(row)
        if group.reason
    ]
    never = [
        f"- {escaped(row.title)}: {row.n_never_run} of {row.n_expected} cells of {board.family}, "
        f"{board.protocol}, were never run."
        for board in boards
        for row in board.rows
        if row.n_never_run
    ]
    page = ["## Cells without scores", ""]
    if not lines and not never:
        return [*page, "None: every cell has scores.", ""]
    if lines:
        page += table(["Cell", "Reason"], lines)
    return page + ([*never, ""] if never else [])


def _one_line(reason: str) -> str:
    return escaped(reason.splitlines()[0])


SMOKE = (
    "the smoke preset, in which methods of the suite are fitted in a few steps. They say that "
    "everything runs, and are no scores to quote."
)
"""What records of this preset are."""


def warnings_about(results: Sequence[Result]) -> list[str]:
    """Return what makes the records hard to compare, one sentence each."""
    found: list[str] = []
    for motion in get_args(Motion):
        alike = [r for r in results if r.ok and motion_of([r]) == motion]
        current = metrics_hash(motion)
        counts = Counter(r.hashes.get("metrics", "none") for r in alike)
        if len(counts) > 1:
            found.append(
                "The records were scored by different versions of the metrics: "
                f"{_counted(counts)}. Their numbers do not mean the same until "
                "`python baselines/run_all.py` is run again."
            )
        elif counts and set(counts) != {current}:
            found.append(
                f"The records were scored by metrics of hash {next(iter(counts))[:12]}, this "
                f"checkout has {current[:12]}; run `python baselines/run_all.py` again."
            )
    for label, what in (("core", "the suite's code"), ("data", "the data of one environment")):
        per: dict[str, set[str | None]] = {}
        for r in results:
            if r.ok:
                per.setdefault(r.environment, set()).add(r.hashes.get(label))
        if any(len(entries) > 1 for entries in per.values()):
            found.append(f"The records were made with different versions of {what}.")
    found += _mixed_rows([r for r in results if r.ok])
    for library in sorted({name for r in results for name in r.versions}):
        used = sorted({r.versions[library] for r in results if library in r.versions})
        if len(used) > 1:
            found.append(f"The records were made with different versions of {library}: {used}.")
    found += _mixed_presets(results)
    n_smoke = sum(r.preset == "smoke" for r in results)
    if n_smoke == len(results) > 0:
        found.append(f"This is a trial: all its records are of {SMOKE}")
    elif n_smoke:
        found.append(f"{n_smoke} of the {len(results)} records are of a trial, {SMOKE}")
    if len({str(r.hardware.get("cpu")) for r in results}) > 1:
        found.append("The records were made on different processors: costs do not compare.")
    return found


def _mixed_presets(results: Sequence[Result]) -> list[str]:
    """Say which methods have other settings in one preset than in another, if any.

    Where they have the same in all, a preset is no more than how many seeds were run.
    """
    settings: dict[tuple[str, str], dict[str, set[str]]] = {}
    for r in results:
        per_preset = settings.setdefault((escaped(r.title), r.family), {})
        per_preset.setdefault(r.preset, set()).add(r.hashes.get("config", "none"))
    found: dict[str, set[str]] = {}
    for (title, _), per_preset in settings.items():
        if len({frozenset(configs) for configs in per_preset.values()}) > 1:
            found.setdefault(title, set()).update(per_preset)
    return [
        f"The records of {title} are of presets with different settings: "
        f"{', '.join(sorted(presets))}; its details say which."
        for title, presets in sorted(found.items())
    ]


def _mixed_rows(results: Sequence[Result]) -> list[str]:
    """Say which methods' rows are of different code, or of different settings in one preset.

    A row is of one family and one protocol: that another row is of other code mixes nothing.
    """
    groups: dict[tuple[str, str, str], Counter[str]] = {}
    for r in results:
        row = f"{r.family}, {r.protocol}"
        for label, where in (("code", row), ("config", f"{r.preset} on {row}")):
            key = (escaped(r.title), label, where)
            groups.setdefault(key, Counter())[r.hashes.get(label, "none")] += 1
    what = {"code": "versions of its code on", "config": "settings in the preset"}
    return [
        f"The records of {title} were made with different {what[label]} {where}: "
        f"{_counted(counts)}. That row mixes them until all of it is run again."
        for (title, label, where), counts in sorted(groups.items())
        if len(counts) > 1
    ]


def _counted(counts: Counter[str]) -> str:
    """Return how many cells each version made, the most first."""
    return ", ".join(
        f"{n} {'cell' if n == 1 else 'cells'} by {name[:12]}"
        for name, n in sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    )


def contradictions(board: Board) -> list[str]:
    """Return where a method states a proof and measurements say otherwise, a sentence for each."""
    found = []
    for row in board.competitors:
        cells = [
            c
            for c in row.cells.values()
            if c.guarantee is not None and c.guarantee.kind == "proved"
        ]
        for metric, held, says in (
            ("diverged", 0.0, "starts ran away"),
            ("converged", 1.0, "not every start converged within the horizon"),
            ("attraction", 1.0, "not every start was attracted within the horizon"),
            ("lyapunov_violation", 0.0, "its Lyapunov function does not fall everywhere"),
        ):
            better = get_metric(metric).better
            values = [
                (value, shape_name(cell.environment))
                for cell in cells
                if (value := cell.metrics.get(metric)) is not None and value != held
            ]
            if values:
                value, where = (min if better == "higher" else max)(values)
                found.append(
                    f"{escaped(row.title)} states a *proved* guarantee, but {says} in "
                    f"{len(values)} of {len(cells)} cells: {get_metric(metric).title.lower()} is "
                    f"{shown(metric, value)} % on {where}, the worst."
                )
    return found


# The page -----------------------------------------------------------------------------------


def render(
    boards: Sequence[Board],
    results: Sequence[Result],
    figures: Mapping[str, str],
    units: Mapping[str, str],
    submissions: Mapping[str, Submission],
) -> str:
    """Return the page.

    Parameters
    ----------
    boards
        From `make_boards`.
    results
        The records that the boards are of.
    figures
        Name to path relative to the page, of the figures that were drawn.
    units
        Family to its unit of length.
    submissions
        What methods' folders say of them, by the methods' names.
    """
    page = ["# Leaderboard", ""]
    page += [
        "Methods that learn a motion from demonstrations, scored on the same ground. Lower is "
        "better, but for "
        + ", ".join(f"*{m.title.lower()}*" for m in METRICS if m.better == "higher")
        + " and *classification*. **Bold** is the best value among the "
        "competitors; rows in *italics* are references and do not compete: *nearest demonstration* "
        "is how far the recordings are from each other, *replay* plays the recording back, once: "
        "on the arm two rounds of the eight in which a rhythm is heard. Rows "
        "marked *uses time* follow a clock that was started with the motion: they are no field, so "
        "that what is asked of a field is – there, and are no competitors either.",
        "",
        "The same in one page to sort, filter and look into, with every score of every motion: "
        "[`index.html`](index.html), for a browser.",
        "",
        "Written by `python leaderboard/build.py` from the records in "
        "[`results/`](results); do not edit.",
        "",
    ]
    page += warning(warnings_about(results))
    page += _pictures(figures, ("accuracy-stability",))
    for board in boards:
        full = board.family not in BESIDE
        page += board_section(board, units.get(board.family, "length"), full=full)
        if board.family == HEADLINE and board.protocol == "reproduction":
            page += comparison_section(board, figures)
            page += _pictures(figures, ("boxes", "accuracy-fit-time", "methods", "fields"))
        if board.protocol == "generalisation":
            page += _pictures(figures, (f"{board.family}-classes",))
        else:
            page += _pictures(figures, (f"{board.family}-fields",))
    page += shapes_section(boards)
    page += failures(boards)
    page += about(results, boards, units)
    page += origins(submissions)
    return "\n".join(page).rstrip() + "\n"


def comparison_section(board: Board, figures: Mapping[str, str]) -> list[str]:
    """Return which competitors can be told apart, and how sure that is."""
    found = improvements(board)
    if not found:
        return []
    title = get_metric(MAIN[board.motion]).title
    page = [f"### Differences between methods, by {title}", ""]
    if (comparison := rank_comparison(board)) is not None:
        page += [ranks_in_words(board, comparison), "", *_pictures(figures, ("ranks",))]
    rows = compared(board)
    page += [improvement_in_words(found), ""]
    lines = [
        [
            escaped(one.title),
            *(
                percent_of(pair) if (pair := found.get((one.method, other.method))) else ""
                for other in rows
            ),
        ]
        for one in rows
    ]
    page += table(["Method", *(escaped(row.title) for row in rows)], lines)
    return page + _pictures(figures, ("profile",))


def percent_of(found: Improvement) -> str:
    """Return a probability of improvement in percent, its interval below it."""
    low, high = (f"{100 * end:.0f}" for end in found.interval)
    text = f"{100 * found.probability:.0f}"
    return text if low == high or "nan" in low else f"{text}<br><sub>{low} to {high}</sub>"


def ranks_in_words(board: Board, comparison: RankComparison) -> str:
    """Say what the tests of ranks say."""
    p = comparison.p_value
    return (
        f"Friedman's test over the {comparison.n_environments} environments that all its methods "
        "were run on, the mean over the seeds in each (seeds are no data sets of their own): "
        f"chi² = {comparison.statistic:.1f}, p {'< 0.001' if p < 0.001 else f'= {p:.3f}'}. Mean "
        f"ranks further apart than {comparison.critical_difference:.2f} differ by Nemenyi's test "
        f"at {100 * comparison.alpha:.0f} % (Demšar 2006)."
        f"{not_ranked(compared(board), ranked(board)[0])}"
    )


def improvement_in_words(found: Mapping[tuple[str, str], Improvement]) -> str:
    """Say what the table of probabilities is."""
    drawn = {entry.resampled for entry in found.values()} - {"nothing"}
    what = {
        "seeds": "resample the seeds within each environment where a method of the pair has "
        "several",
        "environments": "resample the environments where neither has",
    }
    said = " and ".join(what[name] for name in ("seeds", "environments") if name in drawn)
    return (
        "Probability (%) that a run of the row's method is better than one of the column's on an "
        "environment drawn at random that both were run on, a tie counting half and a failed cell "
        "as the worst; cells that were never run are left out (Agarwal et al. 2021)"
        + (f"; 95 % bootstrap intervals {said}." if said else ".")
    )


CAPTIONS = {
    "ranks": "Mean ranks over the environments, 1 is best: methods under one bar cannot be told "
    "apart at 5 %.",
    "profile": "Share of a method's cells, of those that were run, that are as good as the value "
    "on the x axis or better; a curve further up and to the left is better, and what failed keeps "
    "it below 100 %. Bands are 95 % bootstrap intervals.",
    "accuracy-stability": "Accuracy against stability on LASA-26, reproduction: to the upper left "
    "a method follows the demonstrations and ends where they end. Bars are 95 % intervals.",
    "boxes": "The four measures of the ImitationFlow paper's figure 3 over the LASA-26 shapes, a "
    "point for each shape; the dashed line is the median distance between the demonstrations.",
    "accuracy-fit-time": "Accuracy against the time to fit, LASA-26, reproduction.",
    "methods": "One shape by every method: demonstrations in orange, reproductions in green, "
    "streamlines of the learned field in blue; what uses time has none.",
    "fields": "Every shape, as learned by ImitationFlow: demonstrations in orange, rollouts from "
    "their starts in green.",
    "Letter-fields": "Every letter by every method: demonstrations in orange, rollouts from places "
    "around in green, streamlines of the learned field in blue; what uses time has none.",
    "LetterRecorded-fields": "Every recorded letter by every method, as above.",
    "Letter-classes": "Which letter the unseen demonstrations are taken for, argmax_k p(tau | k) "
    "over the four letters' models, all seeds.",
}
"""By name of the figure."""


def warning(notes: Sequence[str]) -> list[str]:
    """Return sentences in a box that GitHub colours; nothing for none."""
    return ["> [!WARNING]", *(f"> - {note}" for note in notes), ""] if notes else []


def _pictures(figures: Mapping[str, str], names: Sequence[str]) -> list[str]:
    lines: list[str] = []
    for name in names:
        if name in figures:
            lines += [f"![{CAPTIONS[name]}]({figures[name]})", "", f"*{CAPTIONS[name]}*", ""]
    return lines


def board_section(board: Board, length_unit: str, *, full: bool) -> list[str]:
    """Return a board's tables: all of them, or one for a family beside the headline."""
    found = aggregates(board)
    page = [f"## {board.family}: {board.protocol}", ""]
    n, what = len(board.environments), WHAT.get(board.family, "motions")
    page += [f"{n} {what}; {PROTOCOLS[board.protocol]}.", ""]
    if note := NOTES.get((board.family, board.protocol)):
        page += [note, ""]
    page += warning(contradictions(board))
    first = {
        "Mean rank": lambda row: rank_of(board, row),
        "Cells": lambda row: row.coverage,
    }
    if any(row.reward() is not None for row in board.rows):
        first["Reward a step"] = reward_of
    if not full:
        guarantee = {**first, "Guarantee": guarantee_of}
        page += aggregate_table(board, found, SMALL, length_unit, extra=guarantee)
        return [*page, f"<sub>{_statistics(SMALL)} {footnote(board, found)}</sub>", ""]
    accuracy, stability = ACCURACY[board.motion], STABILITY[board.motion]
    page += ["### Accuracy", "", "Interquartile mean over the shapes:", ""]
    page += aggregate_table(board, found, accuracy, length_unit, statistic="iqm", extra=first)
    page += ["Mean over the shapes:", ""]
    page += aggregate_table(board, found, accuracy, length_unit, statistic="mean")
    page += classification(board)
    page += [f"<sub>{footnote(board, found)}</sub>", ""]
    page += ["### Stability", ""]
    page += aggregate_table(
        board, found, stability, length_unit, extra={"Guarantee": guarantee_of}, references=False
    )
    page += [f"<sub>{_statistics(stability)}</sub>", ""]
    page += ["### Velocities and densities", ""]
    page += aggregate_table(board, found, DENSITY, length_unit, references=False)
    page += [f"<sub>{_statistics(DENSITY)}</sub>", ""]
    page += ["### Cost", ""]
    page += aggregate_table(board, found, COST, length_unit, references=False)
    page += [f"<sub>{_statistics(COST)} {MEMORY} {_batches(board)}</sub>", ""]
    return page + not_applicable(board)


def classification(board: Board) -> list[str]:
    """Return how well models tell the family's motions apart; nothing where none has densities."""
    lines = []
    for row in board.methods:
        counts = confusion(row)
        if counts is not None:
            right = [escaped(row.title), percent(fraction_right(counts)), str(int(counts.sum()))]
            lines.append(right)
    if not lines:
        return []
    page = ["Taken for what they are, argmax_k p(tau | k) over the family's models:", ""]
    return page + table(["Method", "Classification (%)", "Trajectories"], lines)


def not_applicable(board: Board) -> list[str]:
    """Return which registered methods cannot learn the board's motions, and why."""
    lines = [[escaped(title), "not applicable", escaped(why)] for title, why in outside(board)]
    return table(["Method", "Guarantee", "Reason"], lines) if lines else []


def _statistics(metrics: Sequence[str]) -> str:
    """Say which statistic the columns of a table are."""
    means = [get_metric(m).title for m in metrics if m in BY_MEAN]
    if not means:
        return "Interquartile means over the shapes."
    return f"Means over the shapes: {', '.join(means)}. Interquartile means: the others."


def _batches(board: Board) -> str:
    together = []
    for row in board.rows:
        sizes = [float(c.fit.get("batch_size") or 1) for c in row.cells.values() if c.ok]
        if sizes and max(sizes) > 1:
            together.append(f"{escaped(row.title)} (up to {max(sizes):.0f} together)")
    if not together:
        return ""
    return (
        "A method that fits several shapes together counts each shape's share of the time: "
        f"{', '.join(together)}."
    )


def shapes_section(boards: Sequence[Board]) -> list[str]:
    """Return every shape's own numbers, folded."""
    page = ["## Shape by shape", ""]
    for board in boards:
        for metric in BY_SHAPE[board.motion]:
            title = f"{board.family}, {board.protocol}: {get_metric(metric).title}"
            page += [f"<details><summary>{title}</summary>", "", *shape_table(board, metric)]
            page += ["</details>", ""]
    return page


def about(
    results: Sequence[Result], boards: Sequence[Board], units: Mapping[str, str]
) -> list[str]:
    """Return what the numbers mean and how to make them again."""
    page = ["## About these numbers", ""]
    page += [f"- **{name}**: {what}." for name, what in PROTOCOLS.items()]
    page += [
        "- **Integration**: the environment is the judge. A policy gives a velocity command that "
        "the environment holds for one sample time of the demonstration: "
        + _times(results)
        + ". A method whose flow is exact commands the velocity that leads to its own next state.",
        "- **Units**: " + "; ".join(f"{f} lengths in {u}" for f, u in units.items()) + ".",
        "- **Aggregates**: the interquartile mean is the mean of the middle half of the scores. A "
        "score of ∞ is a runaway and counts. The mean rank is taken over environments and, "
        + "; ".join(
            f"{KINDS[motion]}, over " + ", ".join(get_metric(m).title for m in names)
            for motion, names in RANKED.items()
        )
        + ", those that apply to every competitor; a cell that failed ranks last, and "
        "environments that not all ranked methods were run on are left out.",
        "- **Guarantee**: *proved* by construction for every state, *verified* on a bounded region "
        "with an error bound, *sampled* where it was tried, or *none*. The methods' own "
        "reasons, as given for the first shape:",
    ]
    page += [f"  - {reason}" for reason in _reasons(boards)]
    page += [
        f"- **Preset**: {', '.join(sorted({r.preset for r in results}))}; records made "
        + _span(r.created for r in results)
        + ".",
        "- **Metrics**: hash "
        + ", ".join(f"`{h[:16]}`" for h in sorted({r.hashes.get("metrics", "") for r in results}))
        + ", over the code that computes them.",
        "- **Hardware**: " + "; ".join(_hardware(results)) + ".",
        "- **Versions**: " + versions_of(results) + ".",
        "",
        "To make these numbers again:",
        "",
        "```console",
        "$ pip install -c constraints.txt -e .",
        *_commands(results),
        "$ python leaderboard/build.py",
        "```",
        "",
        "<details><summary>What each number is</summary>",
        "",
    ]
    definitions = [[m.title, m.unit, m.better, escaped(m.definition)] for m in METRICS]
    page += table(["Metric", "Unit", "Better", "Definition"], definitions)
    return [*page, "</details>", ""]


def origins(submissions: Mapping[str, Submission]) -> list[str]:
    """Return where each method comes from, folded; long notes are in index.html alone."""
    if not submissions:
        return []
    page = ["<details><summary>Where each method comes from</summary>", ""]
    for one in sorted(submissions.values(), key=lambda one: one.title.lower()):
        said = []
        for term, text, *address in origin(one):
            if term == "Note" and len(text) > NOTE_LENGTH:
                continue
            words = f"[{escaped(text)}](<{address[0]}>)" if address else escaped(text)
            said.append(f"{term.lower()}: {words.rstrip('.')}")
        page.append(f"- **{escaped(one.title)}**, {'; '.join(said)}.")
    return [*page, "", "</details>", ""]


def _times(results: Sequence[Result]) -> str:
    dts = [result.dt for result in results if result.dt is not None]
    spread = f"{min(dts) * 1000:.1f} to {max(dts) * 1000:.1f} ms" if dts else "not recorded"
    integrators: dict[str, set[str]] = {}
    for result in results:
        if result.integrator is not None:
            integrators.setdefault(result.integrator, set()).add(escaped(result.title))
    kinds = "; ".join(f"{k}: {', '.join(sorted(v))}" for k, v in sorted(integrators.items()))
    return f"{spread}, by shape ({kinds or 'integrators not recorded'})"


def _reasons(boards: Sequence[Board]) -> list[str]:
    """Return each method's reason, from the first cell that states one."""
    reasons: dict[str, str] = {}
    for board in boards:
        for row in board.methods:
            for cell in row.cells.values():
                if cell.guarantee is not None:
                    text = escaped(cell.guarantee.reason).rstrip(".")
                    title = escaped(row.title)
                    reasons.setdefault(title, f"{title}, *{cell.guarantee.kind}*: {text}.")
    return [reasons[title] for title in sorted(reasons)]


def _span(created: Iterable[str]) -> str:
    days = sorted(stamp[:10] for stamp in created)
    return days[0] if days[0] == days[-1] else f"{days[0]} to {days[-1]}"


def _hardware(results: Sequence[Result]) -> list[str]:
    return sorted(
        {
            escaped(
                f"{h.get('cpu')}, {h.get('cores')} cores, {h.get('threads')} thread(s) a fit, "
                f"{h.get('platform')}"
            )
            for h in (result.hardware for result in results)
        }
    )


def _commands(results: Sequence[Result]) -> list[str]:
    """Return the run for each preset, naming the methods that are not in the registry."""
    known = {*METHODS, *REFERENCES}
    presets = {r.preset for r in results}
    runs = [r for r in results if r.preset != RESIDUAL]
    foreign = sorted({r.target or r.method for r in runs if r.method not in known})
    lines = [
        f"$ python baselines/run_all.py --preset {preset} --force"
        for preset in sorted(presets - {RESIDUAL})
    ]
    if foreign:
        lines.append(f"# and --methods {' '.join(foreign)}")
    if RESIDUAL in presets:
        bench = "$ python baselines/residual.py bench --force"
        lines.append(bench)
        if any(r.preset == RESIDUAL and r.family == "Drumming" for r in results):
            lines.append(f"{bench} --envs Drumming-v0 --preset drumming")
    return lines
