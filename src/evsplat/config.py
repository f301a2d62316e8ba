"""Configuration as frozen dataclasses: to YAML and back, with errors that name the nearest key.

Ranges and conditions of settings stand in their annotations (`evsplat.ranges`); numbers are always
finite. Settings of older versions stand in the class attribute ``DROPPED``: what became of
them ("renamed to pose.start") by dotted name.
"""

import dataclasses
import difflib
import math
import types
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from evsplat.errors import ConfigError
from evsplat.ranges import Range, ReadIf, expected, ranges_of
from evsplat.untrusted.faults import brief
from evsplat.untrusted.text import parse_yaml, read_text

Config = TypeVar("Config")
_LARGEST = 2**53
"""Integers up to here are exact as doubles."""
_LONGEST_NAME = 80
"""Of a setting in a message; those that there are have 40."""
_MOST_NAMED = 5
"""Unknown settings that one message names."""


@dataclass(frozen=True)
class Setting:
    """A field of a configuration or of one of its sections."""

    name: str
    """Dotted name from the root."""
    owner: type[Any]
    """Class that has the field."""
    hint: Any
    """Its annotation."""
    value: Any
    default: Any
    """Value that the section around it gives it where nothing else is said."""
    conditions: tuple[tuple[str, ReadIf], ...]
    """Conditions of it and of the sections around it, each with the full name that it asks for."""

    @property
    def is_section(self) -> bool:
        """Whether it is a group of settings, by default as well."""
        return dataclasses.is_dataclass(self.value) and dataclasses.is_dataclass(self.default)


def settings(config: Any) -> list[Setting]:
    """All settings of a configuration in the order of their fields, sections before their parts."""
    return list(_settings(config, None, "", ()))


def _settings(
    part: Any, start: Any, prefix: str, around: tuple[tuple[str, ReadIf], ...]
) -> Iterator[Setting]:
    """Settings of ``part``, whose defaults are ``start``, or those of its type where that is None.

    ``prefix`` and ``around`` are the name and the conditions of the section that it is.
    """
    hints = get_type_hints(type(part), include_extras=True)
    for field in dataclasses.fields(part):
        name, hint, value = prefix + field.name, hints[field.name], getattr(part, field.name)
        default = _default(field) if start is None else getattr(start, field.name)
        marks = [mark for mark in _marks(hint) if isinstance(mark, ReadIf)]
        beside = hints.keys() - {field.name}
        asked = [(prefix if m.setting in beside else "") + m.setting for m in marks]
        conditions = (*around, *zip(asked, marks, strict=True))
        yield Setting(name, type(part), hint, value, default, conditions)
        if dataclasses.is_dataclass(value):
            known = default if dataclasses.is_dataclass(default) else None
            yield from _settings(value, known, f"{name}.", conditions)
        elif isinstance(value, tuple):
            for position, item in enumerate(value):
                if dataclasses.is_dataclass(item):
                    yield from _settings(item, None, f"{name}[{position}].", conditions)


def _marks(hint: Any) -> Iterator[Any]:
    """Everything that ``Annotated`` says in a type, wherever in it."""
    if get_origin(hint) is Annotated:
        yield from hint.__metadata__
    for argument in get_args(hint):
        yield from _marks(argument)


def check(config: Any, where: str) -> None:
    """Raise a `ConfigError` where a configuration made in Python has a value out of its range."""
    for setting in settings(config):
        if not dataclasses.is_dataclass(setting.value):
            plain = to_dict(setting.value)
            if to_dict(_convert(setting.hint, plain, where, setting.name)) != plain:
                raise _wrong(where, setting.name, setting.value, expected(setting.hint))


def check_read(config: Any, where: str) -> None:
    """Raise a `ConfigError` that names all settings that nothing reads and are not at defaults."""
    every = {setting.name: setting for setting in settings(config)}
    unread: dict[tuple[str, str], list[str]] = {}
    for setting in every.values():
        if setting.is_section or setting.value == setting.default:
            continue
        if missed := _missed(setting, every):
            name, condition = missed
            value = "given" if dataclasses.is_dataclass(setting.value) else repr(setting.value)
            told = unread.setdefault((name, condition.condition), [])
            told.append(f"{setting.name} is {value}")
    reasons = []
    for (name, asked), told in unread.items():
        them = "it" if len(told) == 1 else "them"
        reasons.append(
            f"{' and '.join(told)}, but nothing reads {them} unless {name} is {asked}; leave "
            f"{them} out or set {name}."
        )
    if reasons:
        raise ConfigError(f"{where}: {' '.join(reasons)}")


