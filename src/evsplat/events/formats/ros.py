"""ROS 1 and 2 bags with dvs_msgs/EventArray or event_camera_msgs/EventPacket (EVT 3 inside).

`rosbags` (extra `recordings`) opens the container; messages are unpacked here, because one Python
object per event would be a thousand times slower.
"""

import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from evsplat.errors import DataError
from evsplat.events.formats.base import ZSTD_MAGIC, RawEvents, Source, parts_said, peek
from evsplat.events.formats.words import WordDecoder
from evsplat.options import ReadOptions
from evsplat.wording import counted

ROS1_MAGIC = b"#ROSBAG V2.0"
_MCAP_MAGIC = b"\x89MCAP0\r\n"
_ARRAY_TYPES = ("dvs_msgs/msg/EventArray", "prophesee_event_msgs/msg/EventArray")
_PACKET_TYPES = ("event_camera_msgs/msg/EventPacket", "event_array_msgs/msg/EventArray")
_ENCODING = "evt3"
_PIXEL = [("x", "<u2"), ("y", "<u2")]
_TIME_AND_POLARITY = [("seconds", "<u4"), ("nanoseconds", "<u4"), ("p", "u1")]
_LOOP_US, _RENUMBERED = (1 << 24) // 2, 100
"""Half the loop of EVT 3's counter, the longest time in which it is known how often it went round;
and by how much the numbers of packets fall where they begin anew, and not where some came late."""
_TELL = 0x0, 0x6, 0x8
"""Words of EVT 3 that tell row, low and high bits of the time of the events behind them."""
_ROS1_EVENT = np.dtype([*_PIXEL, *_TIME_AND_POLARITY])
# ROS 2 aligns each number, not each event: all events but the first begin two bytes after a
# multiple of four, so that two bytes of padding come before their time and one after them.
_ROS2_EVENT = np.dtype([*_PIXEL, ("", "V2"), *_TIME_AND_POLARITY, ("", "V1")])


class RosBag(Source):
    """The first event topic of a bag: a .bag file, an .mcap or .db3 file or a ROS 2 folder.

    Times of EventArray are those of ROS, times of EventPacket those of the sensor.
    """

    def read_header(self, options: ReadOptions) -> None:
        """See `Source`."""
        self._skip = options.skip
        types = _ARRAY_TYPES + _PACKET_TYPES
        with _opened(self.path) as bag:
            topics = {c.topic: c.msgtype for c in bag.connections if c.msgtype in types}
            if not topics:
                found = ", ".join(sorted({c.msgtype for c in bag.connections})) or "none"
                raise DataError(f"{self.path}: holds no event messages (types there: {found}).")
            self._topic = sorted(topics)[0]
            self._type = topics[self._topic]
            if len(topics) > 1:
                self.notes.append(f"of the topics {', '.join(sorted(topics))} the first is read")
            for _, message in self._messages(bag):
                self.width, self.height = message.width, message.height
                break

    def blocks(self) -> Iterator[RawEvents]:
        """One message at a time."""
        decoder, count = WordDecoder(_ENCODING, self.damage), 0
        lost, is_known = 0, True
        before: _Message | None = None
        with _opened(self.path) as bag:
            for number, message in self._messages(bag):
                if not message.encoding:
                    yield _array(message)
                    continue
                why = None if before is None else _begins_anew(before, message)
                if why is not None:
                    # who wants less has stopped asking before
                    if self._skip < count:
                        raise DataError(
                            f"{self.path}: another recording begins at message {number} of "
                            f"{self._topic} ({why}), expected one in a bag: "
                            f"{parts_said(self.path, count)}; give the part that belongs to the "
                            "pictures."
                        )
                    decoder = WordDecoder(_ENCODING, self.damage)
                elif before is not None and message.packet > before.packet + 1:
                    lost, is_known = lost + message.packet - before.packet - 1, False
                    self.damage.warnings["lost"] = (
                        f"by their numbers {counted(lost, 'packet')} of {self._topic} did not "
                        "arrive, nor did their events; record anew what needs them"
                    )
                before = message
                if not is_known:
                    message, is_known = _known_again(message)
                for events in self._packet(decoder, message, number):
                    count += len(events.t)
                    yield events

    def _packet(
        self, decoder: WordDecoder, message: "_Message", number: int
    ) -> Iterator[RawEvents]:
        if message.encoding != _ENCODING:
            raise DataError(
                f"{self.path}: message {number} of {self._topic} is encoded as "
                f"{message.encoding!r}, expected {_ENCODING!r}; record it so, or publish it again "
                "as dvs_msgs/EventArray (event_camera_tools) and record that."
            )
        start = 0
        while start + 1 < len(message.events):
            events, taken = decoder.decode(message.events[start:], start)
            start += taken
            yield events

    def _messages(self, bag: Any) -> Iterator[tuple[int, "_Message"]]:
        connections = [c for c in bag.connections if c.topic == self._topic]
        is_ros1 = "rosbag1" in type(bag).__module__
        for number, (_, _, data) in enumerate(bag.messages(connections)):
            if not is_ros1 and bytes(data[:4]) == ZSTD_MAGIC:
                raise DataError(
                    f"{self.path}: each of its messages is compressed by Zstandard, which only "
                    "metadata.yaml beside it tells; give the folder that holds both."
                )
            try:
                yield number, _read_message(data, is_ros1, self._type in _PACKET_TYPES)
            except (struct.error, ValueError) as error:
                self.damage.found(
                    f"message {number} of {self._topic} is damaged ({error})",
                    repaired_by="leaves out damaged messages",
                )


