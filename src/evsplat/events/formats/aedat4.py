"""AEDAT 4 (iniVation DV): events and frames with their exposure; IMU and triggers are skipped.

A text line, a FlatBuffers header with an XML description of the streams, then packets:
int32 stream, int32 size, payload (compressed), up to the table of packets at the end.
https://docs.inivation.com/software/software-advanced-usage/file-formats/aedat-4.0.html
"""

import re
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import lz4.frame
import numpy as np

from evsplat.errors import DataError
from evsplat.events.formats.base import (
    ByteReader,
    RawEvents,
    RecordedFrame,
    Source,
    two_recordings,
)
from evsplat.options import ReadOptions

MAGIC = b"#!AER-DAT4.0\r\n"
_ANOTHER = re.compile(re.escape(MAGIC))
_MAX_HEADER_BYTES = 16 << 20
# DV writes packets of a few hundred kilobytes; a picture of 20 megapixels in colour has 60 MB.
_MAX_PACKET_BYTES = 256 << 20
_LZ4_MAX_RATIO = 256
_EVENT = np.dtype(
    {
        "names": ["t", "x", "y", "p"],
        "formats": ["<i8", "<i2", "<i2", "u1"],
        "offsets": [0, 8, 10, 12],
        "itemsize": 16,
    }
)
# OpenCV's type numbers -> channels
_PICTURE_CHANNELS = {0: 1, 16: 3, 24: 4}
_DEPTHS = ("8U", "8S", "16U", "16S", "32S", "32F", "64F", "16F")
"""OpenCV's words for the lowest three bits of a type number; above them are the channels."""


class _Stream(NamedTuple):
    """What the header tells of a stream."""

    kind: str
    """EVTS, FRME, ..."""
    source: str
    """Name of the camera; empty where the file does not say."""
    width: int | None
    height: int | None


_Streams = dict[int, _Stream]