def _missed(setting: Setting, every: dict[str, Setting]) -> tuple[str, ReadIf] | None:
    """First condition that fails, of ``setting`` or of a setting that it depends on."""
    for name, condition in setting.conditions:
        # What is in a section that is null is not there.
        if name not in every or not condition.holds(every[name].value):
            return name, condition
        if missed := _missed(every[name], every):
            return missed
    return None


def to_dict(config: Any) -> Any:
    """Nested dictionaries and lists of a configuration, ready for YAML or JSON."""
    if dataclasses.is_dataclass(config):
        return {f.name: to_dict(getattr(config, f.name)) for f in dataclasses.fields(config)}
    if isinstance(config, tuple | list):
        return [to_dict(value) for value in config]
    return config


def from_dict(cls: type[Config], values: Any, *, where: str) -> Config:
    """A configuration of type ``cls``; keys left out keep their defaults.

    ``where`` begins the error message: a file name or an option. Besides values of the wrong type
    or out of range, those that nothing would read are refused, see `ReadIf`.
    """
    config: Config = _convert(cls, values, where, "")
    check_read(config, where)
    return config


def load_yaml(path: Path | str) -> dict[str, Any]:
    """Read a YAML mapping; anything else is a `ConfigError` that names the file."""
    path = Path(path)
    try:
        values = parse_yaml(read_text(path, error=ConfigError))
    except ValueError as error:
        raise ConfigError(f"{path}: not valid YAML ({error}); correct it.") from None
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: expected a mapping of settings, found {type(values).__name__}.")
    return values


def override(values: dict[str, Any], assignments: Sequence[str]) -> dict[str, Any]:
    """Apply ``section.key=value`` assignments (values in YAML) to nested dictionaries.

    A `ConfigError` where one is malformed, or a key is given twice, or a section and a key in it.
    """
    given: dict[str, str] = {}
    for assignment in assignments:
        key, equals, text = assignment.partition("=")
        printable = assignment.isprintable() and len(assignment) <= _LONGEST_NAME
        shown = assignment if printable else brief(assignment)
        if not equals or not key:
            raise ConfigError(f"--set {shown}: expected KEY=VALUE, such as --set event_start=1000.")
        if key in given:
            raise ConfigError(f"--set {shown}: {brief(key)[1:-1]} is given twice; leave one out.")
        for other, said in given.items():
            if key.startswith(f"{other}.") or other.startswith(f"{key}."):
                raise ConfigError(
                    f"--set {shown}: --set {said}, which is given before it, says some of the same "
                    "settings; write both as one, or leave one out."
                )
        given[key] = shown
        try:
            value = parse_yaml(text)
        except ValueError:
            raise ConfigError(f"--set {shown}: {brief(text)} is not a YAML value.") from None
        *sections, last = key.split(".")
        place = values
        for section in sections:
            place = place.setdefault(section, {})
            if not isinstance(place, dict):
                raise ConfigError(f"--set {shown}: {brief(section)} is a value, not a section.")
        place[last] = value
    return values


def _convert(
    kind: Any, value: Any, where: str, key: str, ranges: Sequence[Range] = (), start: Any = None
) -> Any:
    """``value`` as the annotated type ``kind``, or a `ConfigError` about ``key``.

    ``ranges`` hold for every number in it. A section that is given in part keeps the rest of
    ``start``, or the defaults of its type where that is None.
    """
    if dataclasses.is_dataclass(kind):
        return _convert_dataclass(kind, value, where, key, start)
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Annotated:
        bounds = (*ranges, *ranges_of(kind))
        return _convert(arguments[0], value, where, key, bounds, start)
    if origin in (Union, types.UnionType):
        inside = None
        for candidate in arguments:
            try:
                return _convert(candidate, value, where, key, ranges, start)
            except ConfigError as error:
                if _is_kin(candidate, value):
                    inside = error
        raise inside or _wrong(where, key, value, expected(kind, ranges))
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise _wrong(where, key, value, expected(kind, ranges))
        if arguments[-1] is Ellipsis:
            return tuple(_convert(arguments[0], v, where, key, ranges) for v in value)
        if len(value) != len(arguments):
            raise _wrong(where, key, value, f"{len(arguments)} values")
        pairs = zip(arguments, value, strict=True)
        return tuple(_convert(a, v, where, key, ranges) for a, v in pairs)
    converted = value
    if origin is Literal:
        fits = value in arguments
    elif kind is float:
        converted = _float(value)
        fits = converted is not None
    else:
        fits = isinstance(value, kind)
        if kind is int and fits:
            fits = not isinstance(value, bool) and abs(value) <= _LARGEST
    if not fits or (kind in (int, float) and not all(converted in r for r in ranges)):
        raise _wrong(where, key, value, expected(kind, ranges))
    return converted


