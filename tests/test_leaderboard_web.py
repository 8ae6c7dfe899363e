"""The leaderboard's page: what is in it, and that nothing in a record can break it."""

import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from leaderboard_records import failed, record, sweep

from iflow_gym.datasets.lasa import SINGLE_MOTIONS
from iflow_gym.figures import Point as FigurePoint
from iflow_gym.figures import method_styles, scatter_figure
from iflow_gym.leaderboard.submission import Submission
from iflow_gym.system import Guarantee

ROOT = Path(__file__).parents[1]

VOID = {"meta", "link", "input", "img", "br", "path", "use"}


class Page(HTMLParser):
    """Collects elements; fails where they are not closed in order."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.open = [], []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag

    def find(self, tag, **wanted):
        return [
            attributes
            for name, attributes in self.elements
            if name == tag and all(attributes.get(k) == v for k, v in wanted.items())
        ]


def page_of(builder, results, tmp_path, **submissions):
    boards = builder.make_boards(results)
    units = {board.family: "mm" for board in boards}
    return builder.web.render(
        boards, results, units, tmp_path, drawings={"x": None}, figures={}, submissions=submissions
    )


def data_of(page):
    return json.loads(
        re.search(r'<script type="application/json" id="data">(.*?)</script>', page)[1]
    )


def row_of(page, method):
    """Return a method's cells, as text, by the column they sort by."""
    heads = re.findall(r'data-sort="([^"]+)"', page.split("</thead>")[0])
    row = re.search(rf'<tr class="row" data-method="{method}".*?</tr>', page, re.S)[0]
    cells = re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row, re.S)
    return dict(zip(heads, cells, strict=True))


def test_the_table_has_the_aggregates(builder, tmp_path):
    page = page_of(builder, sweep("good") + sweep("bad", 2.0), tmp_path)
    iqm = np.mean(sorted(1 + i / 10 for i in range(26))[6:20])
    assert row_of(page, "good")["frechet"].startswith(f"<strong>{iqm:.2f}</strong><small>")
    assert row_of(page, "bad")["frechet"].startswith(f"{2 * iqm:.2f}<small>")
    assert row_of(page, "good")["cells"] == "26 of 26"
    assert row_of(page, "good")["rank"] == "<strong>1.00</strong>"
    assert "proved" in row_of(page, "good")["guarantee"]


def test_the_page_is_well_formed_and_ids_are_unique(builder, tmp_path):
    results = sweep("good") + sweep("bad", 2.0)
    results += sweep("good", protocol="generalisation")
    page = Page(page_of(builder, results, tmp_path))
    ids = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    for tab in page.find("button", role="tab"):
        assert tab["aria-controls"] in ids
    for panel in page.find("section", role="tabpanel"):
        assert panel["aria-labelledby"] in ids


def test_nothing_in_a_record_can_break_the_page(builder, tmp_path):
    """A title or a reason that ends a script, opens a tag or closes an attribute stays text."""
    evil = "</script><script>alert(1)</script><img src=x onerror=alert(1)>\"' & <!--"
    results = sweep("good", title=evil, shapes=SINGLE_MOTIONS[1:], config={evil: evil},
                    guarantee=Guarantee("none", evil), versions={evil: evil})  # fmt: skip
    results += [failed("good", "Angle", reason=evil, title=evil)]
    text = page_of(builder, results, tmp_path)
    page = Page(text)
    assert len(page.find("script")) == 2
    assert not [a for _, a in page.elements if "onerror" in a]
    assert "<script>alert" not in text
    known = data_of(text)["LASA-26-reproduction"]["good"]
    assert known["missing"] == [["failed", f"1 cell: Angle (seed 0)\n{evil}"]]
    assert known["guarantees"] == [["none", evil]]
    (badge,) = page.find("button", **{"class": "badge none"})
    assert badge["data-reason"] == evil


@pytest.mark.parametrize("text", ["</script>", "<!--", "\u2028", "&amp;", "]]>"])
def test_json_inside_a_script(builder, text):
    written = builder.web.as_script_data({"a": text})
    assert not set("<>&\u2028\u2029") & set(written)
    assert json.loads(written) == {"a": text}


def test_nothing_is_fetched(builder, tmp_path):
    text = page_of(builder, sweep("good"), tmp_path)
    page = Page(text)
    (policy,) = page.find("meta", **{"http-equiv": "Content-Security-Policy"})
    assert "default-src 'none'" in policy["content"]
    assert not re.search(r'(?:src|href)="(?!data:|#|\.\./|LEADERBOARD)', text)
    assert not re.search(r"@import|url\((?!#)|fetch\(|XMLHttpRequest|sendBeacon", text)


