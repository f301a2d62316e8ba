"""AEDAT 2 (jAER): polarity events of DAVIS and DVS128; frames, IMU and triggers are passed over.

Big-endian pairs of address and time in microseconds after lines that begin with #.
https://docs.inivation.com/software/software-advanced-usage/file-formats/aedat-2.0.html
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from evsplat.errors import DataError
from evsplat.events.formats.base import ByteReader, RawEvents, Source
from evsplat.options import ReadOptions

_CONTROL = re.compile(rb"[\x00-\x08\x0a-\x1f]")
_MAX_LINE_BYTES = 1 << 16
_MAX_HEADER_BYTES = 16 << 20
_READ_EVENTS = 1 << 17
_ANOTHER = re.compile(rb"#!AER-DAT2")
_PAIR = np.dtype([("address", ">u4"), ("t", ">i4")])


@dataclass(frozen=True)
class _Chip:
    """Layout of an address: columns count from the right, rows from the bottom."""

    width: int
    height: int
    not_polarity: int
    """Bits that only frames, IMU, triggers and external events have."""
    x_shift: int
    x_bits: int
    y_shift: int
    y_bits: int
    polarity: int
    brighter: int
    """Value of the polarity bit for brighter."""


def _davis(width: int, height: int) -> _Chip:
    return _Chip(width, height, 0x80000400, 12, 10, 22, 9, 0x800, 0x800)


_CHIPS = {
    "davis240": _davis(240, 180),
    "davis346": _davis(346, 260),
    "davis640": _davis(640, 480),
    "dvs128": _Chip(128, 128, 0x8000, 1, 7, 8, 7, 0x1, 0x0),
}


class Aedat2(Source):
    """An AEDAT2 file; polarity events alone are read."""

    def read_header(self, options: ReadOptions) -> None:
        """See `Source`."""
        header = self._comments()
        name = re.search(r"AEChip: *([\w.]+)", header)
        chip_name = name[1].split(".")[-1] if name else ""
        known = (chip for key, chip in _CHIPS.items() if chip_name.lower().startswith(key))
        chip = next(known, None)
        if chip is None:
            if options.width is None or options.height is None:
                raise DataError(
                    f"{self.path}: recorded by chip {chip_name or '(not named)'}, expected one of "
                    f"{', '.join(_CHIPS)}; for another DAVIS give --width and --height of "
                    "'evsplat convert'."
                )
            chip = _davis(options.width, options.height)
            self.notes.append(f"chip {chip_name or '(not named)'} is read as a DAVIS")
        self._chip = chip
        self.width, self.height = chip.width, chip.height

    def blocks(self) -> Iterator[RawEvents]:
        """About a megabyte at a time."""
        chip = self._chip
        with ByteReader(self.path, self._start, another=_ANOTHER) as reader:
            for pairs in reader.records(_PAIR, _READ_EVENTS, self.damage):
                address = pairs["address"].astype(np.uint32)
                keep = (address & chip.not_polarity) == 0
                address = address[keep]
                x = (address >> chip.x_shift & ((1 << chip.x_bits) - 1)).astype(np.int32)
                y = (address >> chip.y_shift & ((1 << chip.y_bits) - 1)).astype(np.int32)
                yield RawEvents(
                    pairs["t"][keep].astype(np.int64),
                    chip.width - 1 - x,
                    chip.height - 1 - y,
                    (address & chip.polarity) == chip.brighter,
                )

    def _comments(self) -> str:
        """The lines that begin with #, decoded; remembers where they end."""
        lines: list[bytes] = []
        with ByteReader(self.path) as reader:
            while True:
                self._start = reader.offset
                line = reader.read_line(_MAX_LINE_BYTES)
                # An address may begin with the byte # too. What follows has control characters, or
                # a line's end comes at once, but then not that of the lines before.
                end = b"\r\n" if lines and lines[0].endswith(b"\r\n") else b"\n"
                is_text = line.endswith(end) and not _CONTROL.search(line.rstrip(b"\r\n"))
                if not line.startswith(b"#") or not is_text:
                    return b"".join(lines).decode("latin-1")
                lines.append(line)
                if line.strip() == b"#!END-HEADER":
                    self._start = reader.offset
                    return b"".join(lines).decode("latin-1")
                if self._start > _MAX_HEADER_BYTES:
                    raise DataError(f"{self.path}: its header does not end.")
