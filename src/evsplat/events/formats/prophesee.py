"""Prophesee's files: RAW (EVT 2, 2.1 in both layouts, 3) and DAT.

Both begin with lines "% key value". https://docs.prophesee.ai/stable/data/file_formats
"""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from evsplat.errors import DataError
from evsplat.events.formats.base import ByteReader, RawEvents, Source
from evsplat.events.formats.words import WordDecoder
from evsplat.options import ReadOptions

_MAX_HEADER_LINES = 1000
_MAX_LINE_BYTES = 4096
_SAMPLE_BYTES = 1 << 16
_EVT_VERSIONS = {"2": "evt2", "2.0": "evt2", "2.1": "evt21", "3": "evt3", "3.0": "evt3"}
_FORMAT_NAMES = {"EVT2": "evt2", "EVT21": "evt21", "EVT3": "evt3"}
# Types of EVT 2.1 words: events, time, trigger, others, continued
_EVT21_TYPES = (0x0, 0x1, 0x8, 0xA, 0xE, 0xF)
# Lines of which every header has one; so many bytes are no events by chance.
_ANOTHER_RAW = re.compile(rb"% (?:evt [23]|format EVT)")
_ANOTHER_DAT = re.compile(rb"% (?:Data file containing|Version [12])")
_DAT_VERSION = "2"
_DAT_EVENT = np.dtype([("t", "<u4"), ("pixel", "<u4")])
_DAT_EVENT_TYPES = (0x00, 0x0C)
_DAT_READ_EVENTS = 1 << 17


class _Header:
    """Lines "% key value" at the beginning, and where they end."""

    def __init__(self, reader: ByteReader) -> None:
        self.values: dict[str, str] = {}
        for _ in range(_MAX_HEADER_LINES):
            self.end = reader.offset
            if reader.read(2) != b"% ":
                break
            line = reader.read_line(_MAX_LINE_BYTES)
            if not line.endswith(b"\n"):
                raise DataError(f"{reader.path}: its header does not end (byte {reader.offset}).")
            text = line.decode("latin-1").strip()
            key, _, value = text.partition(" ")
            self.values.setdefault(key.lower(), value.strip())
            if text == "end":
                self.end = reader.offset
                break
        else:
            raise DataError(f"{reader.path}: more than {_MAX_HEADER_LINES} lines of header.")
        self.width, self.height = self._size(reader.path)

    def _size(self, path: Path) -> tuple[int | None, int | None]:
        size = [
            re.search(pattern, f"{key} {value}\n", re.IGNORECASE)
            for key, value in self.values.items()
            for pattern in (r"^geometry (\d+)x(\d+)\n", r"^format .*width=(\d+).*height=(\d+)")
        ]
        found = next((match.groups() for match in size if match), None)
        tall = re.search(r"height=(\d+).*width=(\d+)", self.values.get("format", ""))
        if found is None and tall:
            found = tall.groups()[::-1]
        if found is None and {"width", "height"} <= set(self.values):
            found = (self.values["width"], self.values["height"])
        if found is None:
            return None, None
        if not all(text.isdecimal() and 0 < int(text) <= 1 << 16 for text in found):
            raise DataError(f"{path}: its header gives a sensor of {' x '.join(found)} pixels.")
        return int(found[0]), int(found[1])


class Raw(Source):
    """A RAW file; triggers and monitoring words are passed over."""

    def read_header(self, options: ReadOptions) -> None:
        """See `Source`."""
        with ByteReader(self.path) as reader:
            header = _Header(reader)
        self._start = header.end
        self.width, self.height = header.width, header.height
        format_name, _, details = header.values.get("format", "").partition(";")
        version = header.values.get("evt", "")
        kind = _FORMAT_NAMES.get(format_name.upper()) or _EVT_VERSIONS.get(version)
        if kind is None:
            raise DataError(
                f"{self.path}: its header names neither EVT 2, 2.1 nor 3 (format {format_name!r}, "
                f"evt {version!r})."
            )
        self._kind = self._layout_of_evt21(details) if kind == "evt21" else kind

    def blocks(self) -> Iterator[RawEvents]:
        """About a megabyte of words at a time."""
        decoder = WordDecoder(self._kind, self.damage)
        with ByteReader(self.path, self._start, another=_ANOTHER_RAW) as reader:
            yield from decoder.blocks(reader)
        note = "events before the first time are left out, as they have none"
        if decoder.untimed and not any(note in known for known in self.notes):
            self.notes.append(f"{decoder.untimed:,} {note}")

    def _layout_of_evt21(self, details: str) -> str:
        """The half of a word that holds the type, by the header or else by the words."""
        if "endianness=legacy" in details:
            return "evt21_swapped"
        if "endianness=little" in details:
            return "evt21"
        with ByteReader(self.path, self._start) as reader:
            sample = reader.read(_SAMPLE_BYTES)
        halves = np.frombuffer(sample[: len(sample) // 8 * 8], dtype="<u4").reshape(-1, 2)
        if not len(halves):
            return "evt21"
        scores = [_plausibility(halves[:, half], halves[:, 1 - half]) for half in (1, 0)]
        if scores[0] == scores[1]:
            raise DataError(
                f"{self.path}: its EVT 2.1 words are of neither known layout; is it damaged?"
            )
        return "evt21" if scores[0] > scores[1] else "evt21_swapped"


def _plausibility(heads: np.ndarray, rests: np.ndarray) -> tuple[bool, int]:
    """True where all heads have a type, and the count of times, whose other half is empty.

    Read the wrong way round, a time would be an event at (0, 0) with the highest of its 32 bits.
    """
    types = heads >> 28
    return bool(np.isin(types, _EVT21_TYPES).all()), int(((types == 0x8) & (rests == 0)).sum())


class Dat(Source):
    """A DAT file of change-detection events: 32 bits of time, 14 of x, 14 of y, 4 of polarity."""

    def read_header(self, options: ReadOptions) -> None:
        """See `Source`."""
        with ByteReader(self.path) as reader:
            header = _Header(reader)
        with ByteReader(self.path, header.end) as reader:
            kind = reader.read(2)
            self._start = reader.offset
        if len(kind) < 2 or kind[0] not in _DAT_EVENT_TYPES or kind[1] != _DAT_EVENT.itemsize:
            raise DataError(
                f"{self.path}: after its header come bytes {kind.hex(' ') or 'none'}, expected an "
                "event type of 0 or 12 and a size of 8."
            )
        version = header.values.get("version")
        if version is None:
            version = _DAT_VERSION
            self.notes.append(
                "its header has no line of its version: read as version 2 of DAT, which Metavision "
                "writes; of version 1 pixels come out at wrong places"
            )
        if version != _DAT_VERSION:
            raise DataError(
                f"{self.path}: its header says version {version} of DAT, whose pixels are laid out "
                f"otherwise, expected version {_DAT_VERSION}; write the recording anew."
            )
        self.width, self.height = header.width, header.height

    def blocks(self) -> Iterator[RawEvents]:
        """About a megabyte at a time."""
        with ByteReader(self.path, self._start, another=_ANOTHER_DAT) as reader:
            for events in reader.records(_DAT_EVENT, _DAT_READ_EVENTS, self.damage):
                pixel = events["pixel"]
                yield RawEvents(
                    events["t"].astype(np.int64),
                    (pixel & 0x3FFF).astype(np.uint16),
                    (pixel >> 14 & 0x3FFF).astype(np.uint16),
                    pixel >> 28 & 1,
                )
