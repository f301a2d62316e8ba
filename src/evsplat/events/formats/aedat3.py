"""AEDAT 3.1 (cAER, early DV): polarity events and frames with their exposure; the rest is skipped.

Text lines up to #!END-HEADER, then packets of one kind of event each: a header of 28 bytes and
events of one size, little-endian.
https://docs.inivation.com/software/software-advanced-usage/file-formats/aedat-3.1.html
"""

import re
from collections.abc import Iterator

import numpy as np

from evsplat.errors import DataError
from evsplat.events.formats.base import (
    ByteReader,
    Damage,
    RawEvents,
    RecordedFrame,
    Source,
    two_recordings,
)
from evsplat.options import ReadOptions

MAGIC = b"#!AER-DAT3.1"
_END = b"#!END-HEADER"
_MAX_LINE_BYTES = 1 << 16
_MAX_HEADER_BYTES = 16 << 20
# cAER writes packets of some thousand events; one frame of 640x480 in colour has 2 MB.
_MAX_PACKET_BYTES = 256 << 20
_SIZES = {
    "davis128": (128, 128),
    "davis208": (208, 192),
    "davis240": (240, 180),
    "davis346": (346, 260),
    "davis640": (640, 480),
    "dvs128": (128, 128),
}
_POLARITY, _FRAME = 1, 2
_PERIOD_US = 1 << 31
_HEAD = np.dtype(
    [("kind", "<i2"), ("source", "<i2")]
    + [(name, "<i4") for name in ("size", "time_at", "overflow", "capacity", "number", "valid")]
)
_EVENT = np.dtype([("data", "<u4"), ("t", "<i4")])
_FRAME_HEAD = np.dtype(
    [("info", "<u4")]
    + [(name, "<i4") for name in ("begin", "end", "opened", "closed", "width", "height", "x", "y")]
)
_CHANNELS = (1, 3, 4)


