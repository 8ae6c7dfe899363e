"""Pages of the site that are kept elsewhere in the repository, and links that lead there.

The README is the front page; the changelog, the leaderboard and the examples are pages, too. Pages
are written with the links that the repository needs. A link to a file that the site has is turned
into the site's, any other one leads to SOURCE_URL, or becomes plain text where that is not set.
"""

import os
import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[2]

PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "CHANGELOG.md",
    "leaderboard/LEADERBOARD.md": "leaderboard/LEADERBOARD.md",
}
"""Path in the repository to path in the site."""

ASSETS = ("leaderboard/index.html", "leaderboard/figures/*", "examples/images/*")
"""Files that go with them, at the same place."""

LINK = re.compile(
    r"(?P<image>!?)\[(?P<text>(?:[^\[\]]|!?\[[^\[\]]*\](?:\([^)]*\))?)*)\]\((?P<to>[^()\s]+)\)"
)
FENCE = re.compile(r"(^```.*?^```[ \t]*$)", flags=re.M | re.S)


def examples() -> dict[str, str]:
    """Return the examples: script to page."""
    scripts = sorted((ROOT / "examples").glob("*.py"))
    return {f"examples/{s.name}": f"examples/{s.stem.replace('_', '-')}.md" for s in scripts}


def example_page(script: str) -> str:
    """Return a script of cells (``# %%``) as Markdown, with where to find it."""
    cells = re.split(r"^# %%", (ROOT / script).read_text(encoding="utf-8"), flags=re.M)[1:]
    parts = []
    for cell in cells:
        head, _, body = cell.partition("\n")
        if "[markdown]" in head:
            text = re.sub(r"^# ?", "", body.strip(), flags=re.M)
            parts.append(text)
        elif body.strip():
            parts.append(f"```python\n{body.strip()}\n```")
    title, *rest = parts
    run = f"`python {script}` runs it; editors that know `# %%` cells open it as a notebook."
    return "\n\n".join([title, run, *rest]) + "\n"


def on_files(files: Files, config: Any, **_: Any) -> Files:
    """Add the pages, and what they show."""
    for source, place in PAGES.items():
        _add(files, config, place, (ROOT / source).read_text(encoding="utf-8"))
    for source, place in examples().items():
        _add(files, config, place, example_page(source))
    for pattern in ASSETS:
        for path in sorted(ROOT.glob(pattern)):
            place = path.relative_to(ROOT).as_posix()
            _add(files, config, place, path.read_bytes())
    return files


def _add(files: Files, config: Any, place: str, content: str | bytes) -> None:
    files.append(File.generated(config, place, content=content))


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files, **_: Any) -> str:
    """Turn the links of the repository into those of the site."""
    place = page.file.src_uri
    known = {v: k for k, v in (PAGES | examples()).items()}
    source = known.get(place, f"docs/{place}")
    if place in known:
        markdown = markdown.replace("<details>", '<details markdown="1">')

    def turned(match: re.Match[str]) -> str:
        to, mark, anchor = match["to"].partition("#")
        text = LINK.sub(turned, match["text"])
        if not to or re.match(r"[a-z]+:", to):
            return f"{match['image']}[{text}]({match['to']})"
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), to))
        inside = (PAGES | examples()).get(target, target.removeprefix("docs/"))
        if files.get_file_from_path(inside) is not None:
            there = posixpath.relpath(inside, posixpath.dirname(place) or ".")
            return f"{match['image']}[{text}]({there}{mark}{anchor})"
        if not os.path.exists(ROOT / target):  # mkdocs says which link is broken
            return match[0]
        base = (config.extra["source_url"] or "").rstrip("/")  # an empty variable reads as None
        return f"[{text}]({base}/{target}{mark}{anchor})" if base else text

    # Every second piece is fenced code, which holds no links.
    pieces = FENCE.split(markdown)
    pieces[::2] = [LINK.sub(turned, piece) for piece in pieces[::2]]
    return "".join(pieces)
