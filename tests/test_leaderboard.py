"""The leaderboard: what it says of results that are made up, so that the truth is known."""

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from leaderboard_records import failed, record, sweep
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text

from iflow_gym.baselines.linear import StableLinear
from iflow_gym.datasets.lasa import MULTI_MODELS, SINGLE_MOTIONS, load_lasa
from iflow_gym.figures import (
    PALETTE,
    Point,
    box_figure,
    method_styles,
    save_figure,
    scatter_figure,
)
from iflow_gym.leaderboard.submission import Submission
from iflow_gym.metrics import metrics_hash, metrics_of
from iflow_gym.plotting import GOAL
from iflow_gym.registration import lasa_id
from iflow_gym.results import write_result
from iflow_gym.system import Guarantee

LEADERBOARD = Path(__file__).parents[1] / "leaderboard"


def boards_of(builder, results):
    return builder.make_boards(results)


def render(builder, results, **submissions):
    boards = boards_of(builder, results)
    return builder.render(boards, results, {}, {"LASA-26": "mm"}, submissions)


def section(text, title, level="### "):
    """Return the part of a page under a heading."""
    start = text.index(level + title)
    end = text.find("\n" + level, start + 1)
    return text[start : end if end > 0 else None]


def rows_of(text):
    """Return the header of a text's first table, and its rows by their first column."""
    lines = text[text.index("\n|") + 1 :].split("\n\n")[0].splitlines()
    table = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]
    return table[0], {row[0].strip("*"): row for row in table[2:]}


# Boards -------------------------------------------------------------------------------------


def test_cells_never_run_count_as_missing(builder):
    (board,) = boards_of(builder, sweep("good", shapes=SINGLE_MOTIONS[:24]))
    (row,) = board.rows
    assert (row.n_scored, row.n_expected, row.coverage) == (24, 26, "24 of 26")
    assert row.n_never_run == 2
    assert row.aggregate("rmse").coverage == "24 of 26"


def test_three_seeds_make_three_times_as_many_cells(builder):
    results = [r for seed in range(3) for r in sweep("good", seed=seed)]
    (board,) = boards_of(builder, results)
    assert board.rows[0].coverage == "78 of 78"
    assert board.rows[0].aggregate("rmse").resampled == "seeds"


def test_a_failed_cell_ranks_last_and_stays(builder):
    results = sweep("good", 1.0) + sweep("bad", 2.0)
    (board,) = boards_of(builder, results)
    assert board.mean_rank == {"good": 1.0, "bad": 2.0}
    assert [row.method for row in board.rows] == ["good", "bad"]
    broken = [failed("good", s) for s in SINGLE_MOTIONS[:20]]
    broken += sweep("good", 1.0, shapes=SINGLE_MOTIONS[20:]) + sweep("bad", 2.0)
    (board,) = boards_of(builder, broken)
    assert board.mean_rank == pytest.approx({"good": (6 + 20 * 2) / 26, "bad": (12 + 20) / 26})
    assert [row.method for row in board.rows] == ["bad", "good"]
    assert len(board.rows[1].failed) == 20


def test_ranks_are_over_what_all_were_run_on(builder):
    """The worst on six shapes is no better for them, nor worse where it was never run."""
    results = sweep("good", 2.0) + sweep("late", 1.0, shapes=SINGLE_MOTIONS[6:])
    results += sweep("bad", 3.0)
    (board,) = boards_of(builder, results)
    assert board.mean_rank == {"late": 1.0, "good": 2.0, "bad": 3.0}
    assert [row.method for row in board.rows] == ["late", "good", "bad"]
    assert board.first == {"late"}
    page = render(builder, results)
    accuracy = section(page, "Accuracy")
    assert "Mean ranks are over 20 of 26 environments, those that all ranked methods" in accuracy
    assert "Not ranked" not in page
    header, rows = rows_of(accuracy)
    assert rows["Late"][header.index("Mean rank")] == "**1.00**"
    comparison = builder.comparisons.rank_comparison(board)
    assert comparison.n_environments == 20
    assert comparison.mean_ranks == pytest.approx([1.0, 2.0, 3.0])


def test_a_seed_that_was_never_run_costs_no_rank(builder):
    results = sweep("good", 1.0) + sweep("good", 1.0, shapes=SINGLE_MOTIONS[:3], seed=1)
    (board,) = boards_of(builder, results + sweep("bad", 2.0))
    assert board.mean_rank == {"good": 1.0, "bad": 2.0}
    results += [failed("good", s, seed=1) for s in SINGLE_MOTIONS[3:]]
    (board,) = boards_of(builder, results + sweep("bad", 2.0))
    assert board.mean_rank == pytest.approx({"good": (3 + 23 * 2) / 26, "bad": (6 + 23) / 26})