def _is_kin(hint: Any, value: Any) -> bool:
    """Whether a list or a section is asked for and ``value`` is one, right inside or not."""
    if get_origin(hint) is Annotated:
        return _is_kin(get_args(hint)[0], value)
    if isinstance(value, dict):
        return dataclasses.is_dataclass(hint)
    return isinstance(value, list | tuple) and get_origin(hint) is tuple


def _float(value: Any) -> float | None:
    """A finite number, or None."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return None
    try:
        # YAML reads 1e-3 (without a dot) as a string.
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def _convert_dataclass(kind: Any, value: Any, where: str, key: str, start: Any) -> Any:
    """``value`` over ``start``, an instance, or over the defaults of ``kind`` where that is None.

    A section that is given in part keeps the defaults that its owner gives it, which need not be
    those of its type.
    """
    if not isinstance(value, dict):
        raise _wrong(where, key, value, expected(kind))
    prefix = f"{key}." if key else ""
    dropped = {} if key else getattr(kind, "DROPPED", {})
    _refuse(list(_unknown(kind, value, prefix, dropped)), where)
    hints = get_type_hints(kind, include_extras=True)
    fields = {field.name: field for field in dataclasses.fields(kind)}
    converted = {}
    for name, item in value.items():
        inner = _default(fields[name]) if start is None else getattr(start, name)
        inner = inner if dataclasses.is_dataclass(inner) else None
        converted[name] = _convert(hints[name], item, where, prefix + name, start=inner)
    if start is not None:
        return dataclasses.replace(start, **converted)
    absent = [n for n, field in fields.items() if n not in converted and not _has_default(field)]
    if absent:
        raise ConfigError(f"{where}: {key + ': ' if key else ''}{absent[0]} is missing.")
    return kind(**converted)


def _unknown(
    kind: Any, values: dict[Any, Any], prefix: str, dropped: dict[str, str]
) -> Iterator[tuple[str, str | None]]:
    """Faults of keys that a section, or one inside it, has not; the name that is near."""
    hints = get_type_hints(kind)
    names = [field.name for field in dataclasses.fields(kind)]
    for name, item in values.items():
        full = f"{prefix}{name}" if str(name).isprintable() else f"{prefix}{name!r}"
        full = full if len(full) <= _LONGEST_NAME else brief(full)
        if full in dropped:
            parts = [f"{full}.{key}" for key in item] if isinstance(item, dict) else []
            named = [part for part in parts if part in dropped]
            # The section's own sentence serves those of its parts that have none.
            rest = [full] if len(named) < max(len(parts), 1) else []
            yield from ((f"{part}: {dropped[part]}", None) for part in [*named, *rest])
        elif name not in names:
            near = difflib.get_close_matches(str(name), names, n=1, cutoff=0.3)
            yield f"unknown setting {full}", prefix + near[0] if near else None
        elif isinstance(item, dict):
            for section in filter(dataclasses.is_dataclass, (hints[name], *get_args(hints[name]))):
                yield from _unknown(section, item, f"{full}.", dropped)


def _refuse(faults: list[tuple[str, str | None]], where: str) -> None:
    """Raise a `ConfigError` that names the faults that `_unknown` found, if any."""
    if len(faults) == 1:
        fault, near = faults[0]
        hint = f" Did you mean {near}?" if near else ""
        raise ConfigError(f"{where}: {fault.removesuffix('.')}.{hint}")
    if faults:
        named = [f"{fault} (did you mean {near}?)" if near else fault for fault, near in faults]
        more = [f"and {len(faults) - _MOST_NAMED} more"] if len(faults) > _MOST_NAMED else []
        raise ConfigError(f"{where}: {'; '.join(named[:_MOST_NAMED] + more)}.")


def _has_default(field: dataclasses.Field[Any]) -> bool:
    missing = dataclasses.MISSING
    return field.default is not missing or field.default_factory is not missing


def _default(field: dataclasses.Field[Any]) -> Any:
    """What a field is when nothing is given; None where it must be given."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return None if field.default is dataclasses.MISSING else field.default


def _wrong(where: str, key: str, value: Any, expected: str) -> ConfigError:
    if isinstance(value, int) and abs(value) > _LARGEST:
        expected = expected.replace("an integer", f"an integer of at most {_LARGEST}")
    if isinstance(value, float) and not math.isfinite(value):
        expected = expected.replace("a number", "a finite number")
    return ConfigError(f"{where}: {key} is {brief(value)}; expected {expected}.")