@pytest.mark.parametrize(
    ("changes", "facts"),
    [
        (
            {"link": "https://x.org/p"},
            [["Paper", "A & <b>", "https://x.org/p"], ["Code", "a/b.py"]],
        ),
        (
            {"paper": "none", "link": "https://x.org/p", "note": "</script>"},
            [
                ["Paper", "https://x.org/p", "https://x.org/p"],
                ["Code", "a/b.py"],
                ["Note", "</script>"],
            ],
        ),
        (
            {"code": "http://x.org", "link": "javascript:alert(1)"},
            [["Paper", "A & <b>"], ["Code", "http://x.org", "http://x.org"]],
        ),
        ({"paper": "none", "code": "data:text/html,x"}, [["Code", "data:text/html,x"]]),
    ],
)
def test_paper_code_and_note_are_in_the_details_and_only_the_webs_addresses_are_links(
    builder, tmp_path, changes, facts
):
    fields = {"name": "good", "title": "Good", "paper": "A & <b>", "code": "a/b.py"}
    one = Submission(**fields | changes, guarantee="none", hardware="abacus")
    text = page_of(builder, sweep("good"), tmp_path, good=one)
    Page(text)
    known = data_of(text)["LASA-26-reproduction"]["good"]["facts"]
    assert known[1 : 1 + len(facts)] == facts
    assert known[1 + len(facts)][0] == "Class"


def test_failed_cells_and_cells_never_run_are_in_the_details(builder, tmp_path):
    results = sweep("good", shapes=SINGLE_MOTIONS[2:])
    results += [failed("good", SINGLE_MOTIONS[0], reason="RuntimeError: it broke\nfile.py:1")]
    text = page_of(builder, results, tmp_path)
    known = data_of(text)["LASA-26-reproduction"]["good"]
    assert known["missing"] == [
        ["failed", f"1 cell: {SINGLE_MOTIONS[0]} (seed 0)\nRuntimeError: it broke\nfile.py:1"],
        ["never run", f"1 cell: {SINGLE_MOTIONS[1]} (seed 0)"],
    ]
    scores = {line[0]: line[1:] for line in known["scores"]}
    assert scores[SINGLE_MOTIONS[0]] == ["failed"]
    assert SINGLE_MOTIONS[1] not in scores
    assert "24 of 26" in row_of(text, "good")["cells"]


def test_cells_without_scores_are_a_line_for_each_reason(builder, tmp_path):
    shapes = SINGLE_MOTIONS
    results = [r for seed in (0, 1) for r in sweep("good", shapes=shapes[:2], seed=seed)]
    results += [
        failed(
            "good", s, reason=f"ValueError: expected 3 rounds of {s}, got {i}\nfile.py:1", seed=0
        )
        for i, s in enumerate(shapes[2:5])
    ]
    results += [failed("good", shapes[2], reason="OSError: no", seed=1)]
    text = page_of(builder, results, tmp_path)
    known = data_of(text)["LASA-26-reproduction"]["good"]
    assert known["missing"] == [
        [
            "failed",
            f"3 cells: {', '.join(shapes[2:5])} (seed 0)\nValueError: expected 3 rounds of "
            f"{shapes[2]}, got 0\nfile.py:1\nThe others' reasons read alike.",
        ],
        ["failed", f"1 cell: {shapes[2]} (seed 1)\nOSError: no"],
        [
            "never run",
            f"44 cells: {', '.join(shapes[3:5])} (seed 1); {', '.join(shapes[5:])} (seeds 0, 1)",
        ],
    ]


def test_intervals_of_a_motion_are_over_demonstrations_or_else_over_seeds(builder, tmp_path):
    def cell(seed, scale):
        metrics = record("good", "Angle").metrics | {"frechet": 2.0 * scale, "n_parameters": scale}
        values = {"frechet": [scale * 1.0, scale * 3.0]}
        return record("good", "Angle", seed=seed, metrics=metrics, per_demonstration=values)

    text = page_of(builder, [cell(0, 1.0), cell(1, 3.0)], tmp_path)
    known = data_of(text)["LASA-26-reproduction"]["good"]
    names = [m.partition(" (")[0] for m in known["metrics"]]
    (angle,) = [line for line in known["scores"] if line[0] == "Angle"]
    # The demonstrations' means over the seeds are 2 and 6: two draws of them reach both ends.
    assert angle[1 + names.index("Fréchet")] == ["4", "2 to 6"]
    assert angle[1 + names.index("Parameters")] == ["2", "1 to 3"]


def test_the_cards_say_what_the_table_says(builder, tmp_path):
    results = sweep("good", 0.9, guarantee=Guarantee("none", "made up"))
    results += sweep("safe", 1.0) + sweep("slow", 4.0)
    text = page_of(builder, results, tmp_path)
    values = re.findall(r'<section class="card"><h3>(.*?)</h3><p class="value">(.*?)</p>', text)
    assert values[0] == ("Most accurate", "Good")
    assert values[1] == ("Stable for sure", "Safe")
    assert "Slow 25.00 %" in text  # of its starts converged


