"""Two recordings in one file, as of bags that were put together: told, and either one is read."""

import gzip
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from evsplat.errors import ConfigError, DataError
from evsplat.events import EventStream, open_recording, read_events, write_events
from evsplat.events.convert import convert_recording

from . import encoders
from .helpers import HEIGHT, WIDTH, random_stream, same
from .test_containers import ARRAY_MSG, EVENT_MSG, PACKET_MSG

COUNT = 1_500
WRITTEN: dict[str, Callable[[Path, EventStream], object]] = {
    "e.aedat4": lambda path, s: path.write_bytes(encoders.aedat4(s, WIDTH, HEIGHT)),
    "e.dat": lambda path, s: path.write_bytes(encoders.dat(s)),
    "e.csv": lambda path, s: np.savetxt(
        path, np.stack([s.t, s.x, s.y, s.p], 1), "%d", ",", header="t,x,y,p", comments=""
    ),
    "e.npz": lambda path, s: np.savez(path, t=s.t, x=s.x, y=s.y, p=s.p),
}


def joined(first: EventStream, second: EventStream) -> EventStream:
    """As they follow in a file, whatever their times."""
    return EventStream(
        *(np.concatenate([getattr(one, n) for one in (first, second)]) for n in "txyp")
    )


def packets(parts: list[EventStream], stamps_us: list[int], numbered_from: list[int], path: Path):
    """A bag of ROS 2 with the EVT 3 words of each part; stamps are of its first packet."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(PACKET_MSG, "event_camera_msgs/msg/EventPacket"))
    kind = "event_camera_msgs/msg/EventPacket"
    packet, header = store.types[kind], store.types["std_msgs/msg/Header"]
    time = store.types["builtin_interfaces/msg/Time"]
    with FolderWriter(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        topic, written = bag.add_connection("/events", kind, typestore=store), 0
        for s, stamp_us, number in zip(parts, stamps_us, numbered_from, strict=True):
            words = encoders.evt3(s, "")
            for index, at in enumerate(range(0, len(words), 502)):
                stamp = time(sec=stamp_us // 10**6, nanosec=stamp_us % 10**6 * 1000)
                message = packet(
                    header=header(stamp=stamp, frame_id="e"),
                    height=HEIGHT,
                    width=WIDTH,
                    seq=number + index,
                    time_base=0,
                    encoding="evt3",
                    is_bigendian=False,
                    events=np.frombuffer(words[at : at + 502], dtype=np.uint8),
                )
                written += 1
                bag.write(topic, written, store.serialize_cdr(message, kind))


@pytest.mark.parametrize("name", WRITTEN)
def test_a_clock_that_begins_anew_is_two_recordings_and_either_is_read(
    tmp_path: Path, name: str
) -> None:
    first = random_stream(1, COUNT, gap_us=300, first_us=5_000_000)
    second = random_stream(2, COUNT, gap_us=300, first_us=1_000)
    path = tmp_path / name
    WRITTEN[name](path, joined(first, second))
    said = rf"event {COUNT} is at {second.t[0]} us.* as of two recordings in one file: .*--skip"
    with pytest.raises(DataError, match=said) as refusal:
        read_events(path)
    found = re.search(r"--stop (\d+).*--skip (\d+)", str(refusal.value))
    assert found is not None and found.groups() == (str(COUNT), str(COUNT))
    assert same(read_events(path, stop=COUNT), first)
    assert same(read_events(path, skip=COUNT), second)
    assert same(read_events(path, skip=COUNT + 3, stop=COUNT + 10), second.take(slice(3, 10)))


@pytest.mark.parametrize("name", WRITTEN)
@pytest.mark.parametrize("silent_s", [9, 70])
def test_a_long_silence_is_told_with_what_keeps_either_part(
    tmp_path: Path, name: str, silent_s: int
) -> None:
    first = random_stream(3, COUNT, first_us=1_000)
    after_us = int(first.t[-1]) + silent_s * 10**6
    second = random_stream(4, COUNT, first_us=after_us)
    path = tmp_path / name
    WRITTEN[name](path, joined(first, second))
    recording = open_recording(path)
    assert same(recording.read(), joined(first, second))
    told = [note for note in recording.notes if note.startswith("warning: no event comes for")]
    assert len(told) == (silent_s > 10)
    if told:
        gap_s = (second.t[0] - first.t[-1]) * 1e-6
        assert f"for {gap_s:.1f} s before event {COUNT} at {second.t[0]} us" in told[0]
        for option, part in (({"stop": COUNT}, first), ({"skip": COUNT}, second)):
            out = tmp_path / "part.h5"
            assert not any(
                "warning" in note for note in convert_recording(path, out, **option).notes
            )
            assert same(read_events(out), part)


@pytest.mark.parametrize(
    ("stamps_us", "numbered_from", "why"),
    [
        ([10**12, 10**12 + 10**6], [500, 0], "numbered from 0 after"),
        ([10**12, 10**12 + 90 * 10**6], [0, 400], "sent 90.0 s after the one before"),
        ([10**12, 10**12 - 60 * 10**6], [0, 400], "sent -60.0 s after the one before"),
    ],
)
@pytest.mark.parametrize("second_us", [100, 9_000_000])
def test_packets_of_two_recordings_in_a_bag_are_not_taken_for_one(
    tmp_path: Path, stamps_us: list[int], numbered_from: list[int], why: str, second_us: int
) -> None:
    """The sensor's counter, which goes round, tells neither: its times were added up before."""
    first = random_stream(5, COUNT, first_us=10_000_000)
    second = random_stream(6, COUNT, first_us=second_us)
    packets([first, second], stamps_us, numbered_from, tmp_path / "bag")
    with pytest.raises(DataError, match=rf"another recording begins at message .*{why}"):
        read_events(tmp_path / "bag")
    assert same(read_events(tmp_path / "bag", stop=COUNT), first)
    assert same(read_events(tmp_path / "bag", skip=COUNT), second)


