"""The commands' help: what stands below a field is one paragraph, in tyro's words."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import textwrap
from itertools import pairwise
from typing import Annotated, Any, get_type_hints

from tyro.conf import arg


def field_texts(cls: type[Any]) -> dict[str, str]:
    """Return the docstring below each field of a dataclass, and of its bases, each in a line."""
    texts: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        try:
            tree = ast.parse(textwrap.dedent(inspect.getsource(base)))
        except (OSError, SyntaxError, TypeError):
            continue
        body = tree.body[0].body if tree.body and isinstance(tree.body[0], ast.ClassDef) else []
        for before, after in pairwise(body):
            if (
                isinstance(before, ast.AnnAssign)
                and isinstance(before.target, ast.Name)
                and isinstance(after, ast.Expr)
                and isinstance(after.value, ast.Constant)
                and isinstance(after.value.value, str)
            ):
                texts[before.target.id] = " ".join(after.value.value.split())
    return texts


_told: set[type[Any]] = set()
"""Classes whose annotations have their texts."""


def say_in_help(cls: type[Any]) -> None:
    """Give tyro the fields' texts as paragraphs: it takes indented lines for ones of their own.

    Defaults that are nothing are left out: the texts say what they mean.
    """
    if cls in _told:
        return
    _told.add(cls)
    hints = get_type_hints(cls, include_extras=True)
    texts = field_texts(cls)
    for field in dataclasses.fields(cls):
        hint = hints[field.name]
        inner = getattr(hint, "__origin__", hint)
        if isinstance(inner, type) and dataclasses.is_dataclass(inner):
            say_in_help(inner)
        said = (lambda default: "") if field.default in (None, ()) else None
        about = arg(help=texts.get(field.name), help_behavior_hint=said)
        cls.__annotations__[field.name] = Annotated[hint, about]
