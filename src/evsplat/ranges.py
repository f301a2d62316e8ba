"""What settings take, in their annotations: ranges of numbers, and when they are read at all."""

import dataclasses
import types
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin


@dataclass(frozen=True)
class Range:
    """Numbers that a setting takes, in its annotation: ``Annotated[float, Above(0)]``."""

    words: str
    """Words for it that follow "a number": "above 0"."""
    holds: Callable[[float], bool]

    def __contains__(self, number: float) -> bool:
        return self.holds(number)


def Above(bound: float) -> Range:
    """Numbers above a bound."""
    return Range(f"above {bound}", lambda number: number > bound)


def AtLeast(bound: float) -> Range:
    """Numbers from a bound on."""
    return Range(f"of at least {bound}", lambda number: number >= bound)


def AtMost(bound: float) -> Range:
    """Numbers up to a bound."""
    return Range(f"of at most {bound}", lambda number: number <= bound)


def Within(low: float, high: float) -> Range:
    """Numbers between two bounds, both included."""
    return Range(f"within {low} and {high}", lambda number: low <= number <= high)


SEEDS = Within(-(2**63), 2**63 - 1)
"""Seeds of a training: what a generator of PyTorch takes."""


@dataclass(frozen=True)
class ReadIf:
    """Condition under which a setting, or all of a section, is read at all."""

    setting: str
    """Another field of the same section, or else a name from the root of the configuration."""
    condition: str
    """Words for it that follow the setting's name and "is": "above 0"."""
    holds: Callable[[Any], bool]
    """Whether a value of that setting fulfils it."""


def expected(hint: Any, ranges: Sequence[Range] = (), *, many: bool = False) -> str:
    """What a setting takes, in words: "a number above 0 or null"."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return expected(arguments[0], (*ranges, *ranges_of(hint)), many=many)
    if origin is Literal:
        return "one of " + ", ".join(str(a) for a in arguments)
    if origin in (Union, types.UnionType):
        return " or ".join(expected(a, ranges, many=many) for a in arguments)
    if origin is tuple and arguments[-1] is Ellipsis:
        return f"a list of {expected(arguments[0], ranges, many=True)}"
    if origin is tuple:
        return f"[{', '.join(expected(a, ranges) for a in arguments)}]"
    if dataclasses.is_dataclass(hint):
        return "sections with keys" if many else "a section with keys"
    one, several = {
        int: ("an integer", "integers"),
        float: ("a number", "numbers"),
        bool: ("true or false", "true or false"),
        str: ("a text", "texts"),
        Path: ("a path", "paths"),
        type(None): ("null", "null"),
    }.get(hint, (str(hint), str(hint)))
    bounds = " and ".join(bound.words for bound in ranges if hint in (int, float))
    return f"{several if many else one} {bounds}".rstrip()


def ranges_of(hint: Any) -> list[Range]:
    """Of an ``Annotated`` type."""
    return [mark for mark in hint.__metadata__ if isinstance(mark, Range)]
