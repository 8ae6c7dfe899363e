"""From the first stroke to streamlines: the page in a real browser, on a server that just started.

    python benchmarks/drawing.py [--runs 5] [--kind cycle]

Strokes are drawn by a mouse in real time, with a pause between them, and "Fit" is pressed at once.
"Lines" is when the first streamlines are drawn, "better" when those of the second training are;
both in seconds since the first stroke began, and since "Fit" was pressed. "CPU" is what the server
used until the lines were drawn, its imports among it. Needs the extra `draw`, playwright and a
Chromium. Other work on the machine makes wall time longer: the load is printed beside it.
"""

import os
import re
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from typing import Literal

import numpy as np
import psutil
import tyro
from playwright.sync_api import Browser, Page, sync_playwright

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
HEAD = "{:>9} {:>8} {:>8} {:>13} {:>9} {:>7} {:>6}"
LINE = "{:9.1f} {:8.1f} {:8.1f} {:13.1f} {:9.1f} {:7.1f} {:6.1f}"


@dataclass(frozen=True)
class Options:
    """What is drawn, and how often."""

    runs: int = 3
    """Servers that are started, one after the other."""
    kind: Literal["goal", "cycle"] = "goal"
    strokes: int = 3
    duration: float = 1.5
    """Seconds of a stroke; of one that repeats, of one of its three rounds."""
    pause: float = 0.5
    """Seconds between two strokes."""


def place(options: Options, stroke: int, share: float) -> tuple[float, float]:
    """Where the pen is, in millimetres, after a share of a stroke."""
    if options.kind == "cycle":
        angle = 6 * np.pi * share + stroke
        return 30 * np.cos(angle) + 7 * np.cos(2 * angle), 25 * np.sin(angle)
    s = share**3 * (10 - 15 * share + 6 * share**2)
    return -28 * np.sin(1.8 * np.pi * s) + 3 * stroke * (1 - s), 38 - 72 * s


def draw(page: Page, options: Options, stroke: int) -> None:
    """Draw a stroke in its own time."""
    box = page.locator("#surface").bounding_box()
    assert box is not None

    def go(share: float) -> None:
        x, y = place(options, stroke, share)
        page.mouse.move(
            box["x"] + (x + 50) / 100 * box["width"], box["y"] + (50 - y) / 100 * box["height"]
        )

    go(0.0)
    page.mouse.down()
    duration = options.duration * (3 if options.kind == "cycle" else 1)
    begin = time.perf_counter()
    while (share := (time.perf_counter() - begin) / duration) < 1:
        go(share)
        time.sleep(0.008)
    page.mouse.up()


def run(browser: Browser, options: Options) -> tuple[float, ...]:
    """Start a server, draw, fit; return the line of numbers."""
    command = [sys.executable, "-m", "iflow_gym.drawing", "--port", "0", "--no-open"]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        found = re.search(r"http\S+", server.stdout.readline())
        assert found is not None
        page = browser.new_page(viewport={"width": 1280, "height": 860})
        page.goto(found.group(0))
        if options.kind == "cycle":
            page.get_by_label("Goes round").check()
        begin = time.perf_counter()
        for stroke in range(options.strokes):
            if stroke:
                time.sleep(options.pause)
            draw(page, options, stroke)
        drawn = time.perf_counter()
        page.get_by_role("button", name="Fit").click()
        page.locator("#field:not([data-lines='0'])").wait_for(state="attached")
        lines, times = time.perf_counter(), psutil.Process(server.pid).cpu_times()
        page.locator("#running").wait_for(state="hidden")
        better = time.perf_counter()
        page.close()
    finally:
        server.terminate()
        server.wait()
    cpu = times.user + times.system
    load = os.getloadavg()[0]
    return drawn - begin, lines - begin, better - begin, lines - drawn, better - drawn, cpu, load


def main(options: Options) -> None:
    """Print a line for each run, and the medians."""
    path = next(found for name in BROWSERS if (found := shutil.which(name)))
    print(f"{os.cpu_count()} cores, {options.strokes} strokes that {options.kind}")
    print(
        HEAD.format("drawn (s)", "lines", "better", "lines - drawn", "- drawn", "CPU (s)", "load")
    )
    with sync_playwright() as playwright:
        sandbox = ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
        browser = playwright.chromium.launch(executable_path=path, args=sandbox)
        found = []
        for _ in range(options.runs):
            found.append(run(browser, options))
            print(LINE.format(*found[-1]), flush=True)
        browser.close()
    print(LINE.format(*np.median(found, axis=0)), "median")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
