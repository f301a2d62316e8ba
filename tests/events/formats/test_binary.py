"""Binary formats against encoders written from their descriptions."""

import re
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from evsplat.errors import DataError
from evsplat.events import EventStream, open_recording, read_events
from evsplat.events.formats import aedat3
from evsplat.events.formats.base import ByteReader

from . import encoders
from .helpers import HEIGHT, WIDTH, random_stream, same

ANY_EVENTS = settings(
    max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
EVENTS = {
    "seed": st.integers(0, 2**32 - 1),
    "count": st.integers(1, 400),
    # bursts within one microsecond up to seconds between events: loops of every counter
    "gap_us": st.sampled_from([1, 3, 200, 100_000, 7_000_000]),
}


def _by_column(s: EventStream) -> EventStream:
    order = np.lexsort((s.x, s.p, s.y, s.t))
    return EventStream(s.t[order], s.x[order], s.y[order], s.p[order])


ENCODERS: dict[str, tuple[str, Callable[[EventStream], bytes]]] = {
    "evt2": ("raw", encoders.evt2),
    "evt21 by header": (
        "raw",
        lambda s: encoders.evt21(
            _by_column(s), "% format EVT21;endianness=legacy;height=240;width=320\n", swapped=True
        ),
    ),
    "evt21 little": (
        "raw",
        lambda s: encoders.evt21(_by_column(s), "% evt 2.1\n% geometry 320x240\n", swapped=False),
    ),
    "evt21 swapped": (
        "raw",
        lambda s: encoders.evt21(_by_column(s), "% evt 2.1\n% geometry 320x240\n", swapped=True),
    ),
    "evt3": ("raw", encoders.evt3),
    "dat": ("dat", encoders.dat),
    "davis": ("aedat2", lambda s: encoders.aedat2(s, "Davis346B", 346, 260)),
    "aedat3": ("aedat3", lambda s: encoders.aedat3(s, WIDTH, HEIGHT)),
    "es": ("es", lambda s: encoders.event_stream(s, WIDTH, HEIGHT)),
    "es atis": ("es", lambda s: encoders.event_stream(s, WIDTH, HEIGHT, kind=2)),
    "aedat4": ("aedat4", lambda s: encoders.aedat4(s, WIDTH, HEIGHT)),
    "aedat4 plain": ("aedat4", lambda s: encoders.aedat4(s, WIDTH, HEIGHT, compression=0)),
    "aedat4 zstd": ("aedat4", lambda s: encoders.aedat4(s, WIDTH, HEIGHT, compression=3)),
}


@pytest.mark.parametrize("name", ENCODERS)
@ANY_EVENTS
@given(**EVENTS)
def test_encoded_events_are_read_back(
    tmp_path: Path, name: str, seed: int, count: int, gap_us: int
) -> None:
    kind, encode = ENCODERS[name]
    # 32 bits of time are too few for the longest gaps; .es spells them out in millions of bytes
    gap_us = min(gap_us, {"aedat2": 2_000_000, "dat": 2_000_000, "es": 100_000}.get(kind, gap_us))
    s = random_stream(seed, count, gap_us=gap_us)
    if name.startswith("evt21"):
        s = _by_column(s)
    path = tmp_path / "recording.any"
    path.write_bytes(encode(s))
    recording = open_recording(path)
    assert recording.format == kind and recording.has_polarity
    assert (recording.width, recording.height) == ((346, 260) if name == "davis" else (320, 240))
    assert same(recording.read(), s)


def test_streaming_gives_the_same_in_chunks_of_bounded_size(tmp_path: Path) -> None:
    s = random_stream(9, 700_000, gap_us=9)
    path = tmp_path / "long.raw"
    t, on = s.t, (s.p > 0).astype(np.uint32)
    # EVT 2 with a time word before every event
    words = np.empty(2 * len(s), dtype="<u4")
    words[0::2] = 0x8 << 28 | (t >> 6).astype(np.uint32)
    words[1::2] = on << 28 | (t & 63).astype(np.uint32) << 22 | s.x.astype("u4") << 11 | s.y
    path.write_bytes(b"% evt 2.0\n" + words.tobytes())
    recording = open_recording(path)
    chunks = list(recording.chunks())
    assert len(chunks) > 2 and max(len(chunk) for chunk in chunks) <= 1 << 19
    assert same(recording.read(), s)
    window = recording.read(1_000_003, 2_000_000)
    assert same(window, s.between(1_000_003, 2_000_000))


@pytest.mark.parametrize(("x", "begins"), [(130, b"#"), (185, b"#\n")])
def test_an_address_that_begins_like_a_comment_is_an_event(
    tmp_path: Path, x: int, begins: bytes
) -> None:
    """Row 119 of a DAVIS346 has addresses whose first byte is #, its column 185 an empty line."""
    zeros = np.zeros(1, dtype=np.int64)
    s = EventStream(zeros, np.array([x], "u2"), np.array([119], "u2"), np.array([-1], "i1"))
    data = encoders.aedat2(s, "Davis346B", 346, 260)
    assert data[-8:].startswith(begins)
    (tmp_path / "e.aedat").write_bytes(data)
    assert same(read_events(tmp_path / "e.aedat"), s)


def test_dat_of_the_first_version_is_refused(tmp_path: Path) -> None:
    """Its columns have 9 bits and its rows 8: they were read as columns far to the right."""
    header = b"% Data file containing CD events.\n% Version 1\n"
    pixel = 1 << 17 | 100 << 9 | 200
    (tmp_path / "e.dat").write_bytes(header + b"\0\x08" + struct.pack("<II", 5, pixel))
    with pytest.raises(DataError, match="says version 1 of DAT.*expected version 2"):
        open_recording(tmp_path / "e.dat")


def test_dat_that_does_not_say_its_version_is_read_with_a_note(tmp_path: Path) -> None:
    """Metavision's description has that line as mandatory; older files of version 1 lack it too."""
    s = random_stream(14, 50)
    data = encoders.dat(s)
    (tmp_path / "e.dat").write_bytes(data.replace(b"% Version 2\n", b""))
    recording = open_recording(tmp_path / "e.dat")
    assert same(recording.read(), s)
    assert ["read as version 2 of DAT" in note for note in recording.notes] == [True]
    (tmp_path / "e.dat").write_bytes(data)
    assert not open_recording(tmp_path / "e.dat").notes


def test_dvs128_has_the_polarity_of_jaer(tmp_path: Path) -> None:
    s = random_stream(11, 100)
    s = EventStream(s.t, s.x % 128, s.y % 128, s.p)
    (tmp_path / "e.aedat").write_bytes(encoders.aedat2(s, "DVS128", 128, 128))
    assert same(read_events(tmp_path / "e.aedat"), s)


@pytest.mark.parametrize("compression", [0, 2, 4])
def test_frames_come_with_their_exposure(tmp_path: Path, compression: int) -> None:
    rng = np.random.default_rng(compression)
    grey, colour = rng.integers(0, 256, (6, 8), "u1"), rng.integers(0, 256, (5, 4, 3), "u1")
    frames = [(grey, 1_000, 9_000), (colour, 40_000, 55_000)]
    s = random_stream(12, 1_500)
    path = tmp_path / "e.aedat4"
    path.write_bytes(encoders.aedat4(s, WIDTH, HEIGHT, frames, compression=compression))
    recording = open_recording(path)
    read = list(recording.frames())
    assert [frame.exposure_us for frame in read] == [(1_000, 9_000), (40_000, 55_000)]
    assert np.array_equal(read[0].image, grey) and np.array_equal(read[1].image, colour)
    assert same(recording.read(), s)


def test_a_frame_with_a_time_and_a_length_alone_is_exposed_from_that_time_on(
    tmp_path: Path,
) -> None:
    """As dv-processing 1.7.9 and 2.0.4 read it; both write start and end as well."""
    fields = {
        0: struct.pack("<q", 5_000),
        5: b"\0",
        6: struct.pack("<h", 8),
        7: struct.pack("<h", 6),
        11: struct.pack("<q", 20_000),
    }
    frame = encoders.flatbuffer(fields, {10: (48, bytes(range(48)))}, b"FRME")
    data = encoders.aedat4(random_stream(12, 50), WIDTH, HEIGHT, compression=0)
    path = tmp_path / "e.aedat4"
    path.write_bytes(data + struct.pack("<ii", 1, len(frame)) + frame)
    assert [read.exposure_us for read in open_recording(path).frames()] == [(5_000, 25_000)]


@pytest.mark.parametrize(
    ("kind", "name", "pixels"),
    [(2, "CV_16UC1", 96), (18, "CV_16UC3", 288), (5, "CV_32FC1", 192), (8, "CV_8UC2", 96)],
)
@pytest.mark.parametrize("repair", [False, True])
def test_pixels_that_are_not_read_are_named(
    tmp_path: Path, kind: int, name: str, pixels: int, repair: bool
) -> None:
    """The packets were called damaged, and --repair left all of them out."""
    fields = {5: bytes([kind]), 6: struct.pack("<h", 8), 7: struct.pack("<h", 6)}
    frame = encoders.flatbuffer(fields, {10: (pixels, bytes(pixels))}, b"FRME")
    data = encoders.aedat4(random_stream(12, 50), WIDTH, HEIGHT, compression=0)
    path = tmp_path / "e.aedat4"
    path.write_bytes(data + struct.pack("<ii", 1, len(frame)) + frame)
    with pytest.raises(DataError, match=f"of OpenCV's type {name}, expected 8 bits with 1, 3 or"):
        list(open_recording(path, repair=repair).frames())
    short = encoders.flatbuffer(fields, {10: (pixels - 1, bytes(pixels - 1))}, b"FRME")
    path.write_bytes(data + struct.pack("<ii", 1, len(short)) + short)
    with pytest.raises(DataError, match=f"is damaged .pixel type {kind}, expected 8 bits"):
        list(open_recording(path).frames())


def _described(*streams: tuple[str, str]) -> str:
    """The header's list of streams, of a kind and of a camera each."""
    nodes = (
        f'<node name="{number}"><attr key="typeIdentifier">{kind}</attr><node name="info">'
        '<attr key="sizeX">{w}</attr><attr key="sizeY">{h}</attr>'
        f'<attr key="source">{camera}</attr></node></node>'
        for number, (kind, camera) in enumerate(streams)
    )
    return f'<dv><node name="outInfo">{"".join(nodes)}</node></dv>'


def test_of_two_cameras_in_aedat4_events_and_frames_are_of_one(tmp_path: Path) -> None:
    """Frames of the right camera came with events of the left one, which has none."""
    left, right = random_stream(31, 80), random_stream(32, 60)
    picture = np.arange(48, dtype=np.uint8).reshape(6, 8)
    cameras = [("EVTS", "DVX"), ("FRME", "DAVIS"), ("IMUS", "DVX"), ("EVTS", "DAVIS")]
    data = encoders.aedat4(
        left,
        WIDTH,
        HEIGHT,
        [(picture, 100, 900)],
        compression=0,
        description=_described(*cameras),
    )
    events = encoders.aedat4_events(right)
    path = tmp_path / "stereo.aedat4"
    path.write_bytes(data + struct.pack("<ii", 3, len(events)) + events)
    recording = open_recording(path)
    assert same(recording.read(), right)
    assert [frame.exposure_us for frame in recording.frames()] == [(100, 900)]
    assert recording.notes == ["EVTS streams [0, 3]: only stream 3 is read"]


AEDAT3_FRAMES = [
    (np.arange(0, 30, dtype=np.uint8).reshape(5, 6), 1_000, 9_000),
    (np.arange(0, 90, dtype=np.uint8).reshape(5, 6, 3), 2_400_000_000, 2_400_015_000),
]
"""A grey one, and one in colour whose clock has begun again."""


def test_frames_of_aedat3_come_with_their_exposure_and_name_the_size(tmp_path: Path) -> None:
    s = random_stream(12, 1_500)
    s = EventStream(s.t, s.x % 6, s.y % 5, s.p)
    path = tmp_path / "e.aedat"
    path.write_bytes(encoders.aedat3(s, 6, 5, AEDAT3_FRAMES, invalid_every=7))
    recording = open_recording(path)
    assert (recording.width, recording.height) == (6, 5)
    assert "its size is taken to be that of its first frame, 6x5" in recording.notes[0]
    for frame, (image, *exposure) in zip(recording.frames(), AEDAT3_FRAMES, strict=True):
        assert np.array_equal(frame.image, image) and list(frame.exposure_us) == exposure
    kept = np.arange(len(s)) % 7 != 0
    assert same(recording.read(), s.take(kept))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            b"#Format: RAW",
            b"#Format: SerializedTS",
            "packed (SerializedTS), expected '#Format: RAW",
        ),
        (b"#!END-HEADER\r\n", b"", "has no line #!END-HEADER"),
        (encoders.aedat3_frame_info(1), encoders.aedat3_frame_info(1, colours=1), "mosaic"),
        (encoders.aedat3_frame_info(1), encoders.aedat3_frame_info(2), "6x5x2"),
    ],
)
def test_what_of_aedat3_is_not_read_is_one_sentence(
    tmp_path: Path, old: bytes, new: bytes, said: str
) -> None:
    path = tmp_path / "e.aedat"
    data = encoders.aedat3(random_stream(3, 20), WIDTH, HEIGHT, AEDAT3_FRAMES[:1])
    assert data.count(old) == 1
    path.write_bytes(data.replace(old, new))
    with pytest.raises(DataError, match=re.escape(str(path)) + ".*" + re.escape(said)):
        list(open_recording(path).frames())


