"""Event Stream 2 (.es): DVS and ATIS events.

https://github.com/neuromorphic-paris/event_stream, with the bytes that its version 2 writes today.
"""

import re
from collections.abc import Iterator

from evsplat.errors import DataError
from evsplat.events.formats.base import ByteReader, RawEvents, Source
from evsplat.events.formats.words import WordDecoder
from evsplat.options import ReadOptions

_KINDS = {1: "es_dvs", 2: "es_atis"}
_NAMES = {0: "generic", 4: "colour"}
_HEADER_BYTES = 20
_ANOTHER = re.compile(rb"Event Stream\x02")


class EventStreamFile(Source):
    """An .es file; of ATIS the change detections, not the exposure measurements."""

    def read_header(self, options: ReadOptions) -> None:
        """See `Source`."""
        with ByteReader(self.path) as reader:
            header = reader.read(_HEADER_BYTES)
        if len(header) < _HEADER_BYTES or header[12] != 2:
            raise DataError(f"{self.path}: expected version 2 of Event Stream.")
        kind = header[15]
        if kind not in _KINDS:
            raise DataError(
                f"{self.path}: holds {_NAMES.get(kind, f'type {kind}')} events, expected DVS or "
                "ATIS."
            )
        self._kind = _KINDS[kind]
        self.width = int.from_bytes(header[16:18], "little")
        self.height = int.from_bytes(header[18:20], "little")
        if not self.width or not self.height:
            raise DataError(f"{self.path}: its header gives {self.width} x {self.height} pixels.")
        if self._kind == "es_atis":
            self.notes.append("of ATIS events only the changes are read, not the exposures")

    def blocks(self) -> Iterator[RawEvents]:
        """About a megabyte at a time."""
        decoder = WordDecoder(self._kind, self.damage)
        assert self.height is not None
        with ByteReader(self.path, _HEADER_BYTES, another=_ANOTHER) as reader:
            for events in decoder.blocks(reader):
                # rows count from the bottom; beyond the sensor is for the checks to find
                yield events._replace(y=self.height - 1 - events.y.astype("i4"))
