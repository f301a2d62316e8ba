"""Formats of event recordings, one module each, chosen by the first bytes of a file."""

import re
from codecs import BOM_UTF8
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from evsplat.errors import ConfigError, DataError
from evsplat.events.formats.base import ZSTD_MAGIC, Damage, Source, is_gzipped, peek
from evsplat.options import ReadOptions

_HEAD_BYTES = 4096


@dataclass(frozen=True)
class Format:
    """Name, recognition and reader of a format."""

    name: str
    matches: Callable[[bytes], bool]
    """True for the first bytes of a file of this format."""
    reader: str
    """``module:class``, imported at first use."""
    is_stream: bool = True
    """Read from the first byte to the last, so that it may be gzipped."""

    def open(self, path: Path, options: ReadOptions, damage: Damage) -> Source:
        """The recording, its header read."""
        module, name = self.reader.split(":")
        source: Source = getattr(import_module(f"{__name__}.{module}"), name)(path, options, damage)
        return source


def _starts(*magics: bytes) -> Callable[[bytes], bool]:
    return lambda head: head.startswith(magics)


_is_bag = _starts(b"#ROSBAG V2.0", b"\x89MCAP0\r\n", b"SQLite format 3\0")


def _is_dat(head: bytes) -> bool:
    return head.startswith(b"% Data file containing") or _is_header(head, rb"^% Version ")


def _is_raw(head: bytes) -> bool:
    return _is_header(head, rb"^% (evt |format EVT)")


def _is_header(head: bytes, line: bytes) -> bool:
    """Prophesee's "% key value" lines, this one among them."""
    lines = re.match(rb"(% [^\n]*\n)*", head)
    return lines is not None and re.search(line, lines[0], re.MULTILINE) is not None


def _is_text(head: bytes) -> bool:
    return bool(head) and not set(head) - set(range(32, 127)) - set(b"\t\r\n" + BOM_UTF8)


# Magics first; text is what is left.
FORMATS = {
    entry.name: entry
    for entry in (
        Format("aedat4", _starts(b"#!AER-DAT4.0"), "aedat4:Aedat4"),
        Format("aedat3", _starts(b"#!AER-DAT3.1"), "aedat3:Aedat3"),
        Format("aedat2", _starts(b"#!AER-DAT2.0"), "aedat2:Aedat2"),
        Format("dat", _is_dat, "prophesee:Dat"),
        Format("raw", _is_raw, "prophesee:Raw"),
        Format("es", _starts(b"Event Stream"), "event_stream:EventStreamFile"),
        Format("hdf5", _starts(b"\x89HDF\r\n\x1a\n"), "hdf5:Hdf5", is_stream=False),
        Format("rosbag", _is_bag, "ros:RosBag", is_stream=False),
        Format("npz", _starts(b"PK\x03\x04", b"\x93NUMPY"), "npz:Npz", is_stream=False),
        Format("csv", _is_text, "text:Text"),
    )
}


def find_format(path: Path, name: str | None = None) -> Format:
    """The format of a file by its content; ``name`` must agree where it is given."""
    if name is not None and name not in FORMATS:
        raise ConfigError(f"format is {name!r}, expected one of {', '.join(FORMATS)}.")
    if path.is_dir():
        # a ROS 2 bag is a folder
        if not (path / "metadata.yaml").is_file():
            raise DataError(
                f"{path}: a folder without metadata.yaml is no recording, expected a file, or the "
                "folder of a ROS 2 bag; give the file in it."
            )
        head = b"SQLite format 3\0"
    else:
        head = peek(path, _HEAD_BYTES)
    found = next((entry for entry in FORMATS.values() if entry.matches(head)), None)
    if found is None:
        found_there = f"begins with {head[:16]!r}" if head else "is empty"
        if head[4:8] == b"ftyp":
            found_there = "a video, which 'evsplat import video' reads"
        if head.startswith(ZSTD_MAGIC):
            found_there = "packed by Zstandard: unzstd it first, or give a ROS 2 bag's folder"
        raise DataError(
            f"{path}: not a recording that evsplat reads ({found_there}); expected one of "
            f"{', '.join(FORMATS)}."
        )
    if not found.is_stream and path.is_file() and is_gzipped(path):
        raise DataError(f"{path}: a gzipped {found.name} file; gunzip it first.")
    if name is not None and found.name != name:
        raise DataError(f"{path}: its content is {found.name}, not {name}.")
    return found