@pytest.mark.parametrize("seed", [1, 2])
def test_of_two_cameras_in_aedat3_one_gives_size_events_and_frames(
    tmp_path: Path, seed: int
) -> None:
    s = random_stream(seed, 900)
    s = EventStream(s.t, s.x % 240, s.y % 180, s.p)
    other = random_stream(seed + 10, 500)
    other = EventStream(other.t, other.x % 128, other.y % 128, other.p)
    none = other.take(slice(0))
    dark, light = (np.full((180, 240), level, np.uint8) for level in (9, 200))
    cameras = [
        encoders.aedat3(events, 240, 180, [(picture, 40, 80)], sensor=name, source=number)
        for number, name, picture, events in (
            (0, "DVS128", dark, none),
            (1, "DAVIS240C", light, s),
            (0, "DVS128", dark, other),
        )
    ]
    end = b"#!END-HEADER\r\n"
    header = cameras[0].split(end)[0] + b"#Source 1: DAVIS240C\r\n" + end
    path = tmp_path / "two.aedat"
    path.write_bytes(header + b"".join(camera.split(end, 1)[1] for camera in cameras))
    recording = open_recording(path)
    assert (recording.width, recording.height) == (240, 180)
    assert same(recording.read(), s)
    assert [int(frame.image[0, 0]) for frame in recording.frames()] == [200]
    assert any("only events of source 1 are read" in note for note in recording.notes)


