"""The offset between the clocks of events and pictures, as it is given or found on import."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, Literal

from evsplat.calibration.clock import SEARCH_US, SLOW_MOTION_US
from evsplat.calibration.offset import (
    LEAST_CORRELATION,
    BlockChanges,
    OffsetEstimate,
    TooLong,
    estimate_offset,
    offsets_by_correlation,
)
from evsplat.calibration.ways import WAYS, Way, in_words, way_homography, ways_of
from evsplat.errors import ConfigError, DataError
from evsplat.events import EventStream, moved

_LIKELY = 4
"""Offsets at most, of which one that is wrong costs a search for the place of the events."""


def offset_or_changes(
    clock_offset_us: int | Literal["auto"], camera: dict[str, Any], size: tuple[int, int]
) -> int | BlockChanges:
    """The clock's offset; where it is to be found, what is to be gathered of the frames for it.

    ``size`` is that of the pictures as recorded, in whose pixels the events are.
    """
    if not isinstance(clock_offset_us, str):
        return clock_offset_us
    if clock_offset_us != "auto":
        raise ConfigError(f"--clock-offset-us {clock_offset_us}: expected microseconds or auto.")
    return BlockChanges(camera.get("transfer", "power"), size)


def likely_offsets(
    changes: BlockChanges,
    pieces: Callable[[], Iterable[EventStream]],
    path: Path,
    size: tuple[int, int],
) -> list[int]:
    """Where the events' clock may be, us, the likeliest first; one where it is certain.

    Whatever way events are mirrored, turned or inverted, of pixels about where those of pictures
    of ``size`` lie.
    """
    found = _offsets(changes, pieces(), path, size, _LIKELY)
    if found and found[0].is_certain:
        return [round(found[0].offset_us)]
    for (name, way), inverted in product(WAYS.items(), (False, True)):
        if in_words(name, inverted=inverted):  # as they are, they were looked at
            turned = _turned(pieces(), way, size, inverted=inverted)
            found += _offsets(changes, turned, path, size, _LIKELY)
    apart: list[OffsetEstimate] = []
    for one in sorted(found, key=lambda one: -one.correlation):
        if all(abs(one.offset_us - other.offset_us) > SEARCH_US for other in apart):
            apart.append(one)
    return [round(one.offset_us) for one in apart[:_LIKELY]]


def _offsets(
    changes: BlockChanges,
    events: Iterable[EventStream],
    path: Path,
    size: tuple[int, int],
    most: int,
) -> list[OffsetEstimate]:
    try:
        return offsets_by_correlation(changes, events, size, most)
    except TooLong as error:
        raise DataError(f"{path}: {error}; cut it, or give --clock-offset-us US.") from None


def _turned(
    events: Iterable[EventStream], way: Way, size: tuple[int, int], *, inverted: bool
) -> Iterable[EventStream]:
    turned = moved(events, way_homography(way, size), *size)
    return (replace(piece, p=-piece.p) for piece in turned) if inverted else turned


def found_offset(
    changes: BlockChanges,
    pieces: Callable[[], Iterable[EventStream]],
    path: Path,
    size: tuple[int, int],
    *,
    one_file: bool,
) -> tuple[int, str]:
    """The offset of the events' clock, us, and a note of it; raises where it is not certain.

    ``one_file``: the pictures are in ``path`` as well.
    """
    found = next(iter(_offsets(changes, pieces(), path, size, 1)), None)
    give = "give --clock-offset-us US, or film more that moves"
    if one_file:
        give = "leave --clock-offset-us out, as a sensor has one clock for both; or " + give
    if found is None or not found.is_certain:
        _refuse_turned(changes, pieces, path, size)
    if found is None or found.correlation < LEAST_CORRELATION:
        best = "" if found is None else f" (correlation {found.correlation:.2f} at best)"
        raise DataError(
            f"{path}: its events agree with the changes of the pictures at no offset of the "
            f"clocks{best}; {give}."
        )
    offset_us = 100 * round(found.offset_us / 100)
    if not found.is_certain:
        raise DataError(
            f"{path}: its events agree with the changes of the pictures at {offset_us} us "
            f"(correlation {found.correlation:.2f}) hardly better than elsewhere "
            f"({found.rival:.2f}); {give}."
        )
    note = (
        f"events: the offset of their clock is found, {offset_us} us, to about "
        f"{SLOW_MOTION_US / 1000:g} ms (correlation {found.correlation:.2f}, elsewhere "
        f"{found.rival:.2f} at most)"
    )
    return offset_us, note


def _refuse_turned(
    changes: BlockChanges,
    pieces: Callable[[], Iterable[EventStream]],
    path: Path,
    size: tuple[int, int],
) -> None:
    """Raise where events that were mirrored or inverted would have an offset that is certain."""
    found = []
    for (name, way), inverted in product(ways_of(size).items(), (False, True)):
        turned = _turned(pieces(), way, size, inverted=inverted)
        words = in_words(name, inverted=inverted)
        offset = estimate_offset(changes, turned, size) if words else None
        if offset is not None and offset.is_certain:
            found.append((offset.correlation, words, offset.offset_us))
    if found:
        # of ways that fit alike, as those of a scene that is the same upside down, the plainest
        correlation, words, offset_us = max(found, key=lambda one: round(one[0], 3))
        raise DataError(
            f"{path}: its events agree with the changes of the pictures only if they were {words} "
            f"(correlation {correlation:.2f}, at an offset of {offset_us:.0f} us); write them anew "
            "that way by 'evsplat convert --invert' or 'evsplat convert --homography' "
            "(docs/event-formats.md), or the pictures."
        )