def test_incomplete_methods_are_no_part_of_the_cards_comparison_and_are_named(builder, tmp_path):
    """Means over other cells do not compare: that of a few easy ones is no better."""
    results = sweep("good", 2.0) + sweep("bad", 3.0) + sweep("easy", 1.0, shapes=SINGLE_MOTIONS[:3])
    text = page_of(builder, results, tmp_path)
    (card,) = re.findall(r"<h3>Most accurate</h3>(.*?)</section>", text)
    assert card.startswith('<p class="value">Good</p>')
    assert "over 26 of 26 cells" in card
    assert "Next: Bad, " in card
    assert "Good is the better one with 100 % probability" in card
    assert "Not compared here, since incomplete: Easy (3 of 26)." in card
    assert "of what was run: Easy 3 of 26 cells" in text


def test_what_is_not_ranked_has_no_rank_and_is_named(builder, tmp_path):
    results = sweep("good", 2.0) + sweep("bad", 3.0) + sweep("easy", 1.0, shapes=SINGLE_MOTIONS[:3])
    text = page_of(builder, results, tmp_path)
    assert row_of(text, "easy")["rank"] == "–"
    assert row_of(text, "good")["rank"] == "<strong>1.00</strong>"
    assert "environments: Easy (on 3 of 26 environments)." in text


def test_a_trial_says_so_when_it_is_opened(builder, tmp_path):
    text = page_of(builder, sweep("good", preset="smoke"), tmp_path)
    assert "<h1>iflow-gym leaderboard, a trial</h1>" in text
    above = text.split('<main id="boards">')[0]
    assert '<p class="notice" role="note">This is a trial: all its records are of the' in above
    assert "trial" not in page_of(builder, sweep("good"), tmp_path)


def test_a_board_of_few_motions_says_which_figures_it_has_not(builder, tmp_path):
    results = sweep("good", shapes=SINGLE_MOTIONS[:1])
    text = page_of(builder, results, tmp_path)
    assert "are drawn of 4 motions or more; of this family 1 was run." in text
    (board,) = builder.make_boards(results)
    assert {"profile", "boxes"}.isdisjoint(builder.web.number_figures(board))
    assert "motions or more" not in page_of(builder, sweep("good"), tmp_path)


def test_documents_are_linked_from_a_page_outside_the_checkout(builder, tmp_path):
    (link,) = re.findall(
        r'href="([^"]+)">How to add your method', page_of(builder, sweep("good"), tmp_path)
    )
    assert (tmp_path / link).resolve() == ROOT / "docs" / "adding-a-method.md"


def test_references_and_clocks_are_set_apart(builder, tmp_path):
    results = sweep("good") + sweep("clock", 0.1, uses_time=True)
    results += sweep("replay", 0.01, reference=True, guarantee=None)
    text = page_of(builder, results, tmp_path)
    bodies = re.findall(r'<tbody class="(\w+)">(.*?)</tbody>', text, re.S)
    found = {kind: re.findall(r'data-method="([^"]+)"', body) for kind, body in bodies}
    assert found == {"competitors": ["good"], "clock": ["clock"], "references": ["replay"]}
    assert "<strong>" not in row_of(text, "clock")["frechet"]


def test_a_figure_follows_the_pages_colours_and_stays_small(builder):
    styles = method_styles({"a": ("A & <B>", "none"), "b": ("B", "proved")})
    points = [FigurePoint("a", 1.0, 2.0, (0.9, 1.1)), FigurePoint("b", 2.0, 3.0)]
    pool = builder.web.Styles()
    figures = [scatter_figure(points, styles, x_label="x", y_label="y") for _ in range(2)]
    one, two = (builder.web.inline_svg(figure, 'a "figure"', pool) for figure in figures)
    assert one != two  # no id is there twice
    ids = re.findall(r' id="([^"]+)"', one + two)
    assert len(ids) == len(set(ids)) > 0
    assert set(re.findall(r'href="#([^"]+)"|url\(#([^)]+)\)', one)) <= {
        pair for i in ids for pair in ((i, ""), ("", i))
    }
    assert "var(--ink)" in pool.css()
    assert "#22303c" not in one + pool.css()
    assert "A &amp; &lt;B&gt;" in one
    assert "style=" not in one.split(">", 1)[1]
    Page(one)


def test_infinity_and_nothing_sort(builder):
    assert builder.web.sortable(math.inf) == "Infinity"
    assert builder.web.sortable(math.nan) == ""
    assert float(builder.web.sortable(1234.5678)) == pytest.approx(1234.5678, abs=1e-4)


def test_the_same_records_give_the_same_page(builder, tmp_path):
    results = sweep("good") + sweep("bad", 2.0)
    assert page_of(builder, results, tmp_path) == page_of(builder, results[::-1], tmp_path)
