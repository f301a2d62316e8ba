"""Declaration of options, their making of what a caller gives, and their check."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from difflib import get_close_matches
from numbers import Integral, Real
from os import PathLike
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import tyro

from evsplat.errors import ConfigError
from evsplat.options.inputs import Input, check_capture_folder, check_run_folder
from evsplat.ranges import AtLeast, Range, Within, expected

Options = TypeVar("Options")

FLAT = tyro.conf.arg(name="")
"""Marks a parameter of a verb whose fields are the options themselves."""
LAST = tyro.conf.arg()
"""Marks a field of a base class that is shown after those of the class."""


def option(
    metavar: str | None = None,
    help: str | None = None,
    *,
    default: str | None = None,
    name: str | None = None,
    alias: str | None = None,
    read_as: Any = None,
) -> Any:
    """Annotation of an option: its placeholder, help and, in words, what happens without it.

    ``name`` and ``alias`` are what it is called on the command line where that is not the field,
    ``read_as`` the type of what stands there. Of a switch no default is shown.
    """

    def hint(value: str) -> str:
        shown = value.removesuffix(".0") if default is None else default
        return f"(default: {shown})" if shown and value not in ("True", "False") else ""

    return tyro.conf.arg(
        name=name,
        metavar=metavar,
        help=help,
        help_behavior_hint=hint,
        aliases=None if alias is None else (alias,),
        constructor=read_as,
    )


Flag = Annotated[bool, option()]
CaptureFolder = Annotated[
    tyro.conf.Positional[Path],
    option("CAPTURE", "Capture folder (docs/capture-format.md)."),
    Input(check_capture_folder),
]
RunFolder = Annotated[
    tyro.conf.Positional[Path],
    option("RUN", "Run folder written by 'evsplat train'."),
    Input(check_run_folder),
]
Port = Annotated[
    int,
    Within(1, 65535),
    option("PORT", "Where to listen.", default="8080, or the next free one"),
]
Threads = Annotated[int | None, AtLeast(1), option("N", "CPU threads.", default="all cores")]
NewRun = Annotated[
    Path | None, option("RUN", "Folder of the run.", default="runs/CAPTURE/METHOD/TIME")
]
Device = Literal["auto", "cpu", "cuda"]
Use = Literal["training", "everything"]
Parts = Literal["all", "human", "scene"]
Sensor = Literal["clean", "davis346", "dvxplorer", "evk4"]
Transfer = Literal["power", "srgb", "linear"]
"""Copy of `evsplat.pictures.Transfer`, whose module loads torch."""


def given(kind: type[Options], options: Options | None, changes: Mapping[str, Any]) -> Options:
    """``options``, or the defaults of ``kind``, with some fields changed.

    Raises:
        ConfigError: No field has that name (the nearest is named), or a value is out of range.
    """
    known = [field.name for field in fields(kind)]  # type: ignore[arg-type]
    for name in changes:
        if name not in known:
            near = get_close_matches(name, known, 1, cutoff=0.0)[0]
            raise ConfigError(f"{name}: no such option; did you mean {near}?")
    return kind(**changes) if options is None else replace(options, **changes)  # type: ignore[type-var]


def check_options(options: Any) -> None:
    """Raise a `ConfigError` that names the first option of another type or out of its range."""
    kind = type(options)
    plain, marked = get_type_hints(kind), get_type_hints(kind, include_extras=True)
    for name, hint in plain.items():
        value, marks = getattr(options, name), getattr(marked[name], "__metadata__", ())
        ranges = [mark for mark in marks if isinstance(mark, Range)]
        parts = value if isinstance(value, tuple | list) else (value,)
        numbers: list[Any] = [part for part in parts if isinstance(part, Real)]
        is_of_type = _is_of(value, hint)
        if not is_of_type or not all(number in allowed for number in numbers for allowed in ranges):
            said = next((mark.name for mark in marks if getattr(mark, "name", None)), name)
            # 2.0 and '2' in the place of a whole number would look like one
            exact = not is_of_type and not _has_choices(hint)
            shown = " ".join(repr(part) if exact else _short(part) for part in parts)
            wanted = expected(marked[name]).removesuffix(" or null")
            raise ConfigError(f"--{said.replace('_', '-')} {shown}: expected {wanted}.")


def _is_of(value: Any, hint: Any) -> bool:
    """Whether a value is of a type, as the command line's are; numbers are finite.

    Paths may be texts, and types that stand in no command line are not looked at.
    """
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return any(_is_of(value, argument) for argument in arguments)
    if origin is Literal:
        return value in arguments
    if origin is tuple:
        if not isinstance(value, tuple | list):
            return False
        kinds = arguments[:1] * len(value) if arguments[-1] is Ellipsis else arguments
        return len(kinds) == len(value) and all(map(_is_of, value, kinds))
    if hint in (int, float):
        number = isinstance(value, Integral if hint is int else Real)
        return number and not isinstance(value, bool) and math.isfinite(value)
    if hint in (str, Path):
        return isinstance(value, str | PathLike)
    if hint is bool:
        return value in (False, True)
    return value is None if hint is type(None) else True


def _has_choices(hint: Any) -> bool:
    return any(get_origin(part) is Literal for part in (hint, *get_args(hint)))


def _short(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def check_twins(options: Any, overrides: Sequence[str], twins: Mapping[str, str]) -> None:
    """Raise a `ConfigError` where an option and the setting that it stands for are both given.

    ``overrides`` are assignments ``KEY=VALUE``; ``twins`` leads from settings to fields.
    """
    for assignment in overrides:
        key = assignment.partition("=")[0]
        for setting, name in twins.items():
            value = getattr(options, name)
            if value is not None and (key == setting or setting.startswith(f"{key}.")):
                raise ConfigError(
                    f"--{name.replace('_', '-')} {value}: --set gives {key} as well; leave one out."
                )
