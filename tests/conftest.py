"""Fixtures of several files of tests."""

import importlib
import importlib.util
import os
import shutil
import sys
from pathlib import Path

import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
LEADERBOARD = Path(__file__).parents[1] / "leaderboard"


@pytest.fixture(scope="session")
def builder():
    """leaderboard/build.py, as the script finds its neighbours, under a name of its own."""
    sys.path.insert(0, str(LEADERBOARD))
    try:
        spec = importlib.util.spec_from_file_location("_leaderboard", LEADERBOARD / "build.py")
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module  # where dataclasses look themselves up
        spec.loader.exec_module(module)
        for name in ("comparisons", "drawings", "tables", "web"):
            setattr(module, name, importlib.import_module(name))
    finally:
        sys.path.remove(str(LEADERBOARD))
    return module


@pytest.fixture(scope="module")
def browser():
    """A headless Chromium; the test is skipped, with the reason, where there is none."""
    sync_api = pytest.importorskip(
        "playwright.sync_api", reason="the browser tests need playwright: pip install -e '.[test]'"
    )
    path = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if path is None:
        pytest.skip(f"no browser: none of {', '.join(BROWSERS)} is installed")
    sandbox = ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=sandbox)
        yield browser
        browser.close()