def test_what_was_run_on_too_little_is_not_ranked_and_named(builder):
    results = sweep("a", 1.0) + sweep("b", 2.0) + sweep("c", 3.0)
    results += sweep("few", 0.1, shapes=SINGLE_MOTIONS[:12])
    results += [failed("dead", s) for s in SINGLE_MOTIONS]
    (board,) = boards_of(builder, results)
    assert board.mean_rank == {"a": 1.0, "b": 2.0, "c": 3.0, "dead": 4.0}
    assert [row.method for row in board.rows] == ["a", "b", "c", "dead", "few"]
    comparison = builder.comparisons.rank_comparison(board)
    assert comparison.n_environments == 26
    assert comparison.mean_ranks == pytest.approx([1.0, 2.0, 3.0, 4.0])
    page = render(builder, results)
    said = "Not ranked, since run on too few of the others' environments: Few (on 12 of 26 env"
    assert said in section(page, "Accuracy")
    assert said in section(page, "Differences between methods")
    header, rows = rows_of(section(page, "Accuracy"))
    assert rows["Few"][header.index("Mean rank")] == "–"
    labels = [t.get_text() for t in builder.drawings.ranks(board).findobj(Text)]
    assert not [text for text in labels if "Few" in text]
    assert [text for text in labels if "Dead" in text]


def test_methods_that_were_run_elsewhere_cut_nobodys_ranks(builder):
    """With both halves in it the ranks would be over nothing: the first by name is taken."""
    results = sweep("all", 2.0) + sweep("early", 1.0, shapes=SINGLE_MOTIONS[:13])
    results += sweep("late", 1.0, shapes=SINGLE_MOTIONS[13:])
    (board,) = boards_of(builder, results)
    assert board.mean_rank == {"early": 1.0, "all": 2.0}


def test_a_metric_that_no_field_means_no_last_rank(builder):
    """A policy without a velocity field has no SEDS error; ranks are taken where all have one."""
    blind = [
        record("blind", s, 0.5, metrics={**record("x", s, 0.5).metrics, "seds_error": None})
        for s in SINGLE_MOTIONS
    ]
    (board,) = boards_of(builder, blind + sweep("good"))
    assert board.mean_rank == {"blind": 1.0, "good": 2.0}
    assert board.rows[0].aggregate("seds_error") is None


def test_what_uses_time_is_shown_and_marked_and_does_not_compete(builder):
    """However good it is: the clock's rows are neither ranked nor bold, and lose nobody a rank."""
    none = dict.fromkeys(("seds_error", "direction_error", "velocity_rmse"))
    clock = [
        record("clock", s, 0.1, uses_time=True, guarantee=Guarantee("none", "a clock drives it"),
               metrics=record("x", s, 0.1).metrics | none)
        for s in SINGLE_MOTIONS
    ]  # fmt: skip
    results = clock + sweep("good", 1.0) + sweep("bad", 2.0)
    (board,) = boards_of(builder, results)
    assert board.mean_rank == {"good": 1.0, "bad": 2.0}
    assert [row.method for row in board.rows] == ["good", "bad", "clock"]
    assert [row.method for row in board.methods] == ["good", "bad", "clock"]
    page = render(builder, results)
    header, rows = rows_of(section(page, "Accuracy"))
    clock_row = rows["Clock<br><sub>uses time</sub>"]
    assert clock_row[header.index("Mean rank")] == ""
    assert not any("**" in cell for cell in clock_row)
    assert clock_row[header.index("SEDS error")] == "–"
    assert any("**" in cell for cell in rows["Good"])
    assert "Clock, *none*: a clock drives it." in page
    stability = rows_of(section(page, "Stability"))[1]
    assert "none" in stability["Clock<br><sub>uses time</sub>"]
    styles = builder.drawings.styles_of(board)
    assert styles["clock"].guarantee == "none, uses time"
    figure = builder.drawings.boxes(board, styles, "mm")
    assert not [t for t in figure.findobj(Text) if "not finite or failed" in t.get_text()]


def test_references_are_below_and_have_no_rank(builder):
    results = sweep("replay", 0.01, reference=True, guarantee=None) + sweep("slow", 3.0)
    (board,) = boards_of(builder, results)
    assert [row.method for row in board.rows] == ["slow", "replay"]
    assert board.mean_rank == {"slow": 1.0}
    assert board.best({"replay": 0.01, "slow": 3.0}, "rmse") == {"slow"}


