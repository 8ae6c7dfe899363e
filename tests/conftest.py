"""Fixtures of several files of tests."""

import importlib
import importlib.util
import sys
from pathlib import Path

import pytest

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
