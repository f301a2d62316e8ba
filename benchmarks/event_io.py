"""Speed of reading event recordings, in million events a second, beside eventcv.

python benchmarks/event_io.py [--data FOLDER] [--repeats R]

FOLDER holds the recordings of docs/event-formats.md; without one, only those made here are read.
Each is read whole into arrays, as often as asked, and the fastest counts: by the clock, and by
processor time, which a busy machine disturbs less. The last line is JSON with a unit in each key.
"""

import argparse
import gzip
import json
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from evsplat.errors import DataError
from evsplat.events import EventStream, open_recording, read_events, write_events

RECORDINGS = {
    "evt2": "evt2.raw",
    "evt3": "evt3.raw",
    "aedat2": "IMU_translBoxes.aedat",
    "aedat4": "person_dvxplorer.aedat4",
    "aedat4_davis": "davis346.aedat4",
    "es": "dvs.es",
    "rosbag": "test_events_1.bag",
}
MADE_EVENTS = 1_000_000
WIDTH, HEIGHT = 640, 480


def main() -> None:
    """Print a table and one line of JSON."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=None)
    parser.add_argument("--repeats", type=int, default=9)
    arguments = parser.parse_args()
    folder = arguments.data or Path(os.environ.get("EVSPLAT_TEST_DATA", default)) / "events"
    results: dict[str, float | int] = {"repeats": arguments.repeats}
    print(f"{'':14s} {'events':>9s} {'evsplat':>8s} {'(CPU)':>7s} {'eventcv':>8s} {'(CPU)':>7s}")
    with tempfile.TemporaryDirectory() as scratch:
        files = {kind: folder / name for kind, name in RECORDINGS.items()}
        files = {kind: path for kind, path in files.items() if path.exists()}
        files |= make_files(folder, Path(scratch))
        for kind, path in files.items():
            results |= measure(kind, path, arguments.repeats)
    print(json.dumps(results))


def measure(kind: str, path: Path, repeats: int) -> dict[str, float | int]:
    """Figures of one recording, by clock and by processor time."""
    count = len(read_events(path))
    ours = fastest(lambda: open_recording(path).read(), repeats)
    theirs = fastest(peer(path, count), repeats)
    row: dict[str, float | int] = {f"{kind}_events": count}
    columns = []
    for name, seconds in (("", ours), ("_eventcv", theirs)):
        for clock, value in zip(("", "_cpu"), seconds or (None, None), strict=True):
            columns.append("-" if value is None else f"{count / value / 1e6:.1f}")
            if value is not None:
                row[f"{kind}{name}{clock}_mev_per_s"] = round(count / value / 1e6, 1)
    ratio = ""
    if ours and theirs:
        row[f"{kind}_over_eventcv"] = round(theirs[0] / ours[0], 2)
        row[f"{kind}_over_eventcv_cpu"] = round(theirs[1] / ours[1], 2)
        ratio = f"  {theirs[0] / ours[0]:.1f}x, {theirs[1] / ours[1]:.1f}x in CPU seconds"
    print(f"{kind:14s} {count:9,d} " + " ".join(f"{c:>7s}" for c in columns) + ratio)
    return row


def peer(path: Path, count: int) -> Callable[[], Any] | None:
    """The same in eventcv; None where it is missing, refuses the file or reads it wrongly."""
    try:
        import eventcv
    except ImportError:
        return None

    def read() -> Any:
        return eventcv.load(str(path)).numpy()

    try:
        found = len(read())
    except Exception as error:
        print(f"  eventcv: {path.suffix}: {str(error)[:70]}")
        return None
    if found != count:
        print(f"  eventcv: {path.suffix}: {found:,} of {count:,} events")
        return None
    return read


def fastest(read: Callable[[], Any] | None, repeats: int) -> tuple[float, float] | None:
    """Least seconds by the clock and of the processor, after one run to warm up."""
    if read is None:
        return None
    read()
    clock, processor = [], []
    for _ in range(repeats):
        start, start_cpu = time.perf_counter(), time.process_time()
        read()
        clock.append(time.perf_counter() - start)
        processor.append(time.process_time() - start_cpu)
    return min(clock), min(processor)


def make_files(folder: Path, scratch: Path) -> dict[str, Path]:
    """Recordings of formats that no file of the folder has, from the same events."""
    s = made_stream()
    files = {kind: scratch / f"{kind}.{suffix}" for kind, suffix in (
        ("npz", "npz"), ("npz_packed", "npz"), ("csv", "csv"), ("txt_seconds", "txt"),
        ("hdf5", "h5"), ("hdf5_dsec", "h5"), ("dat", "dat"), ("evt21", "raw"),
    )}  # fmt: skip
    write_events(files["npz"], s, width=WIDTH, height=HEIGHT)
    np.savez_compressed(files["npz_packed"], t=s.t, x=s.x, y=s.y, p=s.p)
    write_events(files["hdf5"], s, width=WIDTH, height=HEIGHT)
    on = (s.p > 0).astype(np.uint64)
    rows = zip((s.t * 1e-6).tolist(), s.x.tolist(), s.y.tolist(), on.tolist(), strict=True)
    files["txt_seconds"].write_text("".join("%.6f %d %d %d\n" % row for row in rows))  # noqa: UP031
    packed = folder / "dvs.csv.gz"
    if packed.exists():
        files["csv"].write_bytes(gzip.decompress(packed.read_bytes()))
    else:
        write_events(files["csv"], s, width=WIDTH, height=HEIGHT)
    x, y, t = (values.astype(np.uint64) for values in (s.x, s.y, s.t))
    pairs = np.stack([t, on << 28 | y << 14 | x], axis=1).astype("<u4")
    header = f"% Data file containing CD events.\n% Version 2\n% Height {HEIGHT}\n% Width {WIDTH}\n"
    files["dat"].write_bytes(header.encode() + b"\x0c\x08" + pairs.tobytes())
    # a time before every event, as busy cameras write about as many times as vectors
    words = np.empty(2 * len(s), dtype="<u8")
    words[0::2] = np.uint64(0x8) << 60 | t >> 6 << 32
    words[1::2] = on << 60 | (t & 63) << 54 | x // 32 * 32 << 43 | y << 32 | 1 << x % 32
    files["evt21"].write_bytes(
        f"% evt 2.1\n% geometry {WIDTH}x{HEIGHT}\n".encode() + words.tobytes()
    )
    try:
        import hdf5plugin
    except ImportError:
        del files["hdf5_dsec"]
        return files
    with h5py.File(files["hdf5_dsec"], "w") as file:
        packing = hdf5plugin.Blosc(cname="zstd", clevel=1)
        columns = {"t": s.t.astype("u4"), "x": s.x, "y": s.y, "p": on.astype("u1")}
        for name, values in columns.items():
            file.create_dataset(f"events/{name}", data=values, chunks=(1 << 16,), **packing)
        file["t_offset"] = np.int64(0)
    return files


def made_stream() -> EventStream:
    """A square that moves over the sensor, with noise: coordinates and times as real ones."""
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.integers(0, 4, MADE_EVENTS)).astype(np.int64)
    phase = t / t[-1]
    x = (50 + 400 * phase + rng.normal(0, 20, MADE_EVENTS)).clip(0, WIDTH - 1)
    y = (200 + rng.normal(0, 60, MADE_EVENTS)).clip(0, HEIGHT - 1)
    p = rng.choice(np.array([-1, 1], np.int8), MADE_EVENTS)
    return EventStream(t, x.astype(np.uint16), y.astype(np.uint16), p)


if __name__ == "__main__":
    try:
        main()
    except DataError as error:
        raise SystemExit(str(error)) from None
