"""The page in a real browser: motions are drawn, fitted, looked at, pushed and saved."""

import re
import time
from pathlib import Path

import numpy as np
import pytest
from drawing_hands import ellipse, reach

from iflow_gym.baselines.imitation_flow import ImitationFlow

sync_api = pytest.importorskip(
    "playwright.sync_api", reason="the browser tests need playwright: pip install -e '.[test]'"
)

CONTRASTS = (Path(__file__).parents[1] / "contrasts.js").read_text(encoding="utf-8")
REFUSED = ("responded with a status of 422", "responded with a status of 500")
"""What the browser's console says where the server refuses a drawing, or fails."""

PATIENCE = 120_000
"""Milliseconds that a busy machine is given for what takes one or two."""


@pytest.fixture
def open_page(browser, server):
    """Opens the page; at the end nothing may have gone wrong, or been asked of anyone else."""
    contexts, wrong, asked = [], [], []

    def opened(**options):
        context = browser.new_context(**{"viewport": {"width": 1100, "height": 800}, **options})
        context.set_default_timeout(PATIENCE)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: wrong.append(message.text))
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        page.goto(server.address)
        return page

    yield opened
    for context in contexts:
        context.close()
    assert [text for text in wrong if not any(known in text for known in REFUSED)] == []
    assert all(url.startswith((f"{server.address}/", "data:")) for url in asked)


def on_screen(page, places):
    """Pixels of places in millimetres, shape (..., 2)."""
    box = page.locator("#surface").bounding_box()
    corner, scale = np.array([box["x"], box["y"]]), box["width"] / 100
    return corner + (np.array([50, 50]) + np.asarray(places) * [1, -1]) * scale


def draw(page, stroke):
    """Draw a stroke (t, x, y) by the mouse, at about its own speed."""
    pixels = on_screen(page, stroke[:, 1:])
    page.mouse.move(*pixels[0])
    page.mouse.down()
    begin = time.monotonic()
    for t, pixel in zip(stroke[1:, 0], pixels[1:], strict=True):
        if (ahead := t - (time.monotonic() - begin)) > 0:
            time.sleep(ahead)
        page.mouse.move(*pixel)
    page.mouse.up()


def fit(page):
    before = page.evaluate("page.fit && page.fit.id")
    page.get_by_role("button", name="Fit").click()
    # A fit can be over before anybody looks, so the wait is for another one that runs no more.
    page.wait_for_function(
        "before => page.fit && page.fit.id !== before && !page.fit.running", arg=before
    )
    assert not page.locator("#wrong").is_visible()


def pixels_of_the_field(page):
    """How many pixels of the lower canvas are streamlines: blue, and not the grid's grey."""
    return page.evaluate(
        """() => {
          const canvas = document.getElementById("field");
          const copy = new OffscreenCanvas(canvas.width, canvas.height);
          const brush = copy.getContext("2d", { willReadFrequently: true });
          brush.drawImage(canvas, 0, 0);
          const { data } = brush.getImageData(0, 0, canvas.width, canvas.height);
          let n = 0;
          for (let i = 0; i < data.length; i += 4) {
            n += data[i + 3] > 99 && data[i + 2] > data[i] + 12;
          }
          return n / (canvas.width * canvas.height);
        }"""
    )


def places(page):
    """Where the points are, as the page says."""
    page.evaluate("document.querySelectorAll('details').forEach(d => { d.open = true; })")
    listed = page.locator("#places li").all_inner_texts()
    return [tuple(map(float, re.match(r"\((\S+), (\S+)\)", text).groups())) for text in listed]


def test_draw_fit_see_push_save(open_page, server):
    page = open_page()
    assert page.get_by_role("button", name="Fit").is_disabled()
    assert pixels_of_the_field(page) == 0
    for k in range(3):
        draw(page, reach(k, 0.5)[::2])
    assert page.locator("#strokes li").count() == 3
    fit(page)
    assert page.locator("#guarantee").inner_text() == "proved"
    assert "60 steps" in page.locator("#learned").inner_text()
    assert int(page.locator("#field").get_attribute("data-lines")) > 20
    assert 0.02 < pixels_of_the_field(page) < 0.5

    page.mouse.click(*on_screen(page, (-35, 20)))
    page.get_by_text("1 point: 1 within 1 mm of the goal.").wait_for()
    (goal,) = places(page)
    assert goal == pytest.approx((20, -30), abs=3)  # where the strokes were drawn to

    x, y = on_screen(page, goal)  # pushed: dragged away, and let go
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(*on_screen(page, (0, 0)), steps=5)
    page.get_by_text("0 within 1 mm of the goal").wait_for()
    page.get_by_text("held").wait_for()
    assert places(page) == [pytest.approx((0, 0), abs=0.5)]
    page.mouse.up()
    page.get_by_text("1 point: 1 within 1 mm of the goal.").wait_for()

    page.get_by_label("Name").fill("by hand / ..")
    page.get_by_role("button", name="Save").click()
    page.get_by_text("Saved").wait_for()
    table, model = (server.folder / f"by-hand.{ending}" for ending in ("csv", "safetensors"))
    assert str(table) in page.locator("#saved").inner_text()
    system = ImitationFlow.load(model)
    shown = page.evaluate("page.fit.field")
    nodes = np.linspace(-shown["half"], shown["half"], shown["n"])
    grid = np.stack(np.meshgrid(nodes, nodes), axis=-1)
    assert np.reshape(shown["velocities"], grid.shape) == pytest.approx(
        system.velocity(grid), abs=1e-5
    )
    rows = np.genfromtxt(table, delimiter=",", skip_header=1)
    assert set(rows[:, 0]) == {0, 1, 2}
    assert rows[rows[:, 0] == 1][-1, 2:] == pytest.approx(system.goal_)
    assert rows[0, 2:] == pytest.approx((20, 35), abs=3)

    page.get_by_role("button", name="Refine").click()
    page.get_by_text("100 steps:").wait_for()
    assert not page.get_by_role("button", name="Refine").is_visible()


