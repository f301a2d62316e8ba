"""Docstrings of a dataclass's fields, which Python itself does not keep."""

import ast
import inspect
import textwrap
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

_READ: dict[type[Any], Mapping[str, str]] = {}
"""By class: to parse the source of a method's settings takes a tenth of a second."""


def field_docs(kind: type[Any]) -> Mapping[str, str]:
    """Docstring of each field by name, in one line; none where the source is not at hand."""
    if kind not in _READ:
        _READ[kind] = _read(kind)
    return _READ[kind]


def _read(kind: type[Any]) -> dict[str, str]:
    docs = {}
    for base in reversed(kind.__mro__):
        try:
            tree = ast.parse(textwrap.dedent(inspect.getsource(base)))
        except (OSError, TypeError, SyntaxError):
            continue
        for pair in pairwise(part for node in tree.body for part in getattr(node, "body", [])):
            match pair:
                case (
                    ast.AnnAssign(target=ast.Name(id=name)),
                    ast.Expr(value=ast.Constant(value=str(text))),
                ):
                    docs[name] = " ".join(text.split())
    return docs