def test_of_two_cameras_in_aedat3_events_are_of_that_with_frames(tmp_path: Path) -> None:
    """Events of a camera without frames came with frames of the other."""
    bare, framed = random_stream(33, 300), random_stream(34, 200)
    end = b"#!END-HEADER\r\n"
    first = encoders.aedat3(bare, WIDTH, HEIGHT, sensor="DVXPLORER", source=0)
    first = first[: first.rindex(encoders.aedat3_frame_info(1)) - 28]
    second = encoders.aedat3(framed, WIDTH, HEIGHT, AEDAT3_FRAMES[:1], sensor="DAVIS346")
    header, packets = first.split(end, 1)
    path = tmp_path / "two.aedat"
    path.write_bytes(header + b"#Source 1: DAVIS346\r\n" + end + packets + second.split(end, 1)[1])
    recording = open_recording(path)
    assert same(recording.read(), framed)
    assert [frame.exposure_us for frame in recording.frames()] == [(1_000, 9_000)]
    assert any("only events of source 1 are read" in note for note in recording.notes)


def test_aedat3_without_frames_is_gone_through_once_for_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "e.aedat"
    data = encoders.aedat3(random_stream(3, 900), WIDTH, HEIGHT, sensor="DAVIS346")
    without = data[: data.rindex(encoders.aedat3_frame_info(1)) - 28]
    path.write_bytes(without)
    recording = open_recording(path)
    passes: list[int] = []

    class Counted(ByteReader):
        def __init__(self, path: Path, start: int = 0) -> None:
            super().__init__(path, start)
            passes.append(start)

    monkeypatch.setattr(aedat3, "ByteReader", Counted)
    assert list(recording.frames()) == [] and len(passes) == 1
    path.write_bytes(without[:-3])
    with pytest.raises(DataError, match="ends in the middle of a packet"):
        list(open_recording(path).frames())


