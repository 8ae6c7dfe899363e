"""The leaderboard's page in a real browser: made of records that are made up, and looked at."""

import itertools
from pathlib import Path

import pytest
from leaderboard_records import failed, sweep

from iflow_gym.datasets.lasa import MULTI_MODELS, SINGLE_MOTIONS
from iflow_gym.results import write_result
from iflow_gym.system import Guarantee

sync_api = pytest.importorskip(
    "playwright.sync_api", reason="the browser tests need playwright: pip install -e '.[test]'"
)


@pytest.fixture(scope="module")
def address(builder, tmp_path_factory):
    """A page of five methods on two families, one of them with a failed cell."""
    folder = tmp_path_factory.mktemp("web")
    results = sweep("good", 1.0, config={"n_steps": 7}) + sweep("bad", 3.0)
    results += [*sweep("middle", 2.0, shapes=SINGLE_MOTIONS[1:],
                       guarantee=Guarantee("none", "nothing in it says so"))]  # fmt: skip
    results += [failed("middle", SINGLE_MOTIONS[0], reason="RuntimeError: it broke")]
    results += sweep("clock", 0.5, uses_time=True, guarantee=Guarantee("none", "a clock"))
    results += sweep("replay", 0.01, reference=True, guarantee=None)
    results += sweep("good", shapes=MULTI_MODELS) + sweep("bad", 0.5, shapes=MULTI_MODELS)
    results += sweep("good", 1.0, protocol="generalisation")
    for result in results:
        write_result(folder / "results", result)
    (folder / "results" / "good" / "method.toml").write_text(
        'name = "good"\ntitle = "Good"\npaper = "A paper"\ncode = "a/b.py"\nguarantee = "none"\n'
        'hardware = "abacus"\nlink = "https://example.org/p?a=1&b=2"\n'
    )
    builder.build(folder / "results", folder)
    return (folder / "index.html").as_uri()


@pytest.fixture
def open_page(browser, address):
    """Opens the page; at the end nothing may have gone wrong, and nothing have been fetched."""
    contexts, wrong, asked = [], [], []

    def opened(hash_="", **options):
        context = browser.new_context(**{"viewport": {"width": 1280, "height": 900}, **options})
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: wrong.append(message.text))
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        page.goto(f"{address}{hash_}")
        return page

    yield opened
    for context in contexts:
        context.close()
    assert wrong == []
    assert {url.split("#")[0] for url in asked if not url.startswith("data:")} == {address}


def methods(page, kind="competitors"):
    """Return the methods that are seen in a group of rows, from above."""
    rows = page.locator(f".panel:visible .board:visible tbody.{kind} tr.row:visible")
    return rows.evaluate_all("rows => rows.map(row => row.dataset.method)")


def head(page, name):
    return page.locator(f".board:visible th:has(> [data-sort={name}])")


def test_sorting(open_page):
    page = open_page()
    assert methods(page) == ["good", "middle", "bad"]
    assert head(page, "rank").get_attribute("aria-sort") == "ascending"
    head(page, "frechet").locator("button").click()
    assert head(page, "frechet").get_attribute("aria-sort") == "ascending"  # the best first
    assert head(page, "rank").get_attribute("aria-sort") is None
    assert methods(page) == ["good", "middle", "bad"]
    head(page, "frechet").locator("button").press("Enter")
    assert head(page, "frechet").get_attribute("aria-sort") == "descending"
    assert methods(page) == ["bad", "middle", "good"]
    head(page, "converged").locator("button").press("Space")
    assert head(page, "converged").get_attribute("aria-sort") == "descending"
    assert methods(page) == ["good", "middle", "bad"]
    head(page, "name").locator("button").click()
    assert methods(page) == ["bad", "good", "middle"]
    assert methods(page, "references") == ["replay"]  # below, whatever is sorted by
    head(page, "guarantee").locator("button").click()
    assert methods(page)[-1] == "middle"


def test_filters(open_page):
    page = open_page()
    page.get_by_label("Method", exact=True).fill("OO")
    assert methods(page) == ["good"]
    assert page.locator("#count").inner_text() == "1 of 5 rows"
    page.get_by_label("Method", exact=True).fill("zzz")
    assert methods(page) == []
    assert page.locator(".board:visible .empty").is_visible()
    page.get_by_label("Method", exact=True).fill("")
    page.get_by_label("Guarantee").select_option("none")
    assert (methods(page), methods(page, "clock")) == (["middle"], ["clock"])
    page.locator("select[name=time]").select_option("yes")
    assert (methods(page), methods(page, "clock")) == ([], ["clock"])
    page.get_by_label("Guarantee").select_option("")
    page.locator("select[name=time]").select_option("no")
    assert methods(page, "clock") == []
    assert len(methods(page)) == 3


