"""Recordings of any format, recognised by their first bytes, read as event streams."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from evsplat.errors import DataError
from evsplat.events.formats import find_format
from evsplat.events.formats.base import Damage, RawEvents, RecordedFrame, Source
from evsplat.events.formats.checks import checked
from evsplat.events.stream import EventStream
from evsplat.options import ReadOptions
from evsplat.options.declare import given

SIZE_UNKNOWN = (
    "the size of the sensor is not in the file; give it with --width and --height of "
    "'evsplat convert'"
)
"""A note, which says nothing to who moves the events to pixels of a known size."""


class EventRecording:
    """A recording on disk. Every pass (`chunks`, `read`, `frames`) reads the file anew."""

    def __init__(
        self, path: Path, format: str, source: Source, damage: Damage, options: ReadOptions
    ) -> None:
        self.path = path
        self._skip, self._stop = options.skip, options.stop
        self.format = format
        self.width, self.height = source.width, source.height
        """Columns and rows of the sensor; None where neither the file nor the caller says."""
        self.has_polarity = source.has_polarity
        """False where the recording says only that something changed; p is 0 then."""
        self._source = source
        self._damage = damage

    @property
    def notes(self) -> list[str]:
        """Notes for the user: assumptions made and, after a pass, what was repaired."""
        return [*self._source.notes, *self._damage.notes()]

    def chunks(self) -> Iterator[EventStream]:
        """All events in order of time, a few hundred thousand at a time.

        Memory does not grow with the recording, but for .npz and .npy files, which are one piece.
        Raises `DataError` where the recording is damaged, unless it was opened with ``repair``.
        """
        self._damage.begin()
        return checked(
            _part_of(self._source.blocks(), self.path, self._skip, self._stop),
            self._damage,
            self.width,
            self.height,
            self.has_polarity,
            first=self._skip,
        )

    def read(self, start_us: int | None = None, end_us: int | None = None) -> EventStream:
        """Events with ``start_us <= t < end_us`` in memory; None: from the first, to the last.

        Reads the file up to ``end_us``.
        """
        parts = []
        for chunk in self.chunks():
            if start_us is not None or end_us is not None:
                low = chunk.t[0] if start_us is None else start_us
                high = chunk.t[-1] + 1 if end_us is None else end_us
                part = chunk.between(int(low), int(high))
            else:
                part = chunk
            if len(part):
                parts.append(part)
            if end_us is not None and chunk.t[-1] >= end_us:
                break
        return EventStream.joined(parts)

    def frames(self) -> Iterator[RecordedFrame]:
        """Pictures recorded beside the events (AEDAT 3.1 and 4 only), in order of the file."""
        return self._source.frames()


def _part_of(
    blocks: Iterator[RawEvents], path: Path, skip: int, stop: int | None
) -> Iterator[RawEvents]:
    """The events of a file from number ``skip`` up to ``stop``; raises where it has none of them.

    An empty recording is left to whoever reads it.
    """
    first = 0
    for block in blocks:
        end = first + len(block.t)
        if skip <= first and (stop is None or end <= stop):
            yield block
        elif end > skip:
            part = slice(max(0, skip - first), None if stop is None else stop - first)
            yield RawEvents(*(column[part] for column in block))
        first = end
        if stop is not None and first >= stop:
            return
    if skip and first <= skip:
        raise DataError(
            f"{path}: holds {first:,} events, expected more than the {skip:,} that are to be left "
            "out (--skip); give a smaller number."
        )


def open_recording(
    path: Path | str,
    options: ReadOptions | None = None,
    *,
    format: str | None = None,
    **changes: Any,
) -> EventRecording:
    """Open an event recording of any format that evsplat reads (docs/event-formats.md).

    Args:
        path: The recording; its content names the format, not its suffix.
        options: The caller's statements about it. With ``repair`` what was done is counted in
            ``notes``; without it each damage is a `DataError`.
        format: One of `evsplat.events.formats.FORMATS`; the content must agree.
        changes: Fields of `ReadOptions`. For .npz and HDF5 ``columns`` says which key holds which,
            such as ``{"t": "stamps"}``.

    Raises:
        DataError: The file is missing, of no known format, or its header is damaged.
        ConfigError: An option is out of range.
    """
    path, options = Path(path), given(ReadOptions, options, changes)
    if not path.exists():
        raise DataError(f"{path}: file not found.")
    found = find_format(path, format)
    damage = Damage(path, options.repair)
    source = found.open(path, options, damage)
    source.width = options.width or source.width
    source.height = options.height or source.height
    if (source.width is None) != (source.height is None):
        raise DataError(f"{path}: only one of --width and --height is known; give both.")
    if not all(size is None or 0 < size <= 1 << 16 for size in (source.width, source.height)):
        raise DataError(f"{path}: its header gives {source.width} x {source.height} pixels.")
    if source.width is None:
        source.notes.append(SIZE_UNKNOWN)
    return EventRecording(path, found.name, source, damage, options)


def read_events(
    path: Path | str, options: ReadOptions | None = None, **changes: Any
) -> EventStream:
    """All events of a recording in memory; options and errors are those of `open_recording`."""
    return open_recording(path, options, **changes).read()