class Aedat3(Source):
    """An AEDAT 3.1 file; the events of a source that has frames as well, where one has, and those.

    Else the events and the frames of the first source that has any.
    """

    def read_header(self, options: ReadOptions) -> None:
        """See `Source`."""
        self._kinds: set[int] = set()
        lines = self._lines()
        packing = _value(lines, "Format")
        if packing not in (None, "RAW"):
            raise DataError(
                f"{self.path}: its packets are packed ({packing}), expected '#Format: RAW'; "
                "write it as AEDAT4 with DV, or record without compression."
            )
        names = _sensors(lines)
        self._source = source = self._first(_POLARITY)
        if len(names) > 1 and source is not None and self._first(_FRAME, source) is None:
            both = (n for n in names if self._first(_FRAME, n) == self._first(_POLARITY, n) == n)
            self._source = next(both, source)
        name = self._sensor(names)
        self.width, self.height = next(
            (size for chip, size in _SIZES.items() if name.startswith(chip)), (None, None)
        )
        if self.width is None and options.width is None:
            # a sensor that is not named has at least the pixels of its pictures
            damage = Damage(self.path, repair=True)
            first = next(self._frames(damage), None)
            if first is not None:
                self.height, self.width = first.image.shape[:2]
                self.notes.append(
                    f"sensor {name or '(not named)'}: its size is taken to be that of its first "
                    f"frame, {self.width}x{self.height}"
                )

    def blocks(self) -> Iterator[RawEvents]:
        """Packets of polarity events, without those that were marked as invalid."""
        for offset, head, body in self._packets(_POLARITY, self.damage, self._source):
            if head["size"] != _EVENT.itemsize:
                _broken(self.damage, offset, f"its events have {head['size']} bytes")
                continue
            events = np.frombuffer(body, _EVENT)
            data = events["data"]
            valid = (data & 1) == 1
            if not valid.all():
                events, data = events[valid], data[valid]
            times = events["t"].astype(np.int64) + _epoch(head)
            polarity = np.where(data & 2, 1, -1).astype(np.int8)
            yield RawEvents(times, data >> 17, (data >> 2) & 0x7FFF, polarity)

    def frames(self) -> Iterator[RecordedFrame]:
        """Frames, 16 bits of each value made 8, without those that were marked as invalid."""
        return self._frames(self.damage)

    def _frames(self, damage: Damage) -> Iterator[RecordedFrame]:
        ahead = Damage(self.path, repair=True)
        own = next(self._packets(_FRAME, ahead, self._source), None)
        if own is None and _FRAME not in self._kinds and not ahead.counts:
            return  # seen to the end already, and whole: another pass would find nothing
        source = None if own is None else self._source
        for offset, head, body in self._packets(_FRAME, damage, source):
            if head["size"] < _FRAME_HEAD.itemsize:
                _broken(damage, offset, f"its frames have {head['size']} bytes")
                continue
            for first in range(0, len(body), int(head["size"])):
                try:
                    frame = self._frame(body[first : first + int(head["size"])], _epoch(head))
                except ValueError as error:
                    _broken(damage, offset, str(error))
                    continue
                if frame is not None:
                    yield frame

    def _frame(self, data: bytes, epoch_us: int) -> RecordedFrame | None:
        head = np.frombuffer(data, _FRAME_HEAD, 1)[0]
        info, width, height = int(head["info"]), int(head["width"]), int(head["height"])
        if not info & 1:
            return None
        channels = info >> 1 & 0x7
        opened, closed = int(head["opened"]), int(head["closed"])
        count = width * height * channels
        room = (len(data) - _FRAME_HEAD.itemsize) // 2
        if min(width, height) <= 0 or not 0 < count <= room or channels not in _CHANNELS:
            raise ValueError(f"a frame of {width}x{height}x{channels} in {len(data)} bytes")
        if opened - closed > _PERIOD_US // 2:
            opened -= _PERIOD_US  # the clock began again within the exposure
        if closed < opened:
            raise ValueError(f"a frame exposed from {opened} to {closed} us")
        if channels == 1 and info >> 4 & 0xF:
            raise DataError(
                f"{self.path}: its frames hold one colour in each pixel (the mosaic of a colour "
                "DAVIS), expected grey or developed colours; write it as AEDAT4 with DV."
            )
        values = np.frombuffer(data, "<u2", count, _FRAME_HEAD.itemsize)
        image = (values >> 8).astype(np.uint8).reshape(height, width, channels)
        picture = image[..., 0] if channels == 1 else image[..., :3]
        return RecordedFrame(np.ascontiguousarray(picture), (opened + epoch_us, closed + epoch_us))

    def _lines(self) -> list[str]:
        """The header's lines, their line ends removed; leaves where the packets begin."""
        lines: list[str] = []
        with ByteReader(self.path) as reader:
            while reader.offset < _MAX_HEADER_BYTES:
                line = reader.read_line(_MAX_LINE_BYTES)
                if not line.startswith(b"#") or not line.endswith(b"\n"):
                    break
                if line.startswith(_END):
                    self._start = reader.offset
                    return lines
                lines.append(line.decode("latin-1").strip())
        raise DataError(
            f"{self.path}: its AEDAT 3.1 header has no line {_END.decode()}; copy it again."
        )

    def _first(self, kind: int, source: int | None = None) -> int | None:
        """The source of the first packet of a kind; None where there is none."""
        packet = next(self._packets(kind, Damage(self.path, repair=True), source), None)
        return None if packet is None else int(packet[1]["source"])

    def _sensor(self, names: dict[int, str]) -> str:
        """Name of the sensor whose events are read, in small letters; empty where none is named."""
        if len(names) > 1 and self._source is not None:
            listed = ", ".join(f"{number} ({name})" for number, name in names.items())
            self.notes.append(f"sources {listed}: only events of source {self._source} are read")
        first = next(iter(names.values()), "")
        return (first if self._source is None else names.get(self._source, first)).lower()

    def _packets(
        self, kind: int, damage: Damage, source: int | None = None
    ) -> Iterator[tuple[int, np.void, bytes]]:
        """Offset, header and events of each packet of a kind, of the first source if not given."""
        with ByteReader(self.path, self._start) as reader:
            while True:
                offset = reader.offset
                data = reader.read(_HEAD.itemsize)
                if not data:
                    return
                if data.startswith(MAGIC):
                    raise two_recordings(self.path, offset, zipped=reader.zipped)
                head = np.frombuffer(data, _HEAD)[0] if len(data) == _HEAD.itemsize else None
                self._kinds.add(-1 if head is None else int(head["kind"]))
                size = -1 if head is None else int(head["size"]) * int(head["number"])
                sound = head is not None and head["number"] >= 0 and head["size"] > 0
                if head is not None and sound and size <= _MAX_PACKET_BYTES:
                    if source is None and head["kind"] == kind:
                        source = head["source"]
                    if head["kind"] == kind and head["source"] == source:
                        body = reader.read(size)
                        if len(body) == size:
                            yield offset, head, body
                            continue
                    else:
                        reader.skip_to(offset + _HEAD.itemsize + size)
                        if reader.offset == offset + _HEAD.itemsize + size:
                            continue
                damage.found(
                    f"ends in the middle of a packet, or is damaged, at byte {offset}",
                    repaired_by="keeps the packets before the cut",
                )
                return


def _sensors(lines: list[str]) -> dict[int, str]:
    """Source to the name of its sensor."""
    found = (re.fullmatch(r"#\s*Source (\d+): *(.*)", line) for line in lines)
    return {int(match[1]): match[2].strip() for match in found if match}


def _value(lines: list[str], key: str) -> str | None:
    """What the first header line ``#key: value`` says."""
    found = (re.fullmatch(rf"#\s*{key}: *(.*)", line) for line in lines)
    return next((match[1].strip() for match in found if match), None)


def _epoch(head: np.void) -> int:
    """Microseconds that the 31-bit times of a packet are counted from."""
    return int(head["overflow"]) * _PERIOD_US


def _broken(damage: Damage, offset: int, reason: str) -> None:
    damage.found(
        f"the packet at byte {offset} is damaged ({reason})",
        repaired_by="leaves out damaged packets",
    )
