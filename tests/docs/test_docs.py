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


def test_the_commands_of_the_page_on_own_motions_run_one_after_another(tmp_path):
    """As a person types them, in a folder with the recording."""
    commands = "".join(snippets(ROOT / "docs" / "your-own-motions.md", "sh"))
    assert commands.count("iflow-gym ") >= 5
    path = tmp_path / "bin"
    path.mkdir()
    for name, line in (("iflow-gym", "-m iflow_gym"), ("python", "")):
        shim = path / name
        shim.write_text(f'#!/bin/sh\nexec "{sys.executable}" -W error {line} "$@"\n')
        shim.chmod(0o755)
    folder = tmp_path / "work"
    folder.mkdir()
    drawn = subprocess.run(
        [sys.executable, ROOT / "docs" / "hand_drawn.py"], capture_output=True, check=True
    )
    (folder / "reach.csv").write_bytes(drawn.stdout)
    environ = {"OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    done = subprocess.run(
        ["sh", "-e", "-c", commands],
        cwd=folder,
        env=os.environ | environ | {"PATH": f"{path}{os.pathsep}{os.environ['PATH']}"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "Stability: proved." in done.stdout
    made = {p.name for p in folder.iterdir()}
    assert {"reach.png", "field.png", "policy.onnx", "unseen.json", "path.csv"} <= made
    page = (ROOT / "docs" / "your-own-motions.md").read_text()
    said = [
        line
        for line in page.splitlines()
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