def test_tabs_by_keyboard(open_page):
    page = open_page()
    tabs = page.get_by_role("tab")
    assert tabs.all_inner_texts() == ["LASA-26", "LASA-Multi"]
    tabs.first.focus()
    page.keyboard.press("ArrowRight")
    chosen = page.get_by_role("tab", selected=True)
    assert chosen.inner_text() == "LASA-Multi"
    assert chosen.evaluate("tab => tab === document.activeElement")
    assert page.get_by_role("tabpanel").count() == 1  # the others are hidden
    assert methods(page) == ["bad", "good"]
    page.keyboard.press("Home")
    assert methods(page) == ["good", "middle", "bad"]
    page.keyboard.press("ArrowLeft")  # round
    assert page.get_by_role("tab", selected=True).inner_text() == "LASA-Multi"
    unselected = page.get_by_role("tab", selected=False)
    assert unselected.get_attribute("tabindex") == "-1"


def test_protocols(open_page):
    page = open_page()
    page.get_by_label("generalisation", exact=True).check()
    assert page.get_by_role("heading", name="LASA-26: generalisation").is_visible()
    page.get_by_role("tab", name="LASA-Multi").click()  # was not run so
    assert page.get_by_role("heading", name="LASA-Multi: reproduction").is_visible()
    assert page.get_by_label("generalisation", exact=True).is_disabled()
    page.get_by_role("tab", name="LASA-26").click()
    assert page.get_by_role("heading", name="LASA-26: generalisation").is_visible()


def test_columns(open_page):
    page = open_page()
    assert head(page, "frechet").is_visible()
    assert not head(page, "n_parameters").is_visible()
    page.get_by_label("cost", exact=True).check()
    assert head(page, "n_parameters").is_visible()
    assert not head(page, "frechet").is_visible()
    page.get_by_label("all", exact=True).check()
    assert head(page, "n_parameters").is_visible()
    assert head(page, "frechet").is_visible()


def test_the_address_opens_the_same_view(open_page, address):
    page = open_page()
    page.get_by_label("Method", exact=True).fill("d")
    head(page, "frechet").locator("button").click()
    head(page, "frechet").locator("button").click()
    page.get_by_label("all", exact=True).check()
    seen = methods(page)
    assert seen == ["bad", "middle", "good"]
    again = open_page(page.url.removeprefix(address))
    assert methods(again) == seen
    assert again.get_by_label("Method", exact=True).input_value() == "d"
    assert head(again, "frechet").get_attribute("aria-sort") == "descending"
    assert head(again, "n_parameters").is_visible()
    page.evaluate("location.hash = 'family=LASA-Multi'")
    page.get_by_role("heading", name="LASA-Multi: reproduction").wait_for()


@pytest.mark.parametrize("hash_", ["#family=none&protocol=x&columns=y&sort=z&direction=w", "#%%%"])
def test_an_address_of_nonsense_opens_the_page(open_page, hash_):
    page = open_page(hash_)
    assert methods(page) == ["good", "middle", "bad"]
    assert head(page, "frechet").is_visible()


def test_details(open_page):
    page = open_page()
    opener = page.get_by_role("button", name="Middle").first
    assert opener.get_attribute("aria-expanded") == "false"
    opener.press("Enter")
    assert opener.get_attribute("aria-expanded") == "true"
    inside = page.locator(f"#{opener.get_attribute('aria-controls')}")
    text = inside.inner_text()
    assert "RuntimeError: it broke" in text
    assert f"1 cell: {SINGLE_MOTIONS[0]} (seed 0)\nRuntimeError: it broke" in text
    assert "abacus" in text
    assert "numpy 2.0" in text
    assert inside.locator("tbody tr").count() == 26
    head(page, "frechet").locator("button").click()
    head(page, "frechet").locator("button").click()
    above = inside.evaluate("row => row.previousElementSibling.dataset.method")
    assert above == "middle"  # details move with their row
    page.get_by_label("Method", exact=True).fill("good")
    assert not inside.is_visible()
    page.get_by_role("button", name="Good").first.click()
    assert "n_steps" in page.locator("tr.details:visible").inner_text()


