"""The examples run, with little training, and draw what their pages show."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))

every_example = pytest.mark.parametrize("script", EXAMPLES, ids=lambda path: path.stem)


def test_there_are_three():
    assert {path.stem for path in EXAMPLES} >= {"quick_start", "own_data", "residual_rl"}


@every_example
def test_example_runs_and_draws(script, tmp_path):
    text = script.read_text(encoding="utf-8")
    shown = re.findall(r"!\[.+\]\(images/(.+?)\)", text)
    assert shown == [f"{script.stem}.png"]
    settings = {"EXAMPLE_STEPS": "20", "EXAMPLE_SAMPLES": "4096", "EXAMPLE_IMAGES": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-W", "error", str(script)],
        cwd=tmp_path,
        env=os.environ | settings | {"OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "proved" in done.stdout  # however little was trained
    with Image.open(tmp_path / shown[0]) as drawn:
        assert drawn.size[0] > drawn.size[1] > 300
        assert len(drawn.convert("RGB").getcolors(maxcolors=1 << 24)) > 100
    assert (script.parent / "images" / shown[0]).is_file()


@every_example
def test_example_is_made_of_cells(script):
    """So that editors open it as a notebook, and the site makes a page of it."""
    cells = re.split(r"^# %%", script.read_text(encoding="utf-8"), flags=re.M)[1:]
    words, code = (
        [c for c in cells if ("[markdown]" in c.splitlines()[0]) == kind] for kind in (True, False)
    )
    assert words[0].splitlines()[1].startswith("# # ")
    assert len(words) >= 5
    assert len(code) >= 5
    for cell in words:
        assert all(line.startswith("#") or not line for line in cell.strip().splitlines()[1:])
