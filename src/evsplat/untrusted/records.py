"""JSON records that evsplat wrote, and that are checked when they are read back."""

from pathlib import Path
from typing import Any

from evsplat.errors import DataError
from evsplat.untrusted.faults import brief
from evsplat.untrusted.text import read_json

Shape = Any
"""A type; a tuple of types; ``[shape]``, a list of such; ``{"key": shape}``, an object with these
keys and perhaps others; ``{str: shape}``, one with any keys."""
_WORDS: dict[type, str] = {int: "a whole number", float: "a number", str: "a text"}
_WORDS |= {bool: "true or false", type(None): "null", list: "a list", dict: "an object"}


def read_record(path: Path, shape: Shape, remedy: str) -> Any:
    """JSON of a shape; another, or none at all, is a `DataError` that ends with ``remedy``."""
    if not path.exists():
        raise DataError(f"{path}: file not found; {remedy}.")
    value = read_json(path)
    wrong = misfit(value, shape)
    if wrong:
        raise DataError(f"{path}: {wrong}; {remedy}.")
    return value


def misfit(value: Any, shape: Shape, where: str = "") -> str:
    """What of ``value`` has not the shape, in words; "" where all has."""
    if isinstance(shape, list):
        entries: Any = enumerate(value) if isinstance(value, list) else None
        inner: dict[Any, Shape] = {list: shape[0]}
    elif isinstance(shape, dict):
        entries = value.items() if isinstance(value, dict) else None
        inner = shape
    else:
        kinds = shape if isinstance(shape, tuple) else (shape,)
        return "" if any(_is(value, kind) for kind in kinds) else _said(where, value, kinds)
    if entries is None:
        return _said(where, value, (type(shape),))
    missing = [key for key in inner if isinstance(key, str) and key not in value]
    if missing:
        return f"{where or 'it'} has no {missing[0]}"
    for key, entry in entries:
        each = inner.get(key, inner.get(str, inner.get(list)))
        name = key if str(key).isidentifier() else brief(key)
        found = "" if each is None else misfit(entry, each, f"{where}.{name}".strip("."))
        if found:
            return found
    return ""


def _is(value: Any, kind: type) -> bool:
    if kind is float:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        return number and abs(value) < 1e300
    if kind is int:
        return isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**63
    return isinstance(value, kind)


def _said(where: str, value: Any, kinds: tuple[type, ...]) -> str:
    expected = " or ".join(_WORDS.get(kind, kind.__name__) for kind in kinds)
    return f"{where or 'it'} is {brief(value)}, expected {expected}"
