"""Damaged recordings of every format, and what reading one may do: be right or be a DataError.

Shared by the tests and by benchmarks/fuzz.py, which runs many more.
"""

import gzip
import io
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import h5py
import numpy as np

from evsplat.errors import DataError
from evsplat.events import EventStream, open_recording, write_events

MAX_EVENTS = 3_000_000
WIDTH, HEIGHT = 320, 240


def seeds(encoders, stream: EventStream) -> dict[str, tuple[str, bytes]]:
    """Name -> format and content of a small, sound recording."""
    order = np.lexsort((stream.x, stream.p, stream.y, stream.t))
    by_column = EventStream(*(getattr(stream, n)[order] for n in ("t", "x", "y", "p")))
    swapped = "% format EVT21;endianness=legacy;height=240;width=320\n"
    frame = np.arange(48, dtype=np.uint8).reshape(6, 8)
    frames = [(frame, 10, 900), (np.stack([frame] * 3, axis=-1), 1_000, 1_900)]
    plain = [stream.t, stream.x, stream.y, (stream.p > 0)]
    text = b"".join(b"%d,%d,%d,%d\n" % tuple(map(int, row)) for row in zip(*plain, strict=True))
    found = {
        "evt2": ("raw", encoders.evt2(stream)),
        "evt21": ("raw", encoders.evt21(by_column, "% evt 2.1\n", swapped=False)),
        "evt21 swapped": ("raw", encoders.evt21(by_column, swapped, swapped=True)),
        "evt3": ("raw", encoders.evt3(stream)),
        "dat": ("dat", encoders.dat(stream)),
        "aedat2": ("aedat2", encoders.aedat2(stream, "Davis346B", 346, 260)),
        "aedat3": (
            "aedat3",
            encoders.aedat3(stream, WIDTH, HEIGHT, frames, packet=90, sensor="DAVIS346"),
        ),
        "es": ("es", encoders.event_stream(stream, WIDTH, HEIGHT)),
        "aedat4": ("aedat4", encoders.aedat4(stream, WIDTH, HEIGHT, frames, packet=90)),
        "aedat4 plain": (
            "aedat4",
            encoders.aedat4(stream, WIDTH, HEIGHT, frames, compression=0, packet=90),
        ),
        "aedat4 zstd": (
            "aedat4",
            encoders.aedat4(stream, WIDTH, HEIGHT, frames, compression=3, packet=90),
        ),
        "csv": ("csv", b"t,x@320,y@240,on\n" + text),
        "text": ("csv", text.replace(b",", b" ")),
        "csv.gz": ("csv", gzip.compress(text, mtime=0)),
        "hdf5": ("hdf5", _written(".h5", stream)),
        "npz": ("npz", _written(".npz", stream)),
        "npz packed": ("npz", _packed(stream)),
        "npy": ("npz", _npy(stream)),
        "compound": ("hdf5", _compound(stream)),
        "bag": ("rosbag", bag(stream)),
    }
    return found


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Bits flipped, bytes replaced, cut, cut out, repeated, or the header exchanged."""
    content = bytearray(data)
    for _ in range(int(rng.integers(1, 4))):
        size = len(content)
        if size == 0:
            break
        # half of the damage falls on the first bytes, where the structure is
        at = int(rng.integers(0, size if rng.random() < 0.5 else min(size, 200)))
        kind = rng.integers(0, 7)
        if kind == 0:
            content[at] ^= 1 << int(rng.integers(0, 8))
        elif kind == 1:
            content[at] = int(rng.choice([0, 1, 0x7F, 0x80, 0xFF, 0x25, 0x23, 0x0A]))
        elif kind == 2:
            content = content[:at]
        elif kind == 3:
            del content[at : at + int(rng.integers(1, 40))]
        elif kind == 4:
            content[at:at] = content[max(0, at - int(rng.integers(1, 60))) : at]
        elif kind == 5:
            content[at : at + 8] = rng.integers(0, 256, 8, dtype=np.uint8).tobytes()
        else:
            content[at : at + 4] = int(rng.choice([2**31 - 1, 2**32 - 1, 2**20, 0])).to_bytes(
                4, "little"
            )
    return bytes(content)


def outcome(path: Path, format: str, *, repair: bool) -> str:
    """Read everything; "read" or "refused", and an AssertionError where a promise is broken."""
    try:
        recording = open_recording(path, repair=repair)
        assert recording.format == format, f"taken for {recording.format}"
        last, count = None, 0
        for chunk in recording.chunks():
            count += len(chunk)
            assert count < MAX_EVENTS, "events out of nothing"
            check_stream(chunk, recording.width, recording.height, recording.has_polarity)
            assert last is None or chunk.t[0] >= last, "times go back between chunks"
            last = chunk.t[-1]
        for frame in recording.frames():
            assert frame.image.dtype == np.uint8 and frame.image.ndim in (2, 3)
            assert frame.exposure_us[0] <= frame.exposure_us[1]
        return "read"
    except DataError as error:
        assert str(path) in str(error), f"the error does not name the file: {error}"
        return "refused"


def check_stream(s: EventStream, width: int | None, height: int | None, polarity: bool) -> None:
    """What `EventStream` promises."""
    kinds = [getattr(s, name).dtype for name in ("t", "x", "y", "p")]
    assert kinds == [np.int64, np.uint16, np.uint16, np.int8], kinds
    assert len(s.t) == len(s.x) == len(s.y) == len(s.p) > 0
    assert (s.t[1:] >= s.t[:-1]).all(), "times go back"
    assert width is None or s.x.max() < width
    assert height is None or s.y.max() < height
    assert (np.abs(s.p) == int(polarity)).all()


_EVENT_ARRAY_MD5 = "5e8beee5a6c107e504c2e78903c224b8"
"""Of the definition of dvs_msgs/EventArray; readers compare it."""


def _write_pictures(writer, pictures: Sequence[tuple[np.ndarray, int, int]]) -> None:
    from rosbags.typesys import Stores, get_typestore

    if not pictures:
        return
    store = get_typestore(Stores.ROS1_NOETIC)
    image, header, time = (
        store.types[f"{package}/msg/{name}"]
        for package, name in (
            ("sensor_msgs", "Image"),
            ("std_msgs", "Header"),
            ("builtin_interfaces", "Time"),
        )
    )
    topic = writer.add_connection("/dvs/image_raw", "sensor_msgs/msg/Image", typestore=store)
    for index, (grey, start, end) in enumerate(pictures):
        height, width = grey.shape
        seconds, rest_us = divmod((start + end) // 2, 1_000_000)
        stamp = header(index, time(seconds, rest_us * 1000), "dvs")
        # a row may be longer than the picture is wide
        rows = np.pad(grey, ((0, 0), (0, 3))).reshape(-1)
        message = image(stamp, height, width, "mono8", 0, width + 3, rows)
        writer.write(topic, end, store.serialize_ros1(message, "sensor_msgs/msg/Image"))


def bag(
    s: EventStream,
    width: int = WIDTH,
    height: int = HEIGHT,
    pictures: Sequence[tuple[np.ndarray, int, int]] = (),
) -> bytes:
    """A ROS 1 bag with dvs_msgs/EventArray messages of a hundred events.

    Grey pictures, with start and end of their exposure, are stamped with its middle.
    """
    import struct

    from rosbags.rosbag1 import Writer

    definition = (
        "Header header\nuint32 height\nuint32 width\ndvs_msgs/Event[] events\n"
        f"{'=' * 80}\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
        f"{'=' * 80}\nMSG: dvs_msgs/Event\nuint16 x\nuint16 y\ntime ts\nbool polarity\n"
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "e.bag"
        with Writer(path) as writer:
            topic = writer.add_connection(
                "/dvs/events", "dvs_msgs/msg/EventArray", msgdef=definition, md5sum=_EVENT_ARRAY_MD5
            )
            for first in range(0, len(s), 100):
                rows = slice(first, first + 100)
                columns = (s.x[rows], s.y[rows], s.t[rows], s.p[rows] > 0)
                body = b"".join(
                    struct.pack("<HHII?", x, y, t // 1_000_000, t % 1_000_000 * 1000, on)
                    for x, y, t, on in zip(*(c.tolist() for c in columns), strict=True)
                )
                head = struct.pack("<IIII3sII", 0, 1, 2, 3, b"dvs", height, width)
                data = head + struct.pack("<I", len(body) // 13) + body
                writer.write(topic, first + 1, data)
            _write_pictures(writer, pictures)
        return path.read_bytes()


def _written(suffix: str, s: EventStream) -> bytes:
    return _in_file(lambda path: write_events(path, s, width=WIDTH, height=HEIGHT), suffix)


def _packed(s: EventStream) -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, xy=np.stack([s.x, s.y], axis=1), t=s.t, p=s.p > 0)
    return file.getvalue()


def _npy(s: EventStream) -> bytes:
    file = io.BytesIO()
    np.save(file, np.stack([s.t * 1e-6, s.x, s.y, s.p], axis=1))
    return file.getvalue()


def _compound(s: EventStream) -> bytes:
    kind = [("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")]
    table = np.array(list(zip(s.x, s.y, s.p > 0, s.t, strict=True)), dtype=kind)

    def write(path: Path) -> None:
        with h5py.File(path, "w") as file:
            file.create_dataset("CD/events", data=table, chunks=(64,), compression="gzip")
            file.attrs["geometry"] = "320x240"

    return _in_file(write, ".hdf5")


def _in_file(write: Callable[[Path], object], suffix: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"e{suffix}"
        write(path)
        return path.read_bytes()