def test_the_best_of_a_metric_that_is_better_higher(builder):
    (board,) = boards_of(builder, sweep("a", 1.0) + sweep("b", 2.0))
    assert board.best({"a": 0.9, "b": 0.4}, "converged") == {"a"}
    assert board.best({"a": 0.9, "b": 0.4}, "rmse") == {"b"}
    assert board.best({"a": math.nan, "b": 0.4}, "rmse") == {"b"}
    assert board.best({"a": 1.0, "b": 1.0}, "rmse") == {"a", "b"}


def test_a_row_with_three_easy_shapes_does_not_win(builder):
    results = sweep("full", 2.0) + sweep("cherry", 0.1, shapes=SINGLE_MOTIONS[:3])
    (board,) = boards_of(builder, results)
    assert board.best({"full": 2.0, "cherry": 0.1}, "rmse") == {"full"}
    text = section(render(builder, results), "Accuracy")
    header, rows = rows_of(text)
    place = header.index("RMSE (mm)")
    assert rows["Full"][place].startswith("**")
    assert not rows["Cherry"][place].startswith("**")
    assert rows["Cherry"][header.index("Cells")] == "3 of 26"


def test_boards_come_in_order(builder):
    results = [
        record("a", "Multi_Models_1"),
        record("a", "Angle", protocol="generalisation"),
        record("a", "Angle"),
        record("a", "Angle", environment="iflow/Other-v0", family="Other"),
    ]
    keys = [(board.family, board.protocol) for board in boards_of(builder, results)]
    assert keys == [
        ("LASA-26", "reproduction"),
        ("LASA-26", "generalisation"),
        ("LASA-Multi", "reproduction"),
        ("Other", "reproduction"),
    ]


# Comparisons --------------------------------------------------------------------------------


def test_seeds_are_no_data_sets_of_their_own(builder):
    """A block of the test of ranks is an environment, however many seeds there are."""
    one = sweep("a", 1.0) + sweep("b", 2.0) + sweep("c", 3.0)
    many = one + [r for seed in (1, 2) for m, s in (("a", 1.0), ("b", 2.0), ("c", 3.0))
                  for r in sweep(m, s, seed=seed)]  # fmt: skip
    found = [builder.comparisons.rank_comparison(boards_of(builder, r)[0]) for r in (one, many)]
    assert [f.n_environments for f in found] == [26, 26]
    assert found[0].critical_difference == found[1].critical_difference
    assert found[1].statistic == pytest.approx(26 * 2)


def test_few_environments_are_not_tested(builder):
    results = [r for m in "abc" for r in sweep(m, shapes=MULTI_MODELS)]
    (board,) = boards_of(builder, results)
    assert builder.comparisons.rank_comparison(board) is None


def test_a_failed_cell_loses_to_every_other(builder):
    results = [*sweep("good", 1.0, shapes=SINGLE_MOTIONS[13:]), *sweep("bad", 2.0)]
    results += [failed("good", s) for s in SINGLE_MOTIONS[:13]]
    (board,) = boards_of(builder, results)
    found = builder.comparisons.improvements(board)
    assert found["good", "bad"].probability == 0.5
    assert builder.comparisons.profiles(board)["good"].fraction[-1] == 0.5
    text = section(render(builder, results), "Differences between methods")
    header, rows = rows_of(text)
    assert rows["Good"][header.index("Bad")].startswith("50<br><sub>")


def test_a_cell_that_was_never_run_is_no_defeat(builder):
    results = [*sweep("good", 1.0, shapes=SINGLE_MOTIONS[13:]), *sweep("bad", 2.0)]
    results += sweep("elsewhere", 3.0, shapes=SINGLE_MOTIONS[:13])
    (board,) = boards_of(builder, results)
    found = builder.comparisons.improvements(board)
    assert found["good", "bad"].probability == 1.0
    assert found["good", "bad"].n_environments == 13
    assert ("good", "elsewhere") not in found
    assert builder.comparisons.profiles(board)["good"].fraction[-1] == 1.0
    header, rows = rows_of(section(render(builder, results), "Differences between methods"))
    assert rows["Good"][header.index("Elsewhere")] == ""


