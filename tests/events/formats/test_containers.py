"""HDF5 files and ROS bags in the layouts of the field."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import hdf5plugin
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from evsplat.errors import DataError
from evsplat.events import EventStream, open_recording, read_events

from . import encoders
from .helpers import HEIGHT, WIDTH, random_stream, same

EVENT_MSG = "uint16 x\nuint16 y\n{time} ts\nbool polarity\n"
ARRAY_MSG = "std_msgs/Header header\nuint32 height\nuint32 width\ndvs_msgs/Event[] events\n"
PACKET_MSG = (
    "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\n"
    "string encoding\nbool is_bigendian\nuint8[] events\n"
)


def _dsec(file: h5py.File, s: EventStream) -> None:
    """Blosc with zstd, uint32 times from zero, the start in t_offset."""
    packing = dict(chunks=(500,), **hdf5plugin.Blosc(cname="zstd"))
    columns = {"t": (s.t - 1000).astype("u4"), "x": s.x, "y": s.y, "p": (s.p > 0).astype("u1")}
    for name, values in columns.items():
        file.create_dataset(f"events/{name}", data=values, **packing)
    file["t_offset"] = np.int64(1000)


def _metavision(file: h5py.File, s: EventStream) -> None:
    kind = [("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")]
    rows = np.array(list(zip(s.x, s.y, s.p > 0, s.t, strict=True)), dtype=kind)
    file.create_dataset("CD/events", data=rows, chunks=(300,), compression="gzip")
    file.attrs["geometry"] = "320x240"


def _fixed_length(file: h5py.File, s: EventStream) -> None:
    """As C writes a text: so many bytes."""
    _metavision(file, s)
    file.attrs.create("geometry", np.bytes_("320x240"))


def _e2vid(file: h5py.File, s: EventStream) -> None:
    file["events/ts"], file["events/xs"] = s.t * 1e-6, s.x.astype("i2")
    file["events/ys"], file["events/ps"] = s.y.astype("i2"), s.p > 0
    file.attrs["sensor_resolution"] = (240, 320)


def _v2e(file: h5py.File, s: EventStream) -> None:
    table = np.stack([s.t, s.x, s.y, s.p > 0], axis=1)
    file.create_dataset("events", data=table.astype("u4"), chunks=(100, 4), compression="gzip")


def _m3ed(file: h5py.File, s: EventStream) -> None:
    """Beside the events of the sensor the track of a camera, which has t, x and y as well."""
    columns = {"t": s.t, "x": s.x, "y": s.y, "p": (s.p > 0).astype("i1")}
    for name, values in columns.items():
        file[f"prophesee/left/{name}"] = values
    for name in ("t", "x", "y", "z"):
        file[f"pose/{name}"] = np.arange(5.0)


def _mvsec(file: h5py.File, s: EventStream) -> None:
    file["davis/left/events"] = np.stack([s.x, s.y, s.t * 1e-6, s.p], axis=1)
    file["davis/left/imu"] = np.ones((20, 4))
    file["self"] = h5py.SoftLink("/")


@pytest.mark.parametrize("write", [_dsec, _metavision, _fixed_length, _e2vid, _v2e, _m3ed, _mvsec])
def test_hdf5_layouts_give_the_same_events(
    tmp_path: Path, write: Callable[[h5py.File, EventStream], None]
) -> None:
    s = random_stream(21, 2_345, first_us=5_000)
    with h5py.File(tmp_path / "e.anything", "w") as file:
        write(file, s)
    recording = open_recording(tmp_path / "e.anything")
    assert recording.format == "hdf5" and recording.has_polarity
    assert same(recording.read(), s)
    known = write in (_metavision, _fixed_length, _e2vid)
    assert (recording.width, recording.height) == ((320, 240) if known else (None, None))


@pytest.mark.parametrize(
    ("said", "per_us"),
    [("s", 1e-6), ("Milliseconds", 1e-3), (b"us", 1), ("µs", 1), ("μs".encode(), 1), ("ns", 1000)],
)
@pytest.mark.parametrize("compound", [False, True])
def test_the_unit_that_times_are_said_to_have_is_theirs(
    tmp_path: Path, said: str | bytes, per_us: float, compound: bool
) -> None:
    """Whole milliseconds were read as microseconds, whatever the attribute said."""
    s = random_stream(26, 400, first_us=5_000)
    s = EventStream(s.t // 1000 * 1000, s.x, s.y, s.p)
    with h5py.File(tmp_path / "e.h5", "w") as file:
        columns = {"t": s.t * per_us, "x": s.x, "y": s.y, "p": s.p}
        if compound:
            kind = [("t", "f8"), ("x", "u2"), ("y", "u2"), ("p", "i1")]
            file["events"] = np.array(list(zip(*columns.values(), strict=True)), dtype=kind)
        else:
            for name, values in columns.items():
                file[f"events/{name}"] = values
        name = "events" if compound else "events/t"
        file[name].attrs["unit"] = said
    assert same(read_events(tmp_path / "e.h5"), s)
    with h5py.File(tmp_path / "e.h5", "a") as file:
        file[name].attrs["unit"] = "ticks"
    with pytest.raises(
        DataError, match=f"attribute unit of /{name} is 'ticks', expected s, ms, us or ns"
    ):
        open_recording(tmp_path / "e.h5")
    assert len(read_events(tmp_path / "e.h5", time_unit="us")) == len(s)


def test_named_datasets(tmp_path: Path) -> None:
    s = random_stream(22, 100)
    with h5py.File(tmp_path / "e.h5", "w") as file:
        file["left/stamp"], file["left/u"], file["left/v"] = s.t, s.x, s.y
    with pytest.raises(DataError, match="no events at /events.*there: left.*from Python.*columns"):
        open_recording(tmp_path / "e.h5")
    where = {"t": "left/stamp", "x": "left/u", "y": "left/v"}
    recording = open_recording(tmp_path / "e.h5", columns=where)
    assert not recording.has_polarity and np.array_equal(recording.read().x, s.x)


def test_of_a_file_with_two_sensors_one_has_to_be_copied_out(tmp_path: Path) -> None:
    path = tmp_path / "stereo.h5"
    with h5py.File(path, "w") as file:
        for side in ("left", "right"):
            _v2e(file.create_group(f"davis/{side}"), random_stream(23, 150))
    with pytest.raises(DataError, match=r"/davis/left/events, /davis/right/events, .*h5copy"):
        open_recording(path)
    # what the message says to do, by the library that h5copy is of
    with h5py.File(path) as file, h5py.File(tmp_path / "one.h5", "w") as one:
        file.copy("/davis/right/events", one, "events")
    assert same(open_recording(tmp_path / "one.h5").read(), random_stream(23, 150))


def test_prophesees_own_packing_is_refused_in_one_sentence(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "e.h5", "w") as file:
        properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        properties.set_chunk((10,))
        properties.set_filter(36559, h5py.h5z.FLAG_OPTIONAL, ())
        kind = h5py.h5t.py_create(np.dtype([("x", "u2"), ("y", "u2"), ("p", "i2"), ("t", "i8")]))
        file.create_group("CD")
        space = h5py.h5s.create_simple((10,))
        h5py.h5d.create(file.id, b"CD/events", kind, space, properties)
    with pytest.raises(
        DataError, match="packed with Prophesee's ECF, whose plug-in is not found; set HDF5_PLUGIN"
    ):
        open_recording(tmp_path / "e.h5")


_STAND_IN = """
#include <stddef.h>
typedef size_t filter_t(unsigned, size_t, const unsigned *, size_t, size_t *, void **);
static size_t turned(unsigned f, size_t n, const unsigned *v, size_t bytes, size_t *s, void **b) {
    for (size_t i = 0; i < bytes; ++i) ((unsigned char *)*b)[i] ^= 0x5a;
    return bytes;
}
static const struct {
    int version, id; unsigned encodes, decodes; const char *name; void *can, *set; filter_t *f;
} filter = {1, 36559, 1, 1, "stand-in", 0, 0, turned};
int H5PLget_plugin_type(void) { return 0; }
const void *H5PLget_plugin_info(void) { return &filter; }
"""
_WRITE_AND_READ = """
import sys, h5py, numpy as np
from evsplat.events import read_events
kind = [("x", "u2"), ("y", "u2"), ("p", "i2"), ("t", "i8")]
rows = np.zeros(1000, kind)
rows["t"], rows["x"] = np.arange(1000) * int(sys.argv[1]), np.arange(1000) % 7
with h5py.File("e.h5", "w") as file:
    file.create_dataset("CD/events", data=rows, chunks=(100,), compression=36559)