def test_two_recordings_of_aedat3_in_one_file_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "e.aedat"
    data = encoders.aedat3(random_stream(3, 20), WIDTH, HEIGHT)
    path.write_bytes(data + data)
    with pytest.raises(DataError, match=f"another recording begins at byte {len(data)}"):
        read_events(path)


def test_events_before_the_first_time_are_left_out_and_counted(tmp_path: Path) -> None:
    s = random_stream(13, 50, first_us=5_000)
    data = encoders.evt3(s)
    body = data.index(b"\n", data.index(b"format")) + 1
    early = b"\x10\x00" + b"\x22\x20" * 3  # row 16, three events in column 34
    (tmp_path / "e.raw").write_bytes(data[:body] + early + data[body:])
    recording = open_recording(tmp_path / "e.raw")
    assert same(recording.read(), s)
    assert recording.notes == ["3 events before the first time are left out, as they have none"]


@pytest.mark.parametrize("name", ["evt2", "evt3", "evt21 little", "dat", "davis", "es", "aedat4"])
def test_cut_file_is_an_error_or_kept_up_to_the_cut(tmp_path: Path, name: str) -> None:
    s = _by_column(random_stream(14, 2_000))
    data = ENCODERS[name][1](s)
    path = tmp_path / "cut"
    path.write_bytes(data[:-3])
    with pytest.raises(DataError, match=r"ends in the middle.*byte \d+.*--repair"):
        read_events(path)
    recording = open_recording(path, repair=True)
    kept = recording.read()
    lost = len(s) - len(kept)
    # the cut of the AEDAT4 file goes through a packet of another stream
    assert lost <= 700 and (lost or name == "aedat4")
    assert same(kept, EventStream(*(getattr(s, c)[: len(kept)] for c in ("t", "x", "y", "p"))))
    assert any("before the cut (1)" in note for note in recording.notes)