def test_where_a_method_comes_from(open_page):
    page = open_page()
    page.get_by_role("button", name="Good").first.click()
    inside = page.locator("tr.details:visible")
    (link,) = inside.get_by_role("link").all()
    assert link.inner_text() == "A paper"
    assert link.get_attribute("href") == "https://example.org/p?a=1&b=2"
    assert link.get_attribute("rel") == "noopener"
    assert "a/b.py" in inside.inner_text()


def test_the_reason_of_a_guarantee(open_page):
    page = open_page()
    page.locator("tr[data-method=middle] .badge:visible").press("Enter")
    reason = page.locator("#reason")
    assert reason.inner_text() == "none: nothing in it says so"
    box = reason.bounding_box()
    assert 0 <= box["x"] <= box["x"] + box["width"] <= 1280
    page.keyboard.press("Escape")
    assert not reason.is_visible()


CONTRASTS = Path(__file__).with_name("contrasts.js").read_text(encoding="utf-8")


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1280, 390])
def test_it_can_be_read_in_either_colours_at_any_width(open_page, scheme, width):
    """Text has a contrast of 4.5 (WCAG 2.2, 1.4.3), and only tables and figures scroll aside."""
    page = open_page(color_scheme=scheme, viewport={"width": width, "height": 800})
    assert page.evaluate("document.documentElement.dataset.theme") == scheme
    page.get_by_role("button", name="Good").first.click()
    page.evaluate("document.querySelectorAll('details').forEach(d => { d.open = true; })")
    found = page.evaluate(CONTRASTS)
    assert found["n"] > 300
    assert found["low"] == []
    assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_what_is_wider_than_a_phone_says_that_it_scrolls(open_page):
    page = open_page(viewport={"width": 390, "height": 800})
    page.get_by_role("button", name="Good").first.click()
    areas = page.locator(".scroll:visible")
    assert areas.count() >= 5
    for area in areas.all():
        assert area.get_attribute("tabindex") == "0"
        assert area.get_attribute("role") == "region"
        assert area.get_attribute("aria-label")
    table = page.get_by_role("region", name="Scores, LASA-26, reproduction")
    line = table.locator("xpath=preceding-sibling::*[1]")
    figure = page.get_by_role("region", name="Figure: Every motion's scores")
    inside = page.get_by_role("region", name="Every motion's scores", exact=True)
    for area in (table, figure, inside):
        above = area.locator("xpath=preceding-sibling::*[1]")
        above.wait_for()
        assert above.inner_text() == "Scroll sideways for the rest →"
        assert "gradient" in area.evaluate("area => getComputedStyle(area).maskImage")
    page.locator("select[name=time]").focus()
    page.keyboard.press("Tab")
    assert table.evaluate("area => getComputedStyle(area).outlineStyle") == "solid"
    assert table.evaluate("area => getComputedStyle(area).maskImage") == "none"  # nor the outline
    page.keyboard.press("ArrowRight")
    page.wait_for_function("area => area.scrollLeft > 0", arg=table.element_handle())
    table.evaluate("area => { area.scrollLeft = area.scrollWidth; }")
    page.wait_for_function("area => !area.classList.contains('more')", arg=table.element_handle())
    assert line.is_visible()  # there is more on the other side
    page.set_viewport_size({"width": 1600, "height": 800})
    line.wait_for(state="hidden")
    assert not figure.locator("xpath=preceding-sibling::*[1]").is_visible()
    assert "more" not in figure.get_attribute("class")


def test_colours_by_the_button(open_page):
    page = open_page(color_scheme="light")
    page.get_by_role("button", name="Dark colours").click()
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(18, 24, 30)"
    page.reload()
    assert page.evaluate("document.documentElement.dataset.theme") == "dark"


def test_focus_is_seen_and_goes_down_the_page(open_page):
    page = open_page()
    tops = []
    for _ in range(12):
        page.keyboard.press("Tab")
        seen = page.evaluate(
            """() => {
              const e = document.activeElement;
              const shown = e.matches('.choice input') ? e.parentElement : e;
              return [shown.getBoundingClientRect().top, getComputedStyle(shown).outlineStyle];
            }"""
        )
        assert seen[1] != "none"
        tops.append(seen[0])
    assert all(b >= a - 80 for a, b in itertools.pairwise(tops))


def test_without_scripts_all_tables_are_there(browser, address):
    context = browser.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto(address)
    assert page.locator("table.scores:visible").count() == 3
    assert page.locator("tr.row:visible").count() == 5 + 1 + 2
    assert not page.get_by_role("tab").first.is_visible()
    context.close()
