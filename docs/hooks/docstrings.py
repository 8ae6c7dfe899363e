"""Docstrings have their equations as ``.. math::``; here they become TeX between dollars."""

import re
from typing import Any

from griffe import Extension, Object

MATH = re.compile(
    r"^(?P<indent>[ ]*)\.\. math::[ ]*(?P<first>.*)\n"
    r"(?P<rest>(?:(?P=indent)[ ]{4,}.*\n|[ ]*\n(?=(?P=indent)[ ]{4,}))*)",
    flags=re.M,
)


def dollars(text: str) -> str:
    """Return a docstring with each ``.. math::`` as a block between double dollars."""

    def block(match: re.Match[str]) -> str:
        lines = [match["first"], *match["rest"].splitlines()]
        tex = " ".join(line.strip() for line in lines if line.strip())
        return f"{match['indent']}$${tex}$$\n"

    return MATH.sub(block, text + "\n").removesuffix("\n")


class MathDirectives(Extension):
    """Rewrites the docstring of every object before it is read."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """Rewrite one."""
        if obj.docstring is not None and ".. math::" in obj.docstring.value:
            obj.docstring.value = dollars(obj.docstring.value)