# Numbers ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (2.1549, "2.15"), (0.0266, "0.0266"), (134.2, "134"), (8.0, "8"), (0.0, "0"),
        (12345.6, "12346"), (1.5e7, "1.5·10⁷"), (2e-5, "2.0·10⁻⁵"), (-3.4e-4, "-0.00034"),
        (9.96e-4, "0.001"), (2e-14, "≈ 0"), (math.inf, "∞"),
        (math.nan, "–"), (None, "–"),
    ],
)  # fmt: skip
def test_numbers(builder, value, text):
    assert builder.tables.shown("rmse", value) == text


@pytest.mark.parametrize(
    ("value", "text", "with_unit"),
    [
        (3.4e-4, "0.340 ms", "0.340 ms"), (2.52e-5, "25.2 µs", "25.2 µs"),
        (4.25e-6, "4.25 µs", "4.25 µs"),
        (0.00822, "0.00822", "0.00822 s"), (12.5, "12.5", "12.5 s"), (0.0, "0", "0 s"),
    ],
)  # fmt: skip
def test_seconds(builder, value, text, with_unit):
    assert builder.tables.shown("fit_seconds", value) == text
    assert builder.tables.with_unit("fit_seconds", value) == with_unit


def test_other_units_are_said_once(builder):
    assert builder.tables.with_unit("step_us", 3.25) == "3.25 µs"
    assert builder.tables.shown("rmse", 3.4e-4) == "0.00034"


@pytest.mark.parametrize(
    ("value", "text"),
    [(1.0, "100"), (0.99999, "99.99"), (0.0, "0"), (1e-6, "0.01"), (0.5, "50.00"), (None, "–")],
)
def test_percentages_never_round_to_all_or_nothing(builder, value, text):
    assert builder.tables.shown("converged", value) == text


# The page -----------------------------------------------------------------------------------


def test_bold_is_the_best_competitor_and_references_are_italic(builder):
    results = sweep("good", 1.0) + sweep("bad", 2.0)
    results += sweep("replay", 0.01, reference=True, guarantee=None)
    header, rows = rows_of(section(render(builder, results), "Accuracy"))
    place = header.index("Fréchet (mm)")
    assert rows["Good"][place].startswith("**")
    assert not rows["Bad"][place].startswith("*")
    assert rows["replay".capitalize()][0] == "*Replay*"
    reference = rows["Replay"][place]
    assert reference.startswith("*")
    assert not reference.startswith("**")
    assert rows["Replay"][header.index("Mean rank")] == ""


def test_numbers_of_the_page_are_the_aggregates(builder):
    values = [1 + i / 10 for i in range(26)]
    header, rows = rows_of(section(render(builder, sweep("good")), "Accuracy"))
    iqm = np.mean(sorted(values)[6:20])
    assert rows["Good"][header.index("RMSE (mm)")].startswith(f"**{iqm:.2f}**<br><sub>")


def test_intervals_say_what_they_resample(builder):
    one = render(builder, sweep("good"))
    assert "with one seed they resample the shapes" in one
    assert "with several seeds" not in one
    three = [r for seed in range(3) for r in sweep("good", 1 + seed / 9, seed=seed)]
    assert "with several seeds they resample the seeds within each shape" in render(builder, three)
    mixed = render(builder, three + sweep("still"))
    assert "(Still)" in mixed
    assert "not to be compared" in mixed


def test_failed_cells_are_listed_with_their_reasons(builder):
    results = [*sweep("good", shapes=SINGLE_MOTIONS[1:]), failed("good", "Angle")]
    text = render(builder, results)
    assert "| Good on Angle (seed 0), reproduction | RuntimeError: it \\| broke |" in text
    assert "25 of 26 (1 failed, 0 never run)" in text
    header, rows = rows_of(text[text.index("Fréchet</summary>") :])
    assert rows["Angle"][header.index("Good")] == "failed"


def test_cells_that_failed_for_the_same_reason_are_one_line(builder):
    shapes = SINGLE_MOTIONS[:4]
    results = sweep("good", shapes=SINGLE_MOTIONS[4:])
    results += [
        failed("good", s, reason=f"ValueError: {s} has {i + 0.5} s, e.g. {lasa_id(s)}")
        for i, s in enumerate(shapes[:3])
    ]
    results += [failed("good", shapes[3], reason="ValueError: something else")]
    text = section(render(builder, results), "Cells without scores", "## ")
    lines = [line for line in text.splitlines() if line.startswith("| Good")]
    assert len(lines) == 2
    assert lines[0].startswith(f"| Good on {', '.join(shapes[:3])} (seed 0), reproduction | Value")
    assert lines[1].endswith("| ValueError: something else |")


