"""Make docs/images/draw.png: the page on which motions are drawn, in a real browser.

    python docs/draw.py

Needs the extra `draw`, playwright and a Chromium. What is drawn is the page's own example.
"""

import io
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

IMAGE = Path(__file__).parent / "images" / "draw.png"
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
SIZE = {"width": 1060, "height": 940}


def main() -> None:
    """Start a server, fit the example, drop points, take the picture while they run."""
    path = next(found for name in BROWSERS if (found := shutil.which(name)))
    command = [sys.executable, "-m", "iflow_gym.drawing", "--port", "0", "--no-open"]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        found = re.search(r"http\S+", server.stdout.readline())
        with sync_playwright() as playwright:
            sandbox = ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
            browser = playwright.chromium.launch(executable_path=path, args=sandbox)
            page = browser.new_page(viewport=SIZE, color_scheme="light")
            page.goto(found.group(0))
            page.get_by_role("button", name="Example").click()
            page.get_by_role("button", name="Fit").click()
            page.locator("#running").wait_for()
            page.locator("#running").wait_for(state="hidden")
            page.get_by_role("button", name="Drop 25").click()
            page.locator("#places li").nth(24).wait_for(state="attached")
            page.wait_for_timeout(600)
            page.mouse.move(5, 5)
            page.evaluate("window.scrollTo(0, 0)")
            picture = Image.open(io.BytesIO(page.screenshot()))
            browser.close()
    finally:
        server.terminate()
        server.wait()
    indexed = picture.convert("RGB").quantize(256, method=Image.Quantize.FASTOCTREE)
    indexed.save(IMAGE, optimize=True)


if __name__ == "__main__":
    main()
