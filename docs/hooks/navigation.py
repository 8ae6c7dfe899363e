"""The parts of the navigation that follow from what there is: ``"@methods"`` and the like.

A new method or environment then needs no line in mkdocs.yml.
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from iflow_gym.baselines.registry import METHODS, load_method

DOCS = Path(__file__).parents[1]
ROOT = DOCS.parent
EXAMPLES = ("quick_start", "own_data", "residual_rl")
"""In the order in which they are to be read; others follow."""


def title_of(path: Path) -> str:
    """Return the first heading of a Markdown file or of a script of cells, without its marks."""
    mark = "# # " if path.suffix == ".py" else "# "
    match = re.search(rf"^{mark}(.+)$", path.read_text(encoding="utf-8"), flags=re.M)
    if match is None:
        raise ValueError(f"Expected a heading in {path}, got none.")
    return match[1].replace("`", "")


def methods() -> list[dict[str, str]]:
    """Return the methods' pages in the order of the registry, then the other pages beside them."""
    pages = {path.stem: path for path in sorted((DOCS / "methods").glob("*.md"))}
    order = [name for name in METHODS if name in pages]
    order += [name for name in pages if name not in METHODS]
    titles = {n: load_method(n).title if n in METHODS else title_of(pages[n]) for n in order}
    return [{titles[name]: f"methods/{name}.md"} for name in order]


def environments() -> list[dict[str, str]]:
    """Return the overview, the families in its order, and what is written on some of them."""
    overview = (DOCS / "environments.md").read_text(encoding="utf-8")
    pages = re.findall(r"\((environments/.+?\.md)\)", overview)
    families = [{_family(title_of(DOCS / page)): page} for page in pages]
    written = [{"On the letters": "letters.md"}, {"On drumming": "drumming.md"}]
    return [{"Overview": "environments.md"}, *families, *written]


def _family(env_id: str) -> str:
    """Return what of ``iflow/LASA-<Shape>-v0`` names the family."""
    return re.sub(r"^iflow/|-<\w+>|-v\d+$", "", env_id)


def examples() -> list[dict[str, str]]:
    """Return the examples' pages."""
    scripts = {path.stem: path for path in sorted((ROOT / "examples").glob("*.py"))}
    order = [name for name in EXAMPLES if name in scripts]
    order += [name for name in scripts if name not in EXAMPLES]
    pages = {name: f"examples/{name.replace('_', '-')}.md" for name in order}
    return [{title_of(scripts[name]): page} for name, page in pages.items()]


FILLED: dict[str, Callable[[], list[dict[str, str]]]] = {
    "@methods": methods,
    "@environments": environments,
    "@examples": examples,
}


def on_config(config: Any, **_: Any) -> Any:
    """Fill the navigation."""
    config.nav = [
        {title: FILLED[entry]() if isinstance(entry, str) and entry in FILLED else entry}
        for part in config.nav
        for title, entry in part.items()
    ]
    return config