def test_methods_that_cannot_learn_a_motion_are_told_by_reason(builder):
    metrics = {m.name: 1.0 for m in metrics_of("cycle")}
    results = [
        record("good", "Angle", metrics=metrics, environment="iflow/Letter-I-v0", family="Letter")
    ]
    (board,) = boards_of(builder, results)
    found = dict(builder.tables.outside(board))
    assert found["SEDS, CLF-DM, Stable linear"] == "its systems end at a goal"
    assert len(found) == len(set(found.values()))
    assert "| SEDS, CLF-DM, Stable linear | not applicable |" in render(builder, results)


def test_a_method_that_only_failed_is_still_there(builder):
    results = sweep("good") + [failed("dead", s) for s in SINGLE_MOTIONS]
    header, rows = rows_of(section(render(builder, results), "Accuracy"))
    assert rows["Dead"][header.index("Cells")] == "0 of 26"
    assert rows["Dead"][header.index("RMSE (mm)")] == "–"
    assert rows["Dead"][header.index("Mean rank")] == "2.00"


def test_cells_never_run_are_said(builder):
    text = render(builder, sweep("good", shapes=SINGLE_MOTIONS[:2]))
    assert "Good: 24 of 26 cells of LASA-26, reproduction, were never run" in text


def test_a_runaway_counts(builder):
    results = sweep("good", shapes=SINGLE_MOTIONS[1:])
    results += [record("good", "Angle", metrics={**results[0].metrics, "rmse": math.inf})]
    text = render(builder, results)
    mean = text[text.index("Mean over the shapes:") :]
    header, rows = rows_of(mean)
    assert rows["Good"][header.index("RMSE (mm)")].startswith("∞")  # not bold: none is the best


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"hashes": {"metrics": "other"}}, "scored by different versions of the metrics"),
        ({"versions": {"python": "3.12", "numpy": "1.26"}}, "different versions of numpy"),
        ({"preset": "smoke"}, "26 of the 52 records are of a trial, the smoke preset"),
        ({"hardware": {"cpu": "mill"}}, "on different processors"),
    ],
)
def test_records_that_do_not_compare_are_warned_of(builder, changes, message):
    results = sweep("good") + sweep("new", **changes)
    text = render(builder, results)
    assert message in section(text, "Leaderboard", "# ").split("##")[0]
    assert "> [!WARNING]" in text


def test_records_of_other_metrics_than_the_checkouts_are_warned_of(builder):
    text = render(builder, sweep("good", hashes={"metrics": "old"}))
    assert "this checkout has" in text


def test_records_that_compare_are_not_warned_of(builder):
    other = sweep("other", 2.0, guarantee=Guarantee("none", "made up"))
    assert "WARNING" not in render(builder, sweep("good") + other)
    hashes = {"metrics": metrics_hash("goal"), "core": "c", "code": "of another method"}
    another = [record("another", s, hashes={**hashes, "data": s}) for s in SINGLE_MOTIONS]
    another += [record("another", s, seed=1, preset="full", hashes=another[0].hashes | {"data": s})
                for s in SINGLE_MOTIONS]  # fmt: skip
    assert "WARNING" not in render(builder, sweep("good") + another)


@pytest.mark.parametrize(
    ("label", "preset", "message"),
    [
        ("code", "standard", "Good were made with different versions of its code on LASA-26, repr"),
        ("code", "full", "Good were made with different versions of its code on LASA-26, repr"),
        (
            "config",
            "standard",
            "records of Good were made with different settings in the preset st",
        ),
        (
            "config",
            "full",
            "records of Good are of presets with different settings: full, standard",
        ),
    ],
)
def test_records_of_a_method_that_do_not_compare_are_warned_of(builder, label, preset, message):
    shapes = SINGLE_MOTIONS[:3]
    new = [
        record("good", s, preset=preset, hashes={**record("good", s).hashes, label: "new"})
        for s in shapes
    ]
    text = render(builder, sweep("good", shapes=SINGLE_MOTIONS[3:]) + new)
    assert message in text.split("\n## ")[0]
    if "were made" in message:
        assert "23 cells by none, 3 cells by new" in text


def test_each_family_may_have_settings_and_code_of_its_own(builder):
    own = record("good", MULTI_MODELS[0])
    new = {"config": "new", "code": "new"}
    other = record("good", MULTI_MODELS[0], hashes={**own.hashes, **new})
    text = render(builder, [*sweep("good"), other])
    assert "records of Good were made" not in text