def test_a_cycle_and_points_that_come_to_it(open_page):
    page = open_page()
    page.get_by_label("Goes round").check()
    draw(page, ellipse(1.1, 0.8))
    page.get_by_role("button", name="Fit").click()
    page.get_by_role("alert").get_by_text("Stroke 1").wait_for()
    assert "1.5 times" in page.get_by_role("alert").inner_text()
    page.get_by_role("button", name="Delete stroke 1").click()
    page.get_by_role("button", name="Example").click()
    fit(page)
    page.get_by_role("button", name="Drop 25").click()
    page.get_by_text(re.compile(r"25 points, at most [0-4]\.\d mm from your strokes")).wait_for()
    before = places(page)
    page.wait_for_timeout(300)
    assert max(np.linalg.norm(np.subtract(places(page), before), axis=1)) > 5  # they go on
    page.get_by_role("button", name="Push all").click()
    page.get_by_role("button", name="Remove all").click()
    assert page.locator("#count").inner_text() == "No points yet."


def test_strokes_can_be_taken_back(open_page):
    page = open_page()
    page.get_by_role("button", name="Example").click()
    rows = page.locator("#strokes li")
    assert rows.count() == 3
    page.get_by_role("button", name="Delete stroke 2").click()
    assert rows.count() == 2
    page.get_by_role("button", name="Clear").click()
    assert rows.count() == 0
    assert page.get_by_role("button", name="Fit").is_disabled()
    page.get_by_role("button", name="Undo").click()
    page.keyboard.press("Control+z")
    assert rows.count() == 3
    page.mouse.click(*on_screen(page, (0, 0)))
    page.get_by_text("a dot rather than a stroke").wait_for()
    assert rows.count() == 3


def test_by_keyboard_alone(open_page):
    page = open_page()
    page.locator("#surface").focus()
    page.keyboard.press("Enter")
    for key in ["ArrowLeft"] * 6 + ["ArrowUp"] * 6 + ["ArrowLeft"] * 6:
        page.keyboard.press(key, delay=15)
    page.keyboard.press("Enter")
    assert page.locator("#strokes li").inner_text().endswith("36 mm\nDelete")
    page.get_by_role("button", name="Fit").press("Enter")
    page.locator("#points-card").wait_for()
    page.locator("#surface").focus()
    page.keyboard.press("Shift+ArrowDown")
    page.keyboard.press("Enter")
    page.get_by_text("1 point: 1 within 1 mm of the goal.").wait_for()
    page.keyboard.press("Delete")
    assert page.locator("#count").inner_text() == "No points yet."


def test_by_finger_on_a_phone(open_page):
    page = open_page(viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True)
    hand = page.context.new_cdp_session(page)
    for k in range(2):
        stroke = reach(k, 0.4)[::2]
        for t, (x, y) in zip(stroke[:, 0], on_screen(page, stroke[:, 1:]), strict=True):
            kind = "touchMove" if t else "touchStart"
            hand.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": [{"x": x, "y": y}]})
            time.sleep(0.01)
        hand.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    assert page.locator("#strokes li").count() == 2
    assert page.evaluate("window.scrollY") == 0  # the finger drew, and did not scroll
    fit(page)
    page.locator("#surface").scroll_into_view_if_needed()
    page.touchscreen.tap(*on_screen(page, (-30, -30)))
    page.get_by_text("1 point: 1 within 1 mm of the goal.").wait_for()


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1280, 360])
def test_it_can_be_read_in_either_colours_at_any_width(open_page, scheme, width):
    """Text has a contrast of 4.5 (WCAG 2.2, 1.4.3), and nothing scrolls aside."""
    page = open_page(color_scheme=scheme, viewport={"width": width, "height": 800})
    page.get_by_role("button", name="Example").click()
    page.get_by_role("combobox").select_option(label="Stable linear")
    fit(page)
    page.get_by_role("button", name="Drop 25").click()
    page.evaluate("document.querySelectorAll('details').forEach(d => { d.open = true; })")
    found = page.evaluate(CONTRASTS)
    assert found["n"] > 35
    assert found["low"] == []
    assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_what_gets_lost_is_said_to(open_page):
    """The server's word for it is enough: the path ends, and nothing more is asked for."""
    page = open_page()
    page.get_by_role("button", name="Example").click()
    page.get_by_role("combobox").select_option(label="LWR")
    fit(page)
    assert page.locator("#guarantee").inner_text() == "none"
    lost = {"version": 1, "dt": 0.004, "paths": [[[0, 0], [90, 0]]], "lost": [True]}
    page.route("**/paths", lambda route: route.fulfill(json=lost))
    page.mouse.click(*on_screen(page, (0, 0)))
    page.get_by_text("1 point: 0 within 1 mm of the goal; 1 left the sheet for good.").wait_for()


def test_a_server_that_is_gone_is_said(open_page):
    page = open_page()
    page.get_by_role("button", name="Example").click()
    page.route("**/fits", lambda route: route.fulfill(status=500, body="no JSON"))
    page.get_by_role("button", name="Fit").click()
    page.get_by_role("alert").get_by_text("The server failed (500).").wait_for()
    assert page.get_by_role("button", name="Fit").is_enabled()