@dataclass(frozen=True)
class _Message:
    width: int
    height: int
    encoding: str
    """Encoding of a packet; empty for an array."""
    events: bytes
    kind: np.dtype
    """Layout of an event of an array."""
    stamp_us: int
    """When the driver sent it, by ROS's clock."""
    packet: int
    """Number of a packet, by its driver; 0 of an array."""


def _known_again(message: _Message) -> tuple[_Message, bool]:
    """A packet behind a lost one, without events whose time or row went with that one.

    False where its words do not tell all of that, so that the next one is to be looked at as well.
    """
    words = np.frombuffer(message.events, "<u2", len(message.events) // 2)
    kinds = words >> 12
    firsts = [np.flatnonzero(kinds == kind) for kind in _TELL]
    is_known = all(len(first) for first in firsts)
    from_here = max(int(first[0]) for first in firsts) if is_known else len(words)
    kept = words[np.isin(kinds, _TELL) | (np.arange(len(words)) > from_here)]
    return replace(message, events=kept.tobytes()), is_known


def _begins_anew(before: _Message, after: _Message) -> str | None:
    """Why a packet cannot be the next one of a recording; None where it may be.

    The counter of the sensor in it says neither that it began again, nor how often it went round.
    """
    if after.packet < before.packet - _RENUMBERED:
        return f"its packets are numbered from {after.packet} after {before.packet}"
    apart_us = after.stamp_us - before.stamp_us
    if not -_LOOP_US <= apart_us <= _LOOP_US:
        return f"it was sent {1e-6 * apart_us:,.1f} s after the one before"
    return None


def _array(message: _Message) -> RawEvents:
    events = np.frombuffer(message.events, message.kind)
    # halves upwards, as nanoseconds of tables and texts are rounded
    rest_us = (events["nanoseconds"].astype(np.int64) + 500) // 1000
    t = events["seconds"].astype(np.int64) * 1_000_000 + rest_us
    return RawEvents(t, events["x"], events["y"], events["p"])


class _Cursor:
    """Reads the fields of a message one after the other; ROS 2 aligns them, ROS 1 does not."""

    def __init__(self, data: bytes, is_ros1: bool) -> None:
        self._data = bytes(data)
        self._aligned = not is_ros1
        # ROS 2 messages begin with four bytes that say how they are encoded
        self._begin = self._at = 0 if is_ros1 else 4
        if self._aligned and self._data[:2] != b"\x00\x01":
            raise ValueError("expected little-endian CDR")

    def number(self, code: str) -> int:
        size = struct.calcsize(code)
        if self._aligned:
            self._at += -(self._at - self._begin) % size
        value = struct.unpack_from("<" + code, self._data, self._at)[0]
        self._at += size
        return int(value)

    def take(self, size: int) -> bytes:
        if self._at + size > len(self._data):
            raise ValueError(f"{size} bytes announced, {len(self._data) - self._at} there")
        self._at += size
        return self._data[self._at - size : self._at]

    def text(self) -> str:
        return self.take(self.number("I")).rstrip(b"\0").decode("latin-1")


def _read_message(data: bytes, is_ros1: bool, is_packet: bool) -> _Message:
    fields = _Cursor(data, is_ros1)
    if is_ros1:
        fields.number("I")  # of the message
    stamp_us = fields.number("I") * 1_000_000 + fields.number("I") // 1000
    fields.text()
    height, width = fields.number("I"), fields.number("I")
    if not (0 < width <= 1 << 16 and 0 < height <= 1 << 16):
        raise ValueError(f"a sensor of {width} x {height} pixels")
    kind = _ROS1_EVENT if is_ros1 else _ROS2_EVENT
    if not is_packet:
        count = fields.number("I")
        events = fields.take(count * kind.itemsize - (0 if is_ros1 or not count else 3))
        if not is_ros1 and count:
            events = events[:4] + bytes(2) + events[4:] + bytes(1)
        return _Message(width, height, "", events, kind, stamp_us, 0)
    packet = fields.number("Q")
    fields.number("Q")  # a base of time, of other encodings
    encoding = fields.text() or "unknown"
    fields.take(1)
    events = fields.take(fields.number("I"))
    return _Message(width, height, encoding, events, kind, stamp_us, packet)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """A reader of `rosbags`; what goes wrong in it is a `DataError`."""
    try:
        from rosbags import rosbag1, rosbag2
    except ImportError:
        raise DataError(f"{path}: to read ROS bags, pip install 'evsplat[recordings]'.") from None
    try:
        head = peek(path, len(ROS1_MAGIC)) if path.is_file() else b""
        reader: Any = rosbag1.Reader if head == ROS1_MAGIC else rosbag2.Reader
        if head and reader is rosbag2.Reader:  # which goes by the suffix
            plugins = rosbag2.Reader.STORAGE_PLUGINS
            plugin = plugins[".mcap" if head.startswith(_MCAP_MAGIC) else ".db3"]
            reader = type("_", (reader,), {"STORAGE_PLUGINS": {path.suffix: plugin}})
        with reader(path) as bag:
            yield bag
    except (DataError, GeneratorExit):
        raise
    except Exception as error:
        reason = re.sub(r"\s+", " ", str(error))[:200]
        raise DataError(
            f"{path}: the bag cannot be read ({reason}); where its recording was cut off, make it "
            "whole: 'rosbag reindex' (ROS 1), 'ros2 bag reindex', or 'mcap recover' of an .mcap."
        ) from None
