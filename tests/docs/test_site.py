"""The documentation as a site: it builds with warnings as errors, and needs nothing from elsewhere.

One build, in a process of its own; what is said of the site is read from its HTML.
"""

import fcntl
import importlib.util
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import gymnasium
import pytest

import iflow_gym  # noqa: F401 (registers the environments)
from iflow_gym.baselines.registry import METHODS, load_method

for needed in ("mkdocs", "material", "mkdocstrings", "latex2mathml"):
    pytest.importorskip(needed, reason="pip install 'iflow-gym[docs]'")

ROOT = Path(__file__).parents[2]


def load(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


FETCHED = {"script": "src", "img": "src", "iframe": "src", "source": "src", "link": "href"}
SILENT = ("pre", "code", "script", "style", "annotation")


class Page(HTMLParser):
    """Anchors, links, and what a browser would fetch; text that is no code."""

    def __init__(self, path):
        super().__init__()
        self.anchors, self.links, self.fetched, self.text = set(), [], [], []
        self.maths, self._silent = 0, 0
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attributes):
        found = dict(attributes)
        self.anchors |= {found[k] for k in ("id", "name") if found.get(k)}
        self.maths += tag == "math"
        self._silent += tag in SILENT
        if tag == "a" and "href" in found:
            self.links.append(found["href"])
        if found.get(FETCHED.get(tag)) and found.get("rel") not in (
            "canonical",
            "next",
            "prev",
        ):
            self.fetched.append(found[FETCHED[tag]])

    def handle_endtag(self, tag):
        self._silent -= tag in SILENT

    def handle_data(self, data):
        if not self._silent:
            self.text.append(data)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    place = shared / "site"
    with open(shared / "site.lock", "w") as lock:  # half a minute: once for all workers
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (place / "sitemap.xml").exists():
            build(place)
    # The board is a page of its own, with tests of its own.
    return {
        path.relative_to(place).as_posix(): path if path.suffix != ".html" else Page(path)
        for path in sorted(place.rglob("*"))
        if path.is_file()
    }


def build(place):
    settings = {
        "NO_MKDOCS_2_WARNING": "1",
        "PYTHONPATH": str(ROOT),
        "SITE_URL": "",
        "SOURCE_URL": "",
    }
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", place],
        cwd=ROOT,
        env=os.environ | settings,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def pages(site):
    own = ("404.html", "leaderboard/index.html")
    return {name: page for name, page in site.items() if isinstance(page, Page) and name not in own}


def test_links_and_their_anchors_lead_somewhere(site):
    for name, page in pages(site).items():
        for link in page.links + page.fetched:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = os.path.normpath(os.path.join(os.path.dirname(name), unquote(parts.path)))
            target = name if not parts.path else "index.html" if target == "." else target
            assert target in site, f"{name} leads to {link}"
            if parts.fragment and isinstance(site[target], Page) and link in page.links:
                anchors = site[target].anchors
                assert unquote(parts.fragment) in anchors, f"{name} leads to {link}"


def test_nothing_is_fetched_from_elsewhere(site):
    for name, page in site.items():
        if isinstance(page, Page):
            assert not [f for f in page.fetched if urlsplit(f).netloc], name
        elif page.suffix == ".css":
            text = page.read_text(encoding="utf-8")
            assert not re.search(r"url\(\s*[\"']?(https?:)?//", text), name
            assert "@import" not in text, name


def test_mathematics_is_mathml_and_no_tex_is_left(site):
    assert pages(site)["methods/imitation-flow.html"].maths >= 30
    assert pages(site)["reference/metrics.html"].maths > 10
    for name, page in pages(site).items():
        text = "".join(page.text)
        left = re.search(r".{0,30}(\$[^ \d]|\\[a-z]{2,}|\.\. math).{0,30}", text)
        assert left is None, f"{name}: {left[0]}"


def test_a_page_for_each_method_ends_with_its_class_and_settings(site):
    for name in METHODS:
        method, page = load_method(name), site[f"methods/{name}.html"]
        for documented in (method, method.Config):
            assert f"{documented.__module__}.{documented.__qualname__}" in page.anchors, name


def test_each_environment_is_on_a_page_with_a_picture(site):
    families = load(ROOT / "docs" / "generate.py").FAMILIES
    listed = {i for family in families for i in family.members or (family.ids,)}
    assert listed == {i for i in gymnasium.registry if i.startswith("iflow/")}
    for family in families:
        page = site[f"environments/{family.page}.html"]
        assert f"../images/{family.picture}" in page.fetched


def test_the_api_has_every_public_module(site):
    """But methods, which have pages of their own, and what lies behind what is documented."""
    hook = load(ROOT / "docs" / "hooks" / "reference.py")
    documented = {name for names in hook.MODULES.values() for name in names}
    inner = ("baselines", "evaluation", "leaderboard", "drumming")
    package = ROOT / "iflow_gym"
    modules = {
        f"iflow_gym.{path.relative_to(package).with_suffix('').as_posix().replace('/', '.')}"
        for folder in ("", "datasets", "envs", "metrics", "residual")
        for path in (package / folder).glob("*.py")
        if not path.name.startswith("_")
    }
    missing = {m for m in modules - documented if not set(m.split(".")) & set(inner)}
    assert missing == hook.INNER
    for page, names in hook.MODULES.items():
        for name in names:
            assert name in site[f"reference/{page}.html"].anchors


def test_the_front_page_is_the_readme_and_examples_have_pages(site):
    front = site["index.html"]
    assert "leaderboard/LEADERBOARD.html" in front.links
    listed = "".join(front.text)
    assert "%%" not in listed
    for title in ("Five minutes", "Quick start", "LASA", "Stable linear", "Residuals"):
        assert re.search(rf"^\s*{title}\s*$", listed, flags=re.M), title
    for script in (ROOT / "examples").glob("*.py"):
        page = site[f"examples/{script.stem.replace('_', '-')}.html"]
        assert f"images/{script.stem}.png" in page.fetched


@pytest.mark.parametrize(
    ("tex", "block"), [(r"\arg\max_k p(\tau \mid k)", False), (r"\lVert x \rVert^2", True)]
)
def test_tex_becomes_mathml(tex, block):
    element = load(ROOT / "docs" / "hooks" / "mathml.py").mathml(tex, block=block)
    assert ('display="block"' in element) == block
    assert re.sub(r"<annotation.*?</annotation>", "", element).count("\\") == 0


def test_tex_that_is_not_known_is_an_error():
    with pytest.raises(ValueError, match="frobnicate"):
        load(ROOT / "docs" / "hooks" / "mathml.py").mathml(r"\frobnicate{x}", block=False)


def test_directives_become_dollars():
    dollars = load(ROOT / "docs" / "hooks" / "docstrings.py").dollars
    text = "Distance.\n\n.. math:: a +\n    b\n\nMore,\n\n.. math::\n\n    c\n\nand more."
    assert dollars(text) == "Distance.\n\n$$a + b$$\n\nMore,\n\n$$c$$\n\nand more."