@pytest.mark.parametrize("repair", [False, True])
@pytest.mark.parametrize("name", ENCODERS)
def test_two_recordings_in_one_file_are_refused_where_the_second_begins(
    rng: np.random.Generator, tmp_path: Path, name: str, repair: bool
) -> None:
    """Its header was read as events, with words shifted behind it, or it was passed over."""
    seed = int(rng.integers(1 << 31))
    encode = ENCODERS[name][1]
    first = encode(random_stream(seed, 4000, first_us=1000))
    second = encode(random_stream(seed + 1, 4000, first_us=500_000))
    if second.startswith(b"% "):
        # headers of any length: by chance what follows is in step with the words before it
        second = b"% date 2026-01-01" + b" " * (seed % 9) + b"\n% owner x\r\n" + second
    path = tmp_path / "both"
    path.write_bytes(first + second)
    with pytest.raises(DataError, match=f"another recording begins at byte {len(first)},"):
        open_recording(path, repair=repair).read()
    path.write_bytes(second)
    assert len(open_recording(path, width=WIDTH, height=260).read().t)


def test_a_first_recording_may_end_in_the_bytes_that_headers_begin_with(tmp_path: Path) -> None:
    first = encoders.evt3(random_stream(16, 50)) + b"% "  # a word of EVT3: an event in column 37
    second = b"% date 2026-01-01\n" + encoders.evt3(random_stream(17, 50, first_us=500_000))
    (tmp_path / "both").write_bytes(first + second)
    with pytest.raises(DataError, match=f"another recording begins at byte {len(first)},"):
        read_events(tmp_path / "both")