events = read_events("e.h5")
assert np.array_equal(events.t, rows["t"]) and np.array_equal(events.x, rows["x"])
"""


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_a_file_packed_with_ecf_is_read_where_its_plug_in_is(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    """A plug-in of that number turns bits of each byte; what it is told to unpack comes out."""
    (tmp_path / "ecf.c").write_text(_STAND_IN)
    build = ["cc", "-shared", "-fPIC", "-o", tmp_path / "libecf.so", tmp_path / "ecf.c"]
    subprocess.run(build, check=True)
    step = str(rng.integers(1, 1000))
    command = [sys.executable, "-c", _WRITE_AND_READ, step]
    environment = {**os.environ, "HDF5_PLUGIN_PATH": str(tmp_path)}
    subprocess.run(command, check=True, cwd=tmp_path, env=environment)


def test_a_shape_without_content_is_refused(tmp_path: Path) -> None:
    """A damaged length must not become hours of zeros."""
    with h5py.File(tmp_path / "e.h5", "w") as file:
        for name in "txyp":
            file.create_dataset(f"events/{name}", (10**12,), "i8", chunks=(1000,))
    with pytest.raises(DataError, match="1,000,000,000,000 numbers announced in 0 bytes"):
        open_recording(tmp_path / "e.h5")


def test_ros1_bag_of_event_arrays(tmp_path: Path) -> None:
    s = random_stream(23, 1_000, first_us=1_600_000_000_000_000)
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(EVENT_MSG.format(time="time"), "dvs_msgs/msg/Event"))
    store.register(get_types_from_msg(ARRAY_MSG, "dvs_msgs/msg/EventArray"))
    with BagWriter(tmp_path / "e.bag") as bag:
        topic = bag.add_connection("/dvs/events", "dvs_msgs/msg/EventArray", typestore=store)
        other = bag.add_connection("/clock", "std_msgs/msg/String", typestore=store)
        for number, message in enumerate(_arrays(store, s)):
            data = store.serialize_ros1(message, "dvs_msgs/msg/EventArray")
            bag.write(topic, number + 1, data)
            text = store.types["std_msgs/msg/String"](data="tick")
            bag.write(other, number + 1, store.serialize_ros1(text, "std_msgs/msg/String"))
    recording = open_recording(tmp_path / "e.bag")
    assert (recording.format, recording.width, recording.height) == ("rosbag", WIDTH, HEIGHT)
    assert same(recording.read(), s)
    data = (tmp_path / "e.bag").read_bytes()
    (tmp_path / "cut.bag").write_bytes(data[: len(data) * 2 // 3])  # no index yet
    with pytest.raises(DataError, match="recording was cut off, make it whole: 'rosbag reindex'"):
        open_recording(tmp_path / "cut.bag")


def test_nanoseconds_of_a_bag_are_rounded_to_the_nearest_microsecond(tmp_path: Path) -> None:
    s = random_stream(29, 400, first_us=1_600_000_000_000_000)
    rest_ns = np.random.default_rng(30).integers(-500, 500, len(s))
    rest_ns[:2] = -500, 499  # a half goes upwards
    times_ns = np.sort(s.t * 1000 + rest_ns)
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(EVENT_MSG.format(time="time"), "dvs_msgs/msg/Event"))
    store.register(get_types_from_msg(ARRAY_MSG, "dvs_msgs/msg/EventArray"))
    event, time = store.types["dvs_msgs/msg/Event"], store.types["builtin_interfaces/msg/Time"]
    rows = zip(times_ns.tolist(), encoders.rows(s), strict=True)
    events = [
        event(x=x, y=y, ts=time(*divmod(t_ns, 10**9)), polarity=on) for t_ns, (_, x, y, on) in rows
    ]
    message = store.types["dvs_msgs/msg/EventArray"](_header(store), HEIGHT, WIDTH, events)
    with BagWriter(tmp_path / "e.bag") as bag:
        topic = bag.add_connection("/dvs/events", "dvs_msgs/msg/EventArray", typestore=store)
        bag.write(topic, 1, store.serialize_ros1(message, "dvs_msgs/msg/EventArray"))
    read = read_events(tmp_path / "e.bag")
    assert np.array_equal(read.t, np.floor_divide(times_ns + 500, 1000))


@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
@pytest.mark.parametrize("packets", [False, True])
def test_ros2_folder_and_single_file(tmp_path: Path, storage: StoragePlugin, packets: bool) -> None:
    """Arrays by an independent serialiser of CDR; packets cut anywhere between words of EVT 3."""
    s = random_stream(24, 1_003, first_us=1_000_000)
    store = get_typestore(Stores.ROS2_HUMBLE)
    time = "builtin_interfaces/Time"
    store.register(get_types_from_msg(EVENT_MSG.format(time=time), "dvs_msgs/msg/Event"))
    store.register(get_types_from_msg(ARRAY_MSG, "dvs_msgs/msg/EventArray"))
    store.register(get_types_from_msg(PACKET_MSG, "event_camera_msgs/msg/EventPacket"))
    kind = "event_camera_msgs/msg/EventPacket" if packets else "dvs_msgs/msg/EventArray"
    messages = _packets(store, s) if packets else _arrays(store, s)
    with FolderWriter(tmp_path / "bag", version=9, storage_plugin=storage) as bag:
        topic = bag.add_connection("/camera/events", kind, typestore=store)
        for number, message in enumerate(messages):
            bag.write(topic, number + 1, store.serialize_cdr(message, kind))
    single = next(p for p in (tmp_path / "bag").iterdir() if p.suffix in (".db3", ".mcap"))
    renamed = tmp_path / "events.recorded"  # the first bytes decide, never the name
    shutil.copy(single, renamed)
    for path in (tmp_path / "bag", single, renamed):
        recording = open_recording(path)
        assert (recording.format, recording.width, recording.height) == ("rosbag", WIDTH, HEIGHT)
        assert same(recording.read(), s)


@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
@pytest.mark.parametrize(
    ("mode", "why"),
    [
        (CompressionMode.FILE, "packed by Zstandard: .* give a ROS 2 bag's folder"),
        (CompressionMode.MESSAGE, "each of its messages is compressed .* give the folder"),
    ],
)
def test_a_compressed_bag_is_read_as_a_folder_and_its_file_alone_is_told(
    tmp_path: Path, storage: StoragePlugin, mode: CompressionMode, why: str
) -> None:
    """It was called damaged, and repaired by leaving out every message."""
    s = random_stream(26, 1_003, first_us=1_000_000)
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(PACKET_MSG, "event_camera_msgs/msg/EventPacket"))
    kind = "event_camera_msgs/msg/EventPacket"
    writer = FolderWriter(tmp_path / "bag", version=9, storage_plugin=storage)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer as bag:
        topic = bag.add_connection("/camera/events", kind, typestore=store)
        for number, message in enumerate(_packets(store, s)):
            bag.write(topic, number + 1, store.serialize_cdr(message, kind))
    assert same(read_events(tmp_path / "bag"), s)
    single = next(p for p in (tmp_path / "bag").iterdir() if p.suffix != ".yaml")
    for repair in (False, True):
        with pytest.raises(DataError, match=why):
            read_events(single, repair=repair)


def test_a_bag_without_events_says_what_it_holds(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    with BagWriter(tmp_path / "e.bag") as bag:
        bag.add_connection("/clock", "std_msgs/msg/String", typestore=store)
    with pytest.raises(DataError, match="no event messages.*std_msgs/msg/String"):
        open_recording(tmp_path / "e.bag")
    (tmp_path / "folder").mkdir()
    with pytest.raises(DataError, match="without metadata.yaml is no .* give the file in it"):
        read_events(tmp_path / "folder")


def _header(store):
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
    fields = dict(stamp=stamp, frame_id="dvs")
    kind = types["std_msgs/msg/Header"]
    return kind(seq=0, **fields) if "seq" in kind.__dataclass_fields__ else kind(**fields)


def _arrays(store, s: EventStream):
    event, time = store.types["dvs_msgs/msg/Event"], store.types["builtin_interfaces/msg/Time"]
    array = store.types["dvs_msgs/msg/EventArray"]
    rows = encoders.rows(s)
    for first in range(0, len(rows), 170):
        events = [
            event(x=x, y=y, ts=time(sec=t // 1_000_000, nanosec=t % 1_000_000 * 1000), polarity=on)
            for t, x, y, on in rows[first : first + 170]
        ]
        yield array(header=_header(store), height=HEIGHT, width=WIDTH, events=events)


def _packets(store, s: EventStream):
    words = encoders.evt3(s, "")
    packet = store.types["event_camera_msgs/msg/EventPacket"]
    for number, first in enumerate(range(0, len(words), 502)):
        yield packet(
            header=_header(store),
            height=HEIGHT,
            width=WIDTH,
            seq=number,
            time_base=0,
            encoding="evt3",
            is_bigendian=False,
            events=np.frombuffer(words[first : first + 502], dtype=np.uint8),
        )


def test_a_packet_that_was_lost_is_told_and_makes_no_event_of_another_row_or_time(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    """The words behind it have rows and bits of the time from those before it."""
    s = random_stream(int(rng.integers(1 << 31)), 3_000, gap_us=700)
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(PACKET_MSG, "event_camera_msgs/msg/EventPacket"))
    kind = "event_camera_msgs/msg/EventPacket"
    packets = list(_packets(store, s))
    lost = {1, 2, int(rng.integers(4, len(packets) - 1))}
    with FolderWriter(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        topic = bag.add_connection("/camera/events", kind, typestore=store)
        for number, message in enumerate(packets):
            if number not in lost:
                bag.write(topic, number + 1, store.serialize_cdr(message, kind))
    recording = open_recording(tmp_path / "bag")
    read, sent = encoders.rows(recording.read()), encoders.rows(s)
    assert set(read) <= set(sent)
    # four words of an event at most; a packet more, until row and time are told again
    assert len(sent) - len(read) <= len(lost) * (502 // 2 + 20)
    (note,) = recording.notes
    assert note.startswith("warning: by their numbers 3 packets of /camera/events did not arrive")


def test_a_damaged_message_is_an_error_or_left_out(tmp_path: Path) -> None:
    s = random_stream(25, 340)
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(EVENT_MSG.format(time="time"), "dvs_msgs/msg/Event"))
    store.register(get_types_from_msg(ARRAY_MSG, "dvs_msgs/msg/EventArray"))
    with BagWriter(tmp_path / "e.bag") as bag:
        topic = bag.add_connection("/dvs/events", "dvs_msgs/msg/EventArray", typestore=store)
        for number, message in enumerate(_arrays(store, s)):
            data = bytes(store.serialize_ros1(message, "dvs_msgs/msg/EventArray"))
            bag.write(topic, number + 1, data[:-5] if number == 1 else data)
    with pytest.raises(DataError, match="message 1 of /dvs/events is damaged"):
        read_events(tmp_path / "e.bag")
    recording = open_recording(tmp_path / "e.bag", repair=True)
    first = EventStream(*(getattr(s, name)[:170] for name in ("t", "x", "y", "p")))
    assert same(recording.read(), first)
    assert recording.notes == ["repaired: leaves out damaged messages (1)"]