@pytest.mark.parametrize(
    ("kind", "metric", "value", "message"),
    [
        ("proved", "converged", 0.5, "converge"),
        ("proved", "lyapunov_violation", 1e-4, "in 1 of 26 cells: lyapunov violation is 0.01 % on"),
        ("proved", "lyapunov_violation", 0.0, None),
        ("proved", "lyapunov_violation", None, None),
        ("sampled", "converged", 0.5, None),
    ],
)
def test_a_proof_that_measurements_contradict_is_warned_of(builder, kind, metric, value, message):
    stated = {"guarantee": Guarantee(kind, "made up")}
    results = sweep("good", shapes=SINGLE_MOTIONS[1:], **stated)
    scores = {**results[0].metrics, metric: value}
    text = render(builder, [*results, record("good", "Angle", metrics=scores, **stated)])
    if message is None:
        assert "WARNING" not in text
    else:
        (line,) = [line for line in text.splitlines() if line.startswith("> - ")]
        assert line.startswith("> - Good states a *proved* guarantee, but ")
        assert message in line
        assert line.endswith("on Angle, the worst.")
        assert text.index("## LASA-26") < text.index(line) < text.index("### Accuracy")


def test_titles_and_reasons_cannot_break_the_page(builder):
    title = "A|B\n[x](y) <img> *z* `c` d_e_f \\"
    clean = "A\\|B \\[x\\](y) &lt;img&gt; \\*z\\* \\`c\\` d\\_e\\_f \\\\"
    assert builder.tables.escaped(title) == clean
    results = sweep("good", title=title, shapes=SINGLE_MOTIONS[1:])
    results += [failed("good", "Angle", reason=f"{title}: no", title=title)]
    text = render(builder, results)
    assert "<img>" not in text
    assert "[x](y)" not in text
    assert f"| {clean} | " in text


def test_where_a_method_comes_from_is_said_and_a_long_note_is_not(builder):
    said = {"name": "good", "title": "Good", "guarantee": "none", "hardware": "abacus"}
    one = Submission(
        **said,
        paper="A. [B], *C*",
        code="https://x.org/a(b)",
        link="https://x.org/p",
        note="Short.",
    )
    other = Submission(**said | {"title": "Bad"}, paper="none", code="a/b_c.py", note="x" * 201)
    text = render(builder, sweep("good") + sweep("bad", 2.0), good=one, bad=other)
    lines = text[text.index("Where each method comes from") :].splitlines()[2:4]
    assert lines == [
        "- **Bad**, code: a/b\\_c.py.",
        "- **Good**, paper: [A. \\[B\\], \\*C\\*](<https://x.org/p>); "
        "code: [https://x.org/a(b)](<https://x.org/a(b)>); note: Short.",
    ]
    assert "Where each method comes from" not in render(builder, sweep("good"))


def test_the_commands_that_made_the_records_are_those_of_their_scripts(builder):
    made = [*sweep("linear"), *sweep("imitation-flow+residual", preset="residual", target="m:load")]
    text = render(builder, made)
    assert "$ python baselines/run_all.py --preset standard --force\n" in text
    assert "$ python baselines/residual.py bench --force\n" in text
    assert "--preset residual" not in text
    assert "m:load" not in text


def test_what_memory_is_is_said(builder):
    cost = section(render(builder, sweep("good")), "Cost")
    assert "rise of the worker's resident memory" in cost


def test_tables_have_as_many_cells_in_every_row(builder):
    results = sweep("good") + [failed("odd", s) for s in SINGLE_MOTIONS[:3]]
    results += [record("good", s) for s in MULTI_MODELS]
    text = render(builder, results)
    for block in text.split("\n\n"):
        lines = [line for line in block.splitlines() if line.startswith("|")]
        widths = {line.replace("\\|", "").count("|") for line in lines}
        assert len(widths) <= 1, block


# Files --------------------------------------------------------------------------------------


@pytest.fixture
def results_folder(tmp_path):
    """Records of two methods, one of them with a fitted model on one shape."""
    folder = tmp_path / "results"
    for result in sweep("gmr", 2.0, guarantee=Guarantee("none", "made up")):
        write_result(folder, result)
    for result in sweep("linear", 1.0, model="LASA-Sshape-v0.model.safetensors"):
        write_result(folder, result)
    system = StableLinear().fit(load_lasa("Sshape"), seed=0)
    system.save(folder / "linear" / "LASA-Sshape-v0.model.safetensors")
    return folder


