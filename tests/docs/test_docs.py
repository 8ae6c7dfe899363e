"""The documentation is true: its snippets run, its links lead somewhere, its pages are current."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))]


def load(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


_snippets = load(Path(__file__).with_name("snippets.py"))
python_snippets, snippets = _snippets.python_snippets, _snippets.snippets

SNIPPETS = [
    pytest.param(text, id=f"{page.relative_to(ROOT)}-{i}")
    for page in PAGES
    for i, text in enumerate(python_snippets(page))
]


@pytest.mark.parametrize("snippet", SNIPPETS)
def test_snippet_runs_from_a_neutral_folder(snippet, tmp_path):
    script = tmp_path / "snippet.py"
    script.write_text(snippet)
    done = subprocess.run(
        [sys.executable, "-W", "error", script.name],
        cwd=tmp_path,
        env=os.environ | {"OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    for line, said in re.findall(r"^(print\(.*?\))  # (True|False|proved)", snippet, flags=re.M):
        assert said in done.stdout, f"{line} was to print {said}:\n{done.stdout}"


COMMANDS = """\
import contextlib, runpy, shlex, sys
from iflow_gym.cli import run

for line in open(sys.argv[1]):
    words = shlex.split(line)
    output = sys.stdout
    if ">" in words:
        words, output = words[:-2], open(words[-1], "w")
    with contextlib.redirect_stdout(output):
        if words[0] == "python":
            runpy.run_path(words[1])
        else:
            assert words[0] == "iflow-gym" and run(words[1:]) == 0, line
    output.flush()
"""
"""Runs a page's commands in one process, which imports what is heavy once."""


def test_the_commands_of_the_page_on_own_motions_run_one_after_another(tmp_path):
    """As a person types them, in a folder with the recording."""
    page = ROOT / "docs" / "your-own-motions.md"
    commands = "".join(snippets(page, "sh"))
    assert commands.count("iflow-gym ") >= 5
    (tmp_path / "commands").write_text(commands)
    (tmp_path / "run_all.py").write_text(COMMANDS)
    drawn = subprocess.run(
        [sys.executable, ROOT / "docs" / "hand_drawn.py"], capture_output=True, check=True
    )
    (tmp_path / "reach.csv").write_bytes(drawn.stdout)
    done = subprocess.run(
        [sys.executable, "-W", "error", "run_all.py", "commands"],
        cwd=tmp_path,
        env=os.environ | {"OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "Stability: proved." in done.stdout
    made = {p.name for p in tmp_path.iterdir()}
    assert {"reach.png", "field.png", "policy.onnx", "unseen.json", "path.csv"} <= made
    said = [
        line
        for line in page.read_text().splitlines()
        if line.startswith(("reach.csv", "lengths", "the motion"))
    ]
    assert len(said) >= 6
    for line in said:
        assert line in done.stderr, f"the page quotes a line that is not said: {line}"


def test_there_are_snippets():
    assert len(SNIPPETS) >= 5


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", page.read_text()):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_generated_pages_are_current():
    generate = load(ROOT / "docs" / "generate.py")
    for name, page in generate.PAGES.items():
        written = (ROOT / "docs" / name).read_text()
        assert written == page(), f"docs/{name} is stale: run `python docs/generate.py`."
