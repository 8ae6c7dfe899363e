"""A method is one file, one line of the registry, one preset and one page, and nothing else."""

import ast
import re
import tomllib
from pathlib import Path

import pytest

from iflow_gym.baselines.registry import METHODS, REFERENCES
from iflow_gym.baselines.runner.presets import PRESETS

ROOT = Path(__file__).parents[2]
BASELINES = ROOT / "baselines"
PAGES = sorted((ROOT / "docs" / "methods").glob("*.md"))

SHOWN = {"imitation-flow"}
"""What the leaderboard shows every shape of: the suite's own method."""

every_method = pytest.mark.parametrize("name", METHODS)


def module_of(name):
    return METHODS[name].partition(":")[0]


def sources():
    """Every source file of the package, of the leaderboard, and of the scripts of the docs."""
    folders = [ROOT / f for f in ("iflow_gym", "envs", "baselines", "leaderboard", "docs")]
    return [path for folder in folders for path in sorted(folder.rglob("*.py"))]


def named_in(path):
    """Return the modules that a file imports and the texts that stand in it as values."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    imported, texts = set(), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            imported |= {node.module, *(f"{node.module}.{a.name}" for a in node.names)}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            texts.add(node.value)
    return imported, texts


@every_method
def test_has_one_module_of_its_own(name):
    assert list(map(module_of, METHODS)).count(module_of(name)) == 1
    place = BASELINES / module_of(name).removeprefix("iflow_gym.baselines.").replace(".", "/")
    assert place.with_suffix(".py").is_file() != (place / "__init__.py").is_file()


@every_method
def test_has_one_line_of_the_registry(name):
    text = (BASELINES / "registry.py").read_text(encoding="utf-8")
    assert len(re.findall(rf'^    "{name}": "{METHODS[name]}",$', text, flags=re.M)) == 1
    assert name not in REFERENCES


@every_method
def test_has_one_preset_with_every_section(name):
    preset = BASELINES / "presets" / f"{name}.toml"
    assert set(PRESETS) == set(tomllib.loads(preset.read_text(encoding="utf-8")))


def test_there_are_no_presets_without_a_method():
    presets = {path.stem for path in (BASELINES / "presets").glob("*.toml")}
    assert presets == {*METHODS, "run"}


@every_method
def test_has_one_page(name):
    """A page of its own name, or a heading with it on a page of several."""
    own = [page for page in PAGES if page.stem == name]
    headings = [
        page for page in PAGES if re.search(rf"^##? `{name}`", page.read_text(), flags=re.M)
    ]
    assert len({*own, *headings}) == 1


@every_method
def test_is_named_nowhere_else(name):
    """Neither the package nor the leaderboard knows it: whatever is to be known, its class says.

    Methods that build on it, in `baselines`, import what they need of it, and in the folder of a
    method a setting may have its name.
    """
    for path in sources():
        if path.parent.name == name.replace("-", "_") or path == BASELINES / "registry.py":
            continue
        imported, texts = named_in(path)
        beside = path.is_relative_to(BASELINES) and path.parent.name != "runner"
        is_docs = path.parent.name == "docs"
        if not beside and not is_docs:
            assert not any(m.startswith(module_of(name)) for m in imported), path
        if beside and path.parent != BASELINES:
            continue
        if name not in SHOWN and path.stem != module_of(name).rpartition(".")[2]:
            assert name not in texts, path
