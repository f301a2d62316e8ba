"""Encoders of binary formats, one event at a time, written from the formats' descriptions."""

import struct

import lz4.frame
import numpy as np

from evsplat.events import EventStream


def rows(s: EventStream) -> list[tuple[int, int, int, int]]:
    """(t, x, y, on) as Python numbers."""
    columns = (s.t, s.x, s.y, s.p > 0)
    return [tuple(int(value) for value in row) for row in zip(*columns, strict=True)]


def evt2(s: EventStream, header: str = "% evt 2.0\n% geometry 320x240\n") -> bytes:
    words, high = [], None
    for t, x, y, on in rows(s):
        if t >> 6 != high:
            high = t >> 6
            words.append(0x8 << 28 | high & 0xFFFFFFF)
        words.append(on << 28 | (t & 63) << 22 | x << 11 | y)
    return header.encode() + b"".join(struct.pack("<I", word) for word in words)


def evt21(s: EventStream, header: str, *, swapped: bool) -> bytes:
    """Events of one time, row and polarity that fall in the same 32 columns share a word.

    Events of a word come out by column, so ``s`` must have them in that order.
    """
    words, high, last = [], None, None
    for t, x, y, on in rows(s):
        if t >> 6 != high:
            high = t >> 6
            words.append((0x8 << 28 | high & 0xFFFFFFF) << 32)
            last = None
        key = (t, x // 32, y, on)
        if key == last and not words[-1] >> (x % 32) & 1 and words[-1] & 0xFFFFFFFF < 1 << x % 32:
            words[-1] |= 1 << x % 32
            continue
        words.append((on << 28 | (t & 63) << 22 | x // 32 * 32 << 11 | y) << 32 | 1 << x % 32)
        last = key
    halves = ((word & 0xFFFFFFFF, word >> 32) for word in words)
    return header.encode() + b"".join(
        struct.pack("<II", *h[:: -1 if swapped else 1]) for h in halves
    )


def evt3(s: EventStream, header: str = "% evt 3.0\n% format EVT3;height=240;width=320\n") -> bytes:
    """Runs of one time, row and polarity with rising columns as vectors of 12 or 8, else singly."""
    words: list[int] = []
    state: dict[str, int | None] = {"high": None, "low": None, "y": None}
    events = rows(s)
    at = 0
    while at < len(events):
        t, x, y, on = events[at]
        if t >> 12 != state["high"]:
            state.update(high=t >> 12, low=None)
            words.append(0x8 << 12 | t >> 12 & 0xFFF)
        if t & 0xFFF != state["low"]:
            state["low"] = t & 0xFFF
            words.append(0x6 << 12 | t & 0xFFF)
        if y != state["y"]:
            state["y"] = y
            words.append(y)
        run = [x]
        while at + len(run) < len(events):
            t2, x2, y2, on2 = events[at + len(run)]
            if (t2, y2, on2) != (t, y, on) or not run[-1] < x2 < x + 20:
                break
            run.append(x2)
        if len(run) == 1:
            words.append(0x2 << 12 | on << 11 | x)
        else:
            words.append(0x3 << 12 | on << 11 | x)
            words.append(0x4 << 12 | sum(1 << c - x for c in run if c < x + 12))
            words.append(0x5 << 12 | sum(1 << c - x - 12 for c in run if c >= x + 12))
        at += len(run)
    return header.encode() + b"".join(struct.pack("<H", word) for word in words)


def dat(s: EventStream, width: int = 320, height: int = 240) -> bytes:
    header = f"% Data file containing CD events.\n% Version 2\n% Height {height}\n% Width {width}\n"
    body = (struct.pack("<II", t & 0xFFFFFFFF, on << 28 | y << 14 | x) for t, x, y, on in rows(s))
    return header.encode() + b"\x0c\x08" + b"".join(body)


def aedat2(s: EventStream, chip: str, width: int, height: int) -> bytes:
    """With an IMU sample, a frame sample and an external event among the events of a DAVIS."""
    header = f"#!AER-DAT2.0\r\n# AEChip: eu.seebetter.ini.chips.davis.{chip}\r\n"
    body = []
    for t, x, y, on in rows(s):
        x, y = width - 1 - x, height - 1 - y
        if chip == "DVS128":
            address = y << 8 | x << 1 | (not on)
        else:
            address = y << 22 | x << 12 | on << 11
            if len(body) % 7 == 3:
                body.append(struct.pack(">Ii", 0x80000000 | address, t))
            if len(body) % 11 == 5:
                body.append(struct.pack(">Ii", address | 0x400, t))
        body.append(struct.pack(">Ii", address, t))
    return header.encode() + b"".join(body)


def aedat3_frame_info(channels: int, *, colours: int = 0) -> bytes:
    """First word of a frame of AEDAT 3.1, up to the start of its frame at 987,654."""
    return struct.pack("<Ii", 1 | channels << 1 | colours << 4, 987_654)


def aedat3(
    s: EventStream,
    width: int,
    height: int,
    frames: list[tuple[np.ndarray, int, int]] = (),
    *,
    packet: int = 700,
    invalid_every: int = 0,
    sensor: str = "SENSOR",
    source: int = 1,
) -> bytes:
    """Packets of AEDAT 3.1; a new one where the 31 bits of the clock are over. One of IMU between.

    Without frames a black one says the size of the sensor.
    """
    lines = "#!AER-DAT3.1", "#Format: RAW", f"#Source {source}: {sensor}", "#!END-HEADER"
    out = "".join(f"{line}\r\n" for line in lines).encode()

    def add(kind: int, size: int, overflow: int, data: bytes) -> None:
        nonlocal out
        count = len(data) // size
        out += struct.pack("<hhiiiiii", kind, source, size, 4, overflow, count, count, count) + data

    pending, epoch = b"", 0
    for index, (t, x, y, on) in enumerate(rows(s)):
        if pending and (t >> 31 != epoch or len(pending) >= 8 * packet):
            add(1, 8, epoch, pending)
            add(3, 36, epoch, bytes(range(36)))
            pending = b""
        epoch = t >> 31
        valid = not invalid_every or index % invalid_every != 0
        word = int(valid) | bool(on) << 1 | y << 2 | x << 17
        pending += struct.pack("<Ii", word, t & 0x7FFFFFFF)
    if pending:
        add(1, 8, epoch, pending)
    for image, start, end in frames or [(np.zeros((height, width), np.uint8), 0, 1)]:
        channels = 1 if image.ndim == 2 else image.shape[2]
        low = (1 << 31) - 1
        head = aedat3_frame_info(channels) + struct.pack(
            "<7i", 987_655, start & low, end & low, image.shape[1], image.shape[0], 0, 0
        )
        # what is lost of 16 bits is noise
        noise = np.arange(image.size).reshape(image.shape) % 256
        pixels = (image.astype("<u2") << 8) + noise.astype("<u2")
        add(2, len(head) + 2 * image.size, end >> 31, head + pixels.tobytes())
    return out


def event_stream(s: EventStream, width: int, height: int, kind: int = 1) -> bytes:
    """Kind 1: DVS; 2: ATIS, with an exposure measurement after every third event."""
    body, last = [], 0
    full = 127 if kind == 1 else 63
    for number, (t, x, y, on) in enumerate(rows(s)):
        since, last = t - last, t
        while since >= full:
            times = 1 if kind == 1 else min(3, since // full)
            body.append(bytes([0xFF] if kind == 1 else [0xFC | times]))
            since -= full * times
        head = since << 1 | on if kind == 1 else since << 2 | on << 1
        pixel = struct.pack("<HH", x, height - 1 - y)
        body.append(bytes([head]) + pixel)
        if kind == 2 and number % 3 == 0:
            body.append(bytes([1]) + pixel)
    head = b"Event Stream" + bytes([2, 0, 0, kind]) + struct.pack("<HH", width, height)
    return head + b"".join(body)


def flatbuffer(
    fields: dict[int, bytes], vectors: dict[int, tuple[int, bytes]], name: bytes
) -> bytes:
    """A size-prefixed buffer of one table: scalars by field number, vectors (count, bytes)."""
    count = max([*fields, *vectors], default=-1) + 1
    order = sorted([*fields, *vectors], key=lambda f: -len(fields.get(f, b"1234")))
    offsets, table = dict.fromkeys(range(count), 0), bytearray(4)
    for field in order:
        value = fields.get(field, b"\0\0\0\0")
        while len(table) % len(value):
            table += b"\0"
        offsets[field] = len(table)
        table += value
    vtable = struct.pack(f"<HH{count}H", 4 + 2 * count, len(table), *offsets.values())
    vtable += b"\0" * (-len(vtable) % 8)
    # prefix 4, root offset 4, identifier 4, padding 4
    table_at = 16 - 4 + len(vtable)
    table[0:4] = struct.pack("<i", len(vtable))
    tail = bytearray()
    for field, (length, data) in vectors.items():
        tail += b"\0" * (-len(tail) % 8)
        here = table_at + offsets[field]
        there = table_at + len(table) + len(tail)
        table[offsets[field] : offsets[field] + 4] = struct.pack("<I", there - here)
        tail += struct.pack("<I", length) + data
    body = struct.pack("<I", table_at) + name.ljust(4, b"\0") + b"\0" * 4 + vtable + table + tail
    return struct.pack("<I", len(body)) + body


_XML = """<dv version="2.0"><node name="outInfo" path="/mainloop/Recorder/outInfo/">
<node name="0"><attr key="compression" type="string">LZ4</attr>
<attr key="typeIdentifier" type="string">EVTS</attr>
<node name="info"><attr key="sizeX" type="int">{w}</attr><attr key="sizeY" type="int">{h}</attr>
</node></node>
<node name="1"><attr key="typeIdentifier" type="string">FRME</attr></node>
<node name="2"><attr key="typeIdentifier" type="string">IMUS</attr></node></node></dv>"""


def aedat4_events(s: EventStream) -> bytes:
    """What a packet of events holds."""
    data = b"".join(struct.pack("<qhh?3x", t, x, y, bool(on)) for t, x, y, on in rows(s))
    return flatbuffer({}, {0: (len(s), data)}, b"EVTS")


def aedat4(
    s: EventStream,
    width: int,
    height: int,
    frames: list[tuple[np.ndarray, int, int]] = (),
    *,
    compression: int = 1,
    packet: int = 700,
    table_at: int = -1,
    description: str = _XML,
) -> bytes:
    """Packets of events with one of IMU between, then frames (image, start, end of exposure)."""
    xml = description.format(w=width, h=height).encode()
    header = flatbuffer(
        {0: struct.pack("<i", compression), 1: struct.pack("<q", table_at)},
        {2: (len(xml), xml)},
        b"IOHE",
    )
    out = b"#!AER-DAT4.0\r\n" + header

    def add(stream: int, payload: bytes) -> None:
        nonlocal out
        if compression in (1, 2):
            payload = lz4.frame.compress(payload)
        elif compression in (3, 4):
            import zstandard

            payload = zstandard.ZstdCompressor().compress(payload)
        out += struct.pack("<ii", stream, len(payload)) + payload

    for first in range(0, len(s), packet):
        add(0, aedat4_events(s.take(slice(first, first + packet))))
        add(2, b"whatever an IMU says")
    for image, start, end in frames:
        kind = {2: 0, 3: 16}[image.ndim]
        pixels = (image if image.ndim == 2 else image[..., ::-1]).tobytes()
        fields = {
            0: struct.pack("<q", (start + end) // 2),
            3: struct.pack("<q", start),
            4: struct.pack("<q", end),
            5: struct.pack("<b", kind),
            6: struct.pack("<h", image.shape[1]),
            7: struct.pack("<h", image.shape[0]),
        }
        add(1, flatbuffer(fields, {10: (len(pixels), pixels)}, b"FRME"))
    return out
