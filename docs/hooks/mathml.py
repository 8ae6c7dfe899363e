"""Mathematics as MathML, which browsers draw by themselves: no script, no font, no network.

``pymdownx.arithmatex`` finds the TeX, in pages and in docstrings; here each piece is converted when
the page is built. A command that the converter does not know is a warning, and so an error with
``--strict``.
"""

import html
import re
from typing import Any

from latex2mathml.converter import convert
from mkdocs.plugins import get_plugin_logger

log = get_plugin_logger("mathml")

TEX = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\\[(\[](?P<tex>.*?)\\[)\]]</(?P=tag)>', flags=re.S
)


def mathml(tex: str, *, block: bool) -> str:
    """Return TeX as a MathML element that keeps its source as an annotation.

    Raises
    ------
    ValueError
        If there is a command in it that cannot be converted.
    """
    known = re.sub(r"\\arg\\(min|max)(?![a-z])", r"\\operatorname{arg\\,\1}", tex)
    element = convert(known, display="block" if block else "inline")
    # A norm's bars would stretch as far as the highest exponent, and the one that has it would not.
    element = element.replace("<mo>&#x02016;</mo>", '<mo stretchy="false">&#x02016;</mo>')
    if unknown := re.findall(r">(\\[A-Za-z]+)<", element):
        raise ValueError(f"Expected TeX that can be converted, got {unknown} in {tex!r}.")
    body = element[element.index(">") + 1 : element.rindex("</math>")]
    note = f'<annotation encoding="application/x-tex">{html.escape(tex, quote=False)}</annotation>'
    head = element[: element.index(">") + 1]
    return f"{head}<semantics>{body}{note}</semantics></math>"


def on_page_content(content: str, page: Any, **_: Any) -> str:
    """Convert all TeX of a page."""

    def converted(match: re.Match[str]) -> str:
        block = match["tag"] == "div"
        try:
            element = mathml(html.unescape(match["tex"]).strip(), block=block)
        except Exception as error:
            log.warning("%s: %s", page.file.src_uri, error)
            return match[0]
        return f'<div class="math-block">{element}</div>' if block else element

    return TEX.sub(converted, content)
