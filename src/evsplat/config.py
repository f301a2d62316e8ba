"""Configuration as frozen dataclasses: to YAML and back, with errors that name the nearest key."""

import dataclasses
import difflib
import types
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import yaml

from evsplat.errors import ConfigError
from evsplat.files import read_text, without_advice, write_text

Config = TypeVar("Config")
_DEEPEST = 50
"""Levels of a YAML text; settings have a handful."""
_MISFITS = (TypeError, KeyError, IndexError, AttributeError, OverflowError)
"""What PyYAML raises, besides `ValueError` and its own errors, on tags such as ``!!bool 3``."""


def to_dict(config: Any) -> Any:
    """Nested dictionaries and lists of a configuration, ready for YAML or JSON."""
    if dataclasses.is_dataclass(config):
        return {f.name: to_dict(getattr(config, f.name)) for f in dataclasses.fields(config)}
    if isinstance(config, tuple | list):
        return [to_dict(value) for value in config]
    return config


def from_dict(cls: type[Config], values: Any, *, where: str) -> Config:
    """A configuration of type ``cls``; keys left out keep their defaults.

    ``where`` begins the error message: a file name or an option.
    """
    return _convert(cls, values, where, "")


def save_yaml(path: Path | str, config: Any) -> None:
    """Write a configuration so that `load_yaml` gives it back."""
    write_text(path, yaml.safe_dump(to_dict(config), sort_keys=False))


def load_yaml(path: Path | str) -> dict[str, Any]:
    """Read a YAML mapping; anything else is a `ConfigError` that names the file."""
    path = Path(path)
    try:
        values = _parse_yaml(read_text(path, error=ConfigError))
    except ValueError as error:
        raise ConfigError(f"{path}: not valid YAML ({error}); correct it.") from None
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: expected a mapping of settings, found {type(values).__name__}.")
    return values


def override(values: dict[str, Any], assignments: Sequence[str]) -> dict[str, Any]:
    """Apply ``section.key=value`` assignments (values in YAML) to nested dictionaries."""
    for assignment in assignments:
        key, equals, text = assignment.partition("=")
        if not equals or not key:
            raise ConfigError(
                f"--set {assignment}: expected KEY=VALUE, such as --set event.start=1000."
            )
        try:
            value = _parse_yaml(text)
        except ValueError:
            raise ConfigError(f"--set {assignment}: {text!r} is not a YAML value.") from None
        *sections, last = key.split(".")
        place = values
        for section in sections:
            place = place.setdefault(section, {})
            if not isinstance(place, dict):
                raise ConfigError(f"--set {assignment}: {section!r} is a value, not a section.")
        place[last] = value
    return values


def _parse_yaml(text: str) -> Any:
    """The value that a YAML text stands for; all that can be wrong with it is a `ValueError`."""
    depth = 0
    try:
        # These come one by one, so that a text of brackets costs no more than its first few.
        for event in yaml.parse(text, Loader=yaml.SafeLoader):
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if depth > _DEEPEST:
                raise ValueError(f"nested more than {_DEEPEST} deep")
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ValueError(str(error)) from None
    except ValueError as error:
        raise ValueError(without_advice(error)) from None
    except _MISFITS:
        raise ValueError("a tag that its value does not fit") from None


def _convert(kind: Any, value: Any, where: str, key: str) -> Any:
    """``value`` as the annotated type ``kind``, or a `ConfigError` about ``key``."""
    if dataclasses.is_dataclass(kind):
        return _convert_dataclass(kind, value, where, key, None)
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Literal:
        if value in arguments:
            return value
        choices = ", ".join(str(a) for a in arguments)
        raise _wrong(where, key, value, f"one of {choices}")
    if origin in (Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        kinds = [a for a in arguments if a is not type(None)]
        for position, candidate in enumerate(kinds):
            try:
                return _convert(candidate, value, where, key)
            except ConfigError:
                if position == len(kinds) - 1:
                    raise
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise _wrong(where, key, value, "a list")
        if arguments[-1] is Ellipsis:
            return tuple(_convert(arguments[0], v, where, key) for v in value)
        if len(value) != len(arguments):
            raise _wrong(where, key, value, f"{len(arguments)} values")
        return tuple(_convert(a, v, where, key) for a, v in zip(arguments, value, strict=True))
    if kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    if kind is float and isinstance(value, str):
        # YAML reads 1e-3 (without a dot) as a string.
        try:
            return float(value)
        except ValueError:
            raise _wrong(where, key, value, "a number") from None
    if isinstance(value, kind) and not (kind is int and isinstance(value, bool)):
        return value
    names = {int: "an integer", float: "a number", bool: "true or false", str: "a text"}
    raise _wrong(where, key, value, names.get(kind, str(kind)))


def _convert_dataclass(kind: Any, value: Any, where: str, key: str, start: Any) -> Any:
    """``value`` over ``start``, an instance, or over the defaults of ``kind`` where that is None.

    A section that is given in part keeps the defaults that its owner gives it, which need not be
    those of its type.
    """
    if not isinstance(value, dict):
        raise _wrong(where, key, value, "a section with keys")
    hints = get_type_hints(kind)
    fields = {field.name: field for field in dataclasses.fields(kind)}
    names = list(fields)
    converted = {}
    for name, item in value.items():
        full = f"{key}.{name}" if key else str(name)
        if name not in names:
            near = difflib.get_close_matches(str(name), names, n=1, cutoff=0.3)
            section = f"{key}." if key else ""
            hint = f" Did you mean {section}{near[0]}?" if near else ""
            raise ConfigError(f"{where}: unknown setting {full}.{hint}")
        if dataclasses.is_dataclass(hints[name]):
            inner = _default(fields[name]) if start is None else getattr(start, name)
            converted[name] = _convert_dataclass(hints[name], item, where, full, inner)
        else:
            converted[name] = _convert(hints[name], item, where, full)
    if start is not None:
        return dataclasses.replace(start, **converted)
    absent = [n for n, field in fields.items() if n not in converted and not _has_default(field)]
    if absent:
        raise ConfigError(f"{where}: {key + ': ' if key else ''}{absent[0]} is missing.")
    return kind(**converted)


def _has_default(field: dataclasses.Field[Any]) -> bool:
    missing = dataclasses.MISSING
    return field.default is not missing or field.default_factory is not missing


def _default(field: dataclasses.Field[Any]) -> Any:
    """What a field is when nothing is given; None where it must be given."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return None if field.default is dataclasses.MISSING else field.default


def _wrong(where: str, key: str, value: Any, expected: str) -> ConfigError:
    return ConfigError(f"{where}: {key} is {value!r}; expected {expected}.")