def test_the_same_results_give_the_same_bytes(builder, results_folder, tmp_path):
    written = [builder.build(results_folder, tmp_path / name) for name in ("a", "b")]
    names = [[path.name for path in paths] for paths in written]
    assert names[0] == names[1]
    assert set(names[0]) == {
        "LEADERBOARD.md",
        "index.html",
        "accuracy-stability.svg",
        "accuracy-fit-time.svg",
        "boxes.svg",
        "profile.svg",
        "methods.png",
    }
    for first, second in zip(*written, strict=True):
        assert first.read_bytes() == second.read_bytes(), first.name


def test_every_picture_of_the_page_is_there(builder, results_folder, tmp_path):
    page, _, *figures = builder.build(results_folder, tmp_path / "out")
    text = page.read_text(encoding="utf-8")
    for figure in figures:
        assert f"(figures/{figure.name})" in text
    assert text.count("![") == len(figures)


def test_figures_hold_no_date(builder, results_folder, tmp_path):
    _, _, *figures = builder.build(results_folder, tmp_path / "out")
    for figure in figures:
        if figure.suffix == ".svg":
            assert "dc:date" not in figure.read_text(encoding="utf-8")


def test_a_model_of_anyones_class_is_loaded_or_said_to_be_none(
    builder, results_folder, tmp_path, monkeypatch
):
    system = StableLinear().fit(load_lasa("Sshape"), seed=0)
    folder = tmp_path / "foreign"
    (folder / "mine").mkdir(parents=True)
    system.save(folder / "mine" / "m.safetensors")
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "mine_module.py").write_text(
        "from iflow_gym.baselines.linear import StableLinear as Mine\n"
    )

    def load(**changes):
        fields = {"model": "m.safetensors", "target": "mine_module:Mine", **changes}
        return builder.drawings.load_model(record("mine", "Sshape", **fields), folder)

    loaded, problem = load()
    assert problem == ""
    assert (loaded.velocity([1.0, 2.0]) == system.velocity([1.0, 2.0])).all()
    assert load(target="absent_module:Mine") == (None, "absent_module:Mine\nis not importable")
    assert load(target="mine_module:Absent") == (None, "mine_module:Absent\nis not importable")
    assert load(target=None) == (None, "unknown method")
    assert load(model="absent.safetensors") == (None, "no model file")
    assert load(model=None) == (None, "no model file")
    (folder / "mine" / "m.safetensors").write_text("no model")
    assert load() == (None, "no usable model file")