def test_a_second_recording_behind_the_table_of_packets_is_refused(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    """An AEDAT4 file that was closed says where its packets end; the rest was passed over."""
    s = random_stream(int(rng.integers(1 << 31)), 3000)
    one = encoders.aedat4(s, WIDTH, HEIGHT)
    closed = encoders.aedat4(s, WIDTH, HEIGHT, table_at=len(one)) + b"FTAB, any bytes" * 9
    path = tmp_path / "closed"
    path.write_bytes(closed)
    assert same(read_events(path), s)
    path.write_bytes(closed + one)
    with pytest.raises(DataError, match=f"another recording begins at byte {len(closed)},"):
        open_recording(path)


def test_unknown_words_are_an_error_with_their_place(tmp_path: Path) -> None:
    s = random_stream(15, 100)
    data = encoders.evt2(s)
    at = data.index(b"320x240\n") + 8 + 40
    (tmp_path / "e.raw").write_bytes(data[:at] + b"\0\0\0\x50" + data[at:])
    with pytest.raises(DataError, match=f"no type that EVT2 has, the first at byte {at}"):
        read_events(tmp_path / "e.raw")
    recording = open_recording(tmp_path / "e.raw", repair=True)
    assert same(recording.read(), s)
    assert recording.notes == ["repaired: leaves out words of unknown type (1)"]


@pytest.mark.parametrize(("bits", "begin"), [(32, 0), (31, 0), (32, -(2**31))])
def test_counter_that_began_again_is_an_error_or_goes_on(
    tmp_path: Path, bits: int, begin: int
) -> None:
    s = random_stream(16, 3_000, first_us=begin + 2**bits - 20_000)
    raw_t = np.where(s.t >= begin + 2**bits, s.t - 2**bits, s.t)
    np.savez(tmp_path / "e.npz", t=raw_t, x=s.x, y=s.y, p=s.p)
    with pytest.raises(DataError, match=f"{bits}-bit counter began again"):
        read_events(tmp_path / "e.npz")
    recording = open_recording(tmp_path / "e.npz", repair=True)
    assert same(recording.read(), s)
    assert recording.notes[1:] == [
        "repaired: adds up the periods of a counter that began again (1)"
    ]


def test_disorder_is_an_error_or_sorted(tmp_path: Path) -> None:
    s = random_stream(17, 600_000, gap_us=20)
    order = np.argsort(s.t + np.random.default_rng(0).integers(0, 30_000, len(s)), kind="stable")
    np.savez(tmp_path / "e.npz", **{k: getattr(s, k)[order] for k in ("t", "x", "y", "p")})
    with pytest.raises(DataError, match=r"event \d+ is at \d+ us, after one at \d+ us \(\d+ steps"):
        read_events(tmp_path / "e.npz")
    recording = open_recording(tmp_path / "e.npz", repair=True)
    read = recording.read()
    assert np.array_equal(read.t, s.t)
    a, b = (np.lexsort((e.p, e.y, e.x, e.t)) for e in (read, s))
    assert np.array_equal(read.x[a], s.x[b]) and np.array_equal(read.p[a], s.p[b])
    assert "repaired: sorts events that are out of order" in recording.notes[1]
    assert len(recording.notes) == 2


def test_events_too_late_to_be_sorted_in_are_left_out_and_counted(tmp_path: Path) -> None:
    s = random_stream(18, 900_000, first_us=1_000)
    order = np.concatenate([np.arange(5, len(s)), np.arange(5)])
    np.savez(tmp_path / "e.npz", **{k: getattr(s, k)[order] for k in ("t", "x", "y", "p")})
    recording = open_recording(tmp_path / "e.npz", repair=True)
    assert np.array_equal(recording.read().t, s.t[5:])
    assert "leaves out events too late to be sorted in (5)" in recording.notes[-1]


def test_wrong_content_is_never_decoded_as_another_format(tmp_path: Path) -> None:
    s = random_stream(19, 200)
    for name, (kind, encode) in ENCODERS.items():
        path = tmp_path / "recording.raw"
        path.write_bytes(encode(_by_column(s)))
        for other in (
            "aedat2",
            "aedat3",
            "aedat4",
            "csv",
            "dat",
            "es",
            "hdf5",
            "npz",
            "raw",
            "rosbag",
        ):
            if other != kind:
                with pytest.raises(DataError, match=f"its content is {kind}, not {other}"):
                    open_recording(path, format=other)
        # without its header a file is nothing
        path.write_bytes(encode(_by_column(s))[100:])
        with pytest.raises(DataError, match="not a recording|holds no events|neither numbers"):
            read_events(path)
        assert name


@pytest.mark.parametrize("digit", ["³", "²40"])
def test_a_size_in_superscript_is_refused_in_one_sentence(tmp_path: Path, digit: str) -> None:
    """Python calls such characters digits, and no number can be read of them."""
    header = f"% evt 3.0\n% width {digit}\n% height 240\n% end\n"
    path = tmp_path / "recording.raw"
    path.write_bytes(header.encode() + bytes(64))
    with pytest.raises(DataError, match="its header gives a sensor of"):
        open_recording(path)
