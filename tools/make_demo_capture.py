"""Shrink a capture for shipping: `make_demo_capture.py CAPTURE src/evsplat/data/demo_capture`.

Pictures become lossless WebP (same pixels). Event times are rounded to half a millisecond
and events of equal time are sorted by pixel, which halves their file; the rounding is noted in the
provenance. Dense true poses are left out.
"""

import argparse
import zipfile
from pathlib import Path

import numpy as np
from PIL import Image

from evsplat.capture import validate_capture
from evsplat.events import EventStore, EventStream, write_events
from evsplat.files import atomic_path, write_json
from evsplat.untrusted.text import read_json

TIME_QUANTUM_US = 500


def main() -> None:
    """Write the small capture, then check it as `evsplat inspect` does."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", type=Path)
    parser.add_argument("target", type=Path)
    arguments = parser.parse_args()
    shrink(arguments.source, arguments.target)
    for finding in validate_capture(arguments.target):
        print(f"{finding.severity}: {finding}")
    size = sum(path.stat().st_size for path in arguments.target.rglob("*") if path.is_file())
    print(f"{arguments.target}: {size / 1e6:.2f} MB")


def shrink(source: Path, target: Path) -> None:
    """Copy the capture at ``source`` to ``target`` in its small form."""
    document = read_json(source / "capture.json")
    for entry in [*document["frames"], *document["novel_views"]]:
        for key in ("image", "sharp", "mask"):
            if key in entry:
                entry[key] = copy_image(source, target, entry[key])
    events = document["events"]
    write_rounded_events(source / events["file"], target / events["file"], events)
    document["provenance"]["derived_from"] = document["name"]
    document["name"] = "demo_man_dance"
    document["provenance"]["events"]["time_quantum_us"] = TIME_QUANTUM_US
    copy_npz(source / document["body"]["file"], target / document["body"]["file"])
    write_json(target / "capture.json", document)


def copy_image(source: Path, target: Path, name: str) -> str:
    """Save a picture without loss; gives its new name."""
    new_name = str(Path(name).with_suffix(".webp"))
    with Image.open(source / name) as image, atomic_path(target / new_name) as temporary:
        image.save(temporary, lossless=True, quality=100, method=6)
    with Image.open(source / name) as before, Image.open(target / new_name) as after:
        same = np.array_equal(np.array(before), np.array(after.convert(before.mode)))
    if not same:
        raise SystemExit(f"{source / name}: changed by WebP")
    return new_name


def write_rounded_events(source: Path, target: Path, entry: dict) -> None:
    """Events with times on a grid, sorted by polarity and pixel where times are equal."""
    store = EventStore(source, entry["width"], entry["height"])
    events = store.between(*store.time_range_us)
    t = (events.t + TIME_QUANTUM_US // 2) // TIME_QUANTUM_US * TIME_QUANTUM_US
    order = np.lexsort((events.y, events.x, events.p, t))
    stream = EventStream(t[order], events.x[order], events.y[order], events.p[order])
    write_events(target, stream, compression_level=9)


def copy_npz(source: Path, target: Path) -> None:
    """The same arrays, packed as tightly as zip can."""
    with (
        zipfile.ZipFile(source) as before,
        atomic_path(target) as temporary,
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as after,
    ):
        for name in before.namelist():
            # a fixed date, so that the same input gives the same file
            after.writestr(zipfile.ZipInfo(name), before.read(name), zipfile.ZIP_DEFLATED, 9)


if __name__ == "__main__":
    main()