def run_script(*arguments):
    return subprocess.run(
        [sys.executable, str(LEADERBOARD / "build.py"), *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
    )


def test_nothing_to_build_is_said(tmp_path):
    (tmp_path / "empty").mkdir()
    for folder, message in (
        (tmp_path / "absent", "Expected a folder of results"),
        (tmp_path / "empty", "Expected records in"),
    ):
        done = run_script("--results", folder, "--output", tmp_path / "out")
        assert done.returncode == 2
        assert message in done.stderr
        assert "run_all.py" in done.stderr
        assert "Traceback" not in done.stderr
    assert not (tmp_path / "out").exists()


def test_the_script_prints_what_it_wrote(tmp_path):
    write_result(tmp_path / "results", record("good", "Multi_Models_1"))
    done = run_script("--results", tmp_path / "results", "--output", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [
        str(tmp_path / "out" / name) for name in ("LEADERBOARD.md", "index.html")
    ]


def test_a_folders_method_toml_is_read_and_a_wrong_one_is_told(builder, tmp_path):
    folder = tmp_path / "results"
    write_result(folder, record("good", "Multi_Models_1"))
    described = folder / "good" / "method.toml"
    said = 'name = "good"\ntitle = "Good"\npaper = "A paper"\ncode = "https://x.org/code"\n'
    described.write_text(said + 'guarantee = "none"\nhardware = "abacus"\n')
    page, html, *_ = builder.build(folder, tmp_path / "out")
    assert "- **Good**, paper: A paper; code: [https://x.org/code](<" in page.read_text()
    assert '["Code","https://x.org/code","https://x.org/code"]' in html.read_text()
    described.write_text(said)
    done = run_script("--results", folder, "--output", tmp_path / "out")
    assert done.returncode == 2
    assert "expected guarantee, got none" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_check_finds_what_the_records_do_not_say(builder, tmp_path):
    folder, out = tmp_path / "results", tmp_path / "out"
    for result in sweep("good") + sweep("bad", 2.0):
        write_result(folder, result)
    pages = builder.build(folder, out)[:2]
    assert builder.check(folder, out) == []
    before = [path.stat().st_mtime_ns for path in pages]
    write_result(folder, record("good", "Angle", 1.5))
    difference = builder.check(folder, out)
    assert "--- LEADERBOARD.md as it is" in difference
    assert "--- index.html as it is" in difference
    assert any(line.startswith("-| Good |") for line in difference)
    assert [path.stat().st_mtime_ns for path in pages] == before
    done = run_script("--results", folder, "--output", out, "--check")
    assert done.returncode == 1
    assert "run `python leaderboard/build.py`" in done.stderr
    assert len(done.stderr.splitlines()) < 40


# Figures ------------------------------------------------------------------------------------


def test_a_method_keeps_its_colour_whoever_else_is_there():
    order = ("imitation-flow", "linear", "gmr")
    alone = method_styles({"gmr": ("GMR", "none")}, order)
    both = method_styles({"gmr": ("GMR", "none"), "linear": ("Linear", "proved")}, order)
    assert alone["gmr"] == both["gmr"]
    assert both["gmr"].colour == PALETTE[2]
    assert (both["gmr"].marker, both["linear"].marker) == ("X", "o")


def test_labels_of_a_scatter_do_not_overlap():
    """Eight methods, four of them nearly in one place."""
    names = [f"method {i}" for i in range(8)]
    styles = method_styles({name: (name, "proved") for name in names})
    points = [Point(n, 1 + 0.01 * i if i < 4 else i, 100.0) for i, n in enumerate(names)]
    figure = scatter_figure(points, styles, x_label="x", y_label="y")
    (ax,) = figure.axes
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    texts = [text for text in ax.texts if text.get_text() in names]
    assert sorted(text.get_text() for text in texts) == names
    renderer = canvas.get_renderer()
    boxes = [Text.get_window_extent(text, renderer) for text in texts]  # without lines to points
    for i, one in enumerate(boxes):
        assert not any(one.overlaps(other) for other in boxes[i + 1 :])


def test_labels_of_a_scatter_do_not_cross_its_dashed_line():
    """A name right of its point would be crossed by the line, one left of it not."""
    styles = method_styles({name: (name, "none") for name in ("behavioural cloning", "other")})
    points = [Point("behavioural cloning", 4.8, 50.0), Point("other", 9.0, 90.0)]
    figure = scatter_figure(
        points, styles, x_label="x", y_label="y", references={"between demonstrations": 5.0}
    )
    (ax,) = figure.axes
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    boxes = {t.get_text(): Text.get_window_extent(t, renderer) for t in ax.texts}
    (line,) = [one for one in ax.lines if one.get_linestyle() == "--"]
    label = boxes["behavioural cloning"]
    assert not label.overlaps(line.get_window_extent(renderer))
    assert not label.overlaps(boxes["between demonstrations"])


def test_scores_that_cannot_be_drawn_are_counted():
    styles = method_styles({"a": ("A", "none")})
    figure = box_figure({"RMSE": {"a": [1.0, 2.0, np.inf, np.nan]}}, styles)
    (ax,) = figure.axes
    assert [text.get_text() for text in ax.texts] == ["+ 2 not finite or failed"]


def test_a_method_without_a_finite_score_has_no_point():
    styles = method_styles({"a": ("A", "none"), "b": ("B", "none")})
    points = [Point("a", np.inf, 1.0), Point("b", 1.0, 2.0)]
    figure = scatter_figure(points, styles, x_label="x", y_label="y")
    assert [text.get_text() for text in figure.axes[0].texts] == ["B"]


def test_rare_colours_survive_in_a_png(tmp_path):
    """A median cut alone turns the few yellow pixels of a goal's star orange."""
    from PIL import Image

    noise = np.random.default_rng(0).uniform(1, 100, size=4000)
    styles = method_styles({"a": ("A", "none")})
    figure = box_figure({"RMSE": {"a": noise}}, styles)
    figure.axes[0].plot([50.0], [0.0], "*", color=GOAL, markersize=15, zorder=9)
    with Image.open(save_figure(figure, tmp_path / "figure.png")) as image:
        pixels = np.asarray(image.convert("RGB")).reshape(-1, 3)
    wanted = [int(GOAL[i : i + 2], 16) for i in (1, 3, 5)]
    assert (pixels == wanted).all(axis=1).sum() > 20


def test_other_files_than_pictures_are_refused(tmp_path):
    figure = box_figure({"RMSE": {"a": [1.0, 2.0]}}, method_styles({"a": ("A", "none")}))
    with pytest.raises(ValueError, match=r"ends in \.svg or \.png"):
        save_figure(figure, tmp_path / "figure.pdf")