class Aedat4(Source):
    """An AEDAT4 file; its first event stream and its first frame stream are read."""

    def read_header(self, options: ReadOptions) -> None:
        """See `Source`."""
        compression, table_position, description = self._preamble()
        # the table of packets at the end is not needed; 0 or -1 where there is none
        self._end = table_position if table_position > 0 else None
        if self._end is not None:
            self._refuse_another(self._end)
        self._decompress = _decompressor(self.path, compression)
        streams = self._streams(description)
        framed = {stream.source for stream in streams.values() if stream.kind == "FRME"}
        self._events = self._choose(streams, "EVTS", framed)
        if self._events is None:
            raise DataError(f"{self.path}: holds no event stream (found {_names(streams)}).")
        of_events = streams[self._events]
        self.width, self.height = of_events.width, of_events.height
        self._frames = self._choose(streams, "FRME", {of_events.source})

    def blocks(self) -> Iterator[RawEvents]:
        """Packets of the event stream."""
        for offset, data in self._packets(self._events, b"EVTS"):
            try:
                elements = _Table.root(data, 4).vector(0, _EVENT.itemsize)
            except _FlatbufferError as error:
                self._broken(offset, str(error))
                continue
            events = np.frombuffer(elements, dtype=_EVENT)
            yield RawEvents(events["t"], events["x"], events["y"], events["p"])

    def frames(self) -> Iterator[RecordedFrame]:
        """Packets of the frame stream."""
        if self._frames is None:
            return
        for offset, data in self._packets(self._frames, b"FRME"):
            try:
                frame = _frame(self.path, _Table.root(data, 4))
            except (_FlatbufferError, ValueError) as error:
                self._broken(offset, str(error))
                continue
            yield frame

    def _preamble(self) -> tuple[int, int, bytes]:
        """Compression, where the packets end, and the XML description of the streams."""
        with ByteReader(self.path) as reader:
            if reader.read(len(MAGIC)) != MAGIC:
                raise DataError(f"{self.path}: its first line is not that of AEDAT 4.0.")
            size = int.from_bytes(reader.read(4), "little")
            data = reader.read(size) if size <= _MAX_HEADER_BYTES else b""
            self._first_packet = reader.offset
        try:
            if len(data) < size or not size:
                raise _FlatbufferError(f"{size} bytes announced, {len(data)} there")
            table = _Table.root(data)
            return table.integer(0, "i"), table.integer(1, "q", -1), bytes(table.vector(2, 1))
        except _FlatbufferError as error:
            raise DataError(f"{self.path}: its AEDAT4 header is damaged ({error}).") from None

    def _refuse_another(self, end: int) -> None:
        """Raise where another recording follows the table of packets, which nothing would read."""
        with ByteReader(self.path, end, another=_ANOTHER) as reader:
            while reader.read(1 << 20):
                pass

    def _streams(self, description: bytes) -> _Streams:
        try:
            if b"<!" in description:
                raise ValueError("declarations are not expected")
            tree = ElementTree.fromstring(description.rstrip(b"\0").decode("utf-8"))
            streams = {}
            for node in tree.iterfind(".//node[@name='outInfo']/node"):
                values = {attr.get("key"): attr.text or "" for attr in node.iter("attr")}
                size = [int(values[key]) if key in values else None for key in ("sizeX", "sizeY")]
                kind = values.get("typeIdentifier", "")
                source = values.get("source", "")
                streams[int(node.get("name", ""))] = _Stream(kind, source, size[0], size[1])
            return streams
        except (ElementTree.ParseError, ValueError) as error:
            raise DataError(
                f"{self.path}: the list of streams in its AEDAT4 header is damaged ({error})."
            ) from None

    def _choose(self, streams: _Streams, kind: str, cameras: set[str]) -> int | None:
        """The first stream of a kind, of ``cameras`` where they have one."""
        found = sorted(number for number, stream in streams.items() if stream.kind == kind)
        own = [number for number in found if streams[number].source in cameras]
        chosen = next(iter(own or found), None)
        if len(found) > 1:
            self.notes.append(f"{kind} streams {found}: only stream {chosen} is read")
        return chosen

    def _packets(self, stream: int | None, identifier: bytes) -> Iterator[tuple[int, bytes]]:
        """Offset and decompressed, size-prefixed buffer of each packet of a stream."""
        with ByteReader(self.path, self._first_packet) as reader:
            while self._end is None or reader.offset < self._end:
                offset = reader.offset
                head = reader.read(8)
                if not head and self._end is None:
                    return
                number, size = struct.unpack("<ii", head) if len(head) == 8 else (-1, 0)
                wanted = number == stream and 0 <= size <= _MAX_PACKET_BYTES
                payload = reader.read(size) if wanted else b""
                if not wanted:
                    reader.skip_to(offset + 8 + max(size, 0))
                if head == MAGIC[:8]:
                    raise two_recordings(self.path, offset, zipped=reader.zipped)
                if len(head) < 8 or size < 0 or reader.offset < offset + 8 + size:
                    self.damage.found(
                        f"ends in the middle of a packet, or is damaged, at byte {offset}",
                        repaired_by="keeps the packets before the cut",
                    )
                    return
                if number != stream:
                    continue
                try:
                    if not wanted:
                        raise ValueError(f"it has {size} bytes")
                    data = self._decompress(payload)
                    if data[8:12] != identifier:
                        raise ValueError(f"it is no {identifier.decode()} buffer")
                except (RuntimeError, ValueError, EOFError) as error:
                    self._broken(offset, str(error))
                    continue
                yield offset, data

    def _broken(self, offset: int, reason: str) -> None:
        self.damage.found(
            f"the packet at byte {offset} is damaged ({reason})",
            repaired_by="leaves out damaged packets",
        )


def _frame(path: Path, table: "_Table") -> RecordedFrame:
    start, end = table.integer(3, "q"), table.integer(4, "q")
    if not start and not end:
        # dv-processing reads such a frame as well: its time is the start of its exposure
        start = table.integer(0, "q")
        end = start + table.integer(11, "q")
    kind, width, height = table.integer(5, "b"), table.integer(6, "h"), table.integer(7, "h")
    pixels = np.frombuffer(table.vector(10, 1), dtype=np.uint8)
    channels = _PICTURE_CHANNELS.get(kind)
    if channels is None:
        depth, of_type = _DEPTHS[kind & 7], (kind >> 3) + 1
        expected = "expected 8 bits with 1, 3 or 4 channels (CV_8UC1, CV_8UC3, CV_8UC4)"
        if pixels.size == width * height * of_type * int(depth[:-1]) // 8 > 0:
            raise DataError(
                f"{path}: its frames have pixels of OpenCV's type CV_{depth}C{of_type}, "
                f"{expected}; write them so, or give them as pictures to 'evsplat import folder'."
            )
        raise ValueError(f"pixel type {kind}, {expected}")
    if width <= 0 or height <= 0 or pixels.size != width * height * channels or end < start:
        raise ValueError(
            f"a frame of {width}x{height}x{channels} with {pixels.size} bytes, exposed from "
            f"{start} to {end}"
        )
    if channels == 1:
        return RecordedFrame(pixels.reshape(height, width).copy(), (start, end))
    image = pixels.reshape(height, width, channels)[..., 2::-1]
    return RecordedFrame(np.ascontiguousarray(image), (start, end))


