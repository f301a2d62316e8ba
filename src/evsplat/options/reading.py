"""How the command line reads a verb: its options in the order of its fields."""

from collections.abc import Iterator
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Annotated, Any, Generic, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from evsplat.field_docs import field_docs
from evsplat.options.declare import FLAT, LAST

IN_ORDER = ConstructorRegistry()
"""Context in which a verb's options stand as declared, those of a `FLAT` field in its place.

The parser itself puts them last, and breaks the lines of their docstrings.
"""


@IN_ORDER.struct_rule
def _in_order(info: StructTypeInfo) -> StructConstructorSpec | None:
    if not is_dataclass(info.type) or issubclass(info.type, Generic):
        return None  # the parser's own wrapper

    def make(**values: Any) -> Any:
        return _made(info.type, **values)

    make.__doc__ = info.type.__doc__  # the page's first lines
    return StructConstructorSpec(make, tuple(_options(info.type)))


def lists_of(kind: type[Any]) -> set[str]:
    """Options of a verb, such as "--set", that take any number of values."""
    return {
        f"--{_name(field.type) or field.name.replace('_', '-')}"
        for field in _options(kind)
        if get_origin(value := _bare(field.type)) is tuple and get_args(value)[-1] is Ellipsis
    }


def _name(hint: Any) -> str | None:
    """What an option is called where that is not its field's name."""
    return next(filter(None, (getattr(one, "name", None) for one in _marks(hint))), None)


def _bare(hint: Any) -> Any:
    return get_args(hint)[0] if get_origin(hint) is Annotated else hint


def _marks(hint: Any) -> tuple[Any, ...]:
    return getattr(hint, "__metadata__", ())


def _options(kind: type[Any]) -> Iterator[StructFieldSpec]:
    docs, hints = field_docs(kind), get_type_hints(kind, include_extras=True)
    for field in sorted(fields(kind), key=lambda field: _has(hints[field.name], LAST)):
        hint = hints[field.name]
        if (part := _flat_part(hint)) is not None:
            yield from _options(part)
        else:
            read = _read_type(hint)
            yield StructFieldSpec(field.name, read, _default(field), docs.get(field.name))


def _made(kind: type[Any], /, **values: Any) -> Any:
    """An object of ``kind``, whose `FLAT` fields take their own of the ``values``."""
    hints, made = get_type_hints(kind, include_extras=True), {}
    for field in fields(kind):
        part = _flat_part(hints[field.name])
        made[field.name] = values[field.name] if part is None else _made(part, **values)
    return kind(**made)


def _flat_part(hint: Any) -> type[Any] | None:
    return get_args(hint)[0] if _has(hint, FLAT) else None


def _has(hint: Any, mark: Any) -> bool:
    return any(one is mark for one in _marks(hint))


def _read_type(hint: Any) -> Any:
    """The hint, or what its option is to be read as in place of it."""
    marks = _marks(hint)
    for mark in marks:
        if (read_as := getattr(mark, "constructor_factory", None)) is not None:
            return Annotated[(read_as(), *marks)]
    return hint


def _default(field: Field[Any]) -> Any:
    if field.default_factory is not MISSING:
        return field.default_factory()
    return tyro.MISSING if field.default is MISSING else field.default