def test_packets_that_came_late_are_of_the_same_recording(tmp_path: Path) -> None:
    s = random_stream(7, COUNT, first_us=10_000_000)
    parts = [s.take(slice(0, 700)), s.take(slice(700, None))]
    packets(parts, [10**12, 10**12 + 7 * 10**6], [90, 40], tmp_path / "bag")
    assert same(read_events(tmp_path / "bag"), s)


def test_arrays_of_two_recordings_in_a_bag_are_told_by_the_clock_of_ros(tmp_path: Path) -> None:
    first = random_stream(8, 300, first_us=10**12)
    second = random_stream(9, 300, first_us=10**12 - 10**9)
    store = get_typestore(Stores.ROS2_HUMBLE)
    time = "builtin_interfaces/Time"
    store.register(get_types_from_msg(EVENT_MSG.format(time=time), "dvs_msgs/msg/Event"))
    store.register(get_types_from_msg(ARRAY_MSG, "dvs_msgs/msg/EventArray"))
    kind, types = "dvs_msgs/msg/EventArray", store.types
    stamp = types["builtin_interfaces/msg/Time"]
    with FolderWriter(tmp_path / "bag", version=9) as bag:
        topic = bag.add_connection("/events", kind, typestore=store)
        for number, part in enumerate((first, second)):
            events = [
                types["dvs_msgs/msg/Event"](
                    x=x, y=y, ts=stamp(sec=t // 10**6, nanosec=t % 10**6 * 1000), polarity=on
                )
                for t, x, y, on in encoders.rows(part)
            ]
            header = types["std_msgs/msg/Header"](stamp=stamp(sec=1, nanosec=2), frame_id="e")
            message = types[kind](header=header, height=HEIGHT, width=WIDTH, events=events)
            bag.write(topic, number + 1, store.serialize_cdr(message, kind))
    with pytest.raises(DataError, match="event 300 .* as of two recordings in one file"):
        read_events(tmp_path / "bag")
    assert same(read_events(tmp_path / "bag", skip=300), second)


def test_parts_that_are_none_are_refused(tmp_path: Path) -> None:
    s = random_stream(10, 100)
    write_events(tmp_path / "e.h5", s)
    with pytest.raises(ConfigError, match="--stop 20: leaves nothing after --skip 20"):
        read_events(tmp_path / "e.h5", skip=20, stop=20)
    with pytest.raises(DataError, match=r"holds 100 events, expected more than the 100 .*--skip"):
        read_events(tmp_path / "e.h5", skip=100)
    with pytest.raises(DataError, match="holds 100 events"):
        convert_recording(tmp_path / "e.h5", tmp_path / "out.h5", skip=200)
    assert not (tmp_path / "out.h5").exists()


@pytest.mark.parametrize("header", ["t,x@320,y@240,on\n", "320 240\n", "a\n# b\n"])
@pytest.mark.parametrize("zipped", [False, True])
def test_text_files_that_were_put_together_are_told_with_where_to_cut(
    tmp_path: Path, header: str, zipped: bool
) -> None:
    separator = "," if "," in header else " "
    texts = [
        header + "".join(f"{separator.join(map(str, row))}\n" for row in encoders.rows(s))
        for s in (random_stream(seed, 40, first_us=1_000) for seed in (11, 12))
    ]
    data = "".join(texts).encode()
    path = tmp_path / "e.txt"
    path.write_bytes(gzip.compress(data) if zipped else data)
    said = f"another recording begins at byte {len(texts[0])}, .*cut it there"
    with pytest.raises(DataError, match=said) as refusal:
        read_events(path, time_unit="us", columns="t,x,y,p")
    assert ("gunzip it" in str(refusal.value)) == zipped
    path.write_bytes(data[len(texts[0]) :])
    assert len(read_events(path, time_unit="us", columns="t,x,y,p")) == 40