def _names(streams: _Streams) -> str:
    return ", ".join(sorted({stream.kind for stream in streams.values()})) or "none"


def _decompressor(path: Path, compression: int) -> Callable[[bytes], bytes]:
    if compression == 0:
        return bytes
    if compression in (1, 2):
        return _lz4
    if compression in (3, 4):
        try:
            import zstandard
        except ImportError:
            raise DataError(
                f"{path}: its packets are packed with Zstandard; "
                "pip install 'evsplat[recordings]' to read it."
            ) from None
        decompressor = zstandard.ZstdDecompressor(max_window_size=_MAX_PACKET_BYTES)

        def zstd(payload: bytes) -> bytes:
            try:
                if zstandard.frame_content_size(payload) > _MAX_PACKET_BYTES:
                    raise ValueError("it unpacks to more than a packet can hold")
                return decompressor.decompress(payload, max_output_size=_MAX_PACKET_BYTES)
            except zstandard.ZstdError as error:
                raise ValueError(str(error)) from None

        return zstd
    raise DataError(f"{path}: unknown compression {compression} in its AEDAT4 header.")


def _lz4(payload: bytes) -> bytes:
    announced = lz4.frame.get_frame_info(payload)["content_size"]
    if max(announced, _LZ4_MAX_RATIO * len(payload)) <= _MAX_PACKET_BYTES:
        return lz4.frame.decompress(payload)
    # slower, because the buffer is made as large as the limit at once
    unpacker = lz4.frame.LZ4FrameDecompressor()
    data = unpacker.decompress(payload, max_length=_MAX_PACKET_BYTES)
    if not unpacker.eof:
        raise ValueError("it ends early or unpacks to more than a packet can hold")
    return data


class _FlatbufferError(ValueError):
    """An offset leads outside of the buffer."""


class _Table:
    """A table of a FlatBuffers buffer, fields numbered as in the schema, every offset checked.

    Layout: https://flatbuffers.dev/internals/. The official package trusts its offsets, which a
    damaged file cannot be read with.
    """

    def __init__(self, data: bytes, position: int) -> None:
        self._data = data
        self._position = position
        self._vtable = position - self._unpack("<i", position)
        self._vtable_size = self._unpack("<H", self._vtable)

    @classmethod
    def root(cls, data: bytes, start: int = 0) -> "_Table":
        """The table that the buffer at ``start`` (after a size prefix) begins with."""
        if start + 4 > len(data):
            raise _FlatbufferError("the buffer ends early")
        return cls(data, start + struct.unpack_from("<I", data, start)[0])

    def integer(self, index: int, code: str, default: int = 0) -> int:
        """A scalar field; ``code`` is that of `struct`, without byte order."""
        at = self._field(index)
        return default if at is None else self._unpack(f"<{code}", at)

    def vector(self, index: int, item_bytes: int) -> memoryview:
        """The bytes of a vector (or string, ``item_bytes=1``); empty where the field is absent."""
        at = self._field(index)
        if at is None:
            return memoryview(b"")
        start = at + self._unpack("<I", at)
        size = self._unpack("<I", start) * item_bytes
        if start + 4 + size > len(self._data):
            raise _FlatbufferError(f"a vector of {size} bytes does not fit in the buffer")
        return memoryview(self._data)[start + 4 : start + 4 + size]

    def _field(self, index: int) -> int | None:
        slot = 4 + 2 * index
        if slot + 2 > self._vtable_size:
            return None
        offset = self._unpack("<H", self._vtable + slot)
        return self._position + offset if offset else None

    def _unpack(self, code: str, position: int) -> int:
        if position < 0 or position + struct.calcsize(code) > len(self._data):
            raise _FlatbufferError(f"an offset leads to byte {position} of {len(self._data)}")
        return struct.unpack_from(code, self._data, position)[0]
