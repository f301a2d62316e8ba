"""HDF5 files of events: DSEC, our own, Metavision's /CD/events, and others with the usual names.

Blosc and other packings need `hdf5plugin` (extra `recordings`), Prophesee's own (ECF) its plug-in.
"""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from evsplat.errors import DataError
from evsplat.events.formats.base import (
    BLOCK_EVENTS,
    SAY_UNIT,
    RawEvents,
    Source,
)
from evsplat.events.formats.table import (
    NO_POLARITY,
    Table,
    assumed_order,
    match_names,
    table_order,
    unit_called,
)
from evsplat.events.hdf5_output import has_only_darker
from evsplat.options import ReadOptions
from evsplat.untrusted.faults import brief, broken_as
from evsplat.untrusted.hdf5 import data_set, holds, open_hdf5, wrong_data_set

_PLACES = ("events", "CD/events", "/")
_ECF = 36559
# Filters that HDF5 and h5py bring with them: deflate, shuffle, checksum, scale-offset, lzf
_BUILT_IN = (1, 2, 3, 4, 5, 6, 32000)


@dataclass(frozen=True)
class _Column:
    """Place of a component: a dataset, and perhaps a field or a column of it."""

    dataset: str
    field: str | None = None
    index: int | None = None

    def read(self, file: h5py.File, part: slice) -> np.ndarray:
        dataset = file[self.dataset]
        if self.index is not None:
            return dataset[part, self.index]
        return dataset[part] if self.field is None else dataset.fields(self.field)[part]


class Hdf5(Source):
    """Events of an HDF5 file, read slice by slice."""

    def read_header(self, options: ReadOptions) -> None:
        """See `Source`."""
        with _opened(self.path) as file:
            self._columns = _find_columns(self.path, file, options)
            self._count = self._check_columns(file)
            self._offset_us = int(file["t_offset"][()]) if holds(file, "t_offset") else 0
            if abs(self._offset_us) > 1 << 60:
                raise DataError(f"{self.path}: t_offset is {self._offset_us} us, which is no time.")
            self.width, self.height = _size(file)
            unit = options.time_unit or _unit(self.path, file[self._columns["t"].dataset])
            head = Table(self.path, self._slice(file, 0), unit)
            self._unit = head.unit
            self.has_polarity = head.has_polarity or self._any_polarity(file)
        self.notes = [note for note in head.notes if note != NO_POLARITY]
        if not self.has_polarity and "p" in self._columns:
            self.notes.append(NO_POLARITY)
        places = {name: c.index for name, c in self._columns.items() if c.index is not None}
        if places and not isinstance(options.columns, tuple):
            self.notes.append(assumed_order(sorted(places, key=places.__getitem__)))

    def blocks(self) -> Iterator[RawEvents]:
        """Slices of the columns."""
        with _opened(self.path) as file:
            for first in range(0, self._count, BLOCK_EVENTS):
                table = Table(self.path, self._slice(file, first), self._unit)
                events = table.events(slice(None), first)
                yield events._replace(t=events.t + self._offset_us) if self._offset_us else events

    def _slice(self, file: h5py.File, first: int) -> dict[str, np.ndarray]:
        part = slice(first, min(first + BLOCK_EVENTS, self._count))
        datasets = {column.dataset for column in self._columns.values()}
        if len(datasets) == 1 and len(self._columns) > 1:
            # one compound or table: read and unpack it once
            rows = file[datasets.pop()][part]
            return {
                key: rows[c.field] if c.field else rows[:, c.index]
                for key, c in self._columns.items()
            }
        return {key: column.read(file, part) for key, column in self._columns.items()}

    def _any_polarity(self, file: h5py.File) -> bool:
        """True where an event after the first slice has a polarity other than 0, or 0 is one."""
        if "p" not in self._columns:
            return False
        if has_only_darker(file):
            return True
        starts = range(BLOCK_EVENTS, self._count, BLOCK_EVENTS)
        slices = (slice(first, first + BLOCK_EVENTS) for first in starts)
        return any(self._columns["p"].read(file, part).any() for part in slices)

    def _check_columns(self, file: h5py.File) -> int:
        """The count of events, when all columns have it and can be unpacked."""
        counts = {}
        for key, column in self._columns.items():
            dataset = data_set(file, column.dataset)
            _check_filters(self.path, dataset)
            counts[key] = len(dataset)
        if len(set(counts.values())) != 1:
            text = ", ".join(f"{key}: {count:,}" for key, count in counts.items())
            raise DataError(f"{self.path}: its components differ in length ({text}).")
        return counts["t"]


def _find_columns(path: Path, file: h5py.File, options: ReadOptions) -> dict[str, _Column]:
    given = options.columns
    if isinstance(given, Mapping):
        missing = [name for name in given.values() if not holds(file, name)]
        if missing or not {"t", "x", "y"} <= set(given):
            raise DataError(
                f"{path}: columns is {dict(given)}, expected datasets for t, x, y and perhaps p"
                + (f"; {missing[0]!r} is not in the file." if missing else ".")
            )
        return {key: _Column(name) for key, name in given.items()}
    for place in _PLACES:
        found = _columns_at(path, file, place, options) if holds(file, place) else {}
        if {"t", "x", "y"} <= set(found):
            return found
    deeper = _deeper_places(path, file, options)
    if len(deeper) == 1:
        return next(iter(deeper.values()))
    if deeper:
        first = next(iter(deeper))
        raise DataError(
            f"{path}: holds events at {', '.join('/' + place for place in deeper)}, expected one "
            f"recording; copy one into a file of its own, such as with h5copy -i IN -s /{first} "
            "-o OUT -d /events."
        )
    there = ", ".join(file) or "nothing"
    raise DataError(
        f"{path}: no events at /events, /CD/events, its root or a group of t, x, y and p (there: "
        f"{there}); name them so, or say from Python where they are with columns, such as "
        "{'t': 'stream/time', ...}."
    )


def _columns_at(
    path: Path, file: h5py.File, place: str, options: ReadOptions
) -> dict[str, _Column]:
    """Components in a group of columns, in a compound or in a table; empty in anything else."""
    node = file[place]
    if isinstance(node, h5py.Group):
        keys = [key for key in node if isinstance(node.get(key), h5py.Dataset)]
        keys = [key for key in keys if node[key].ndim == 1]
        return {
            key: _Column(f"{place}/{name}".replace("//", "/"))
            for key, name in match_names(keys).items()
        }
    if node.dtype.names:
        names = match_names(node.dtype.names)
        return {key: _Column(place, field=name) for key, name in names.items()}
    if node.ndim == 2 and node.shape[1] in (3, 4):
        _check_filters(path, node)
        order = options.columns if isinstance(options.columns, tuple) else None
        order = order or tuple(table_order(path, node[:BLOCK_EVENTS], options))
        return {name: _Column(place, index=i) for i, name in enumerate(order) if name in "txyp"}
    return {}


def _deeper_places(
    path: Path, file: h5py.File, options: ReadOptions
) -> dict[str, dict[str, _Column]]:
    """Components at each place below the usual ones that can only hold events.

    Such are groups and compounds with p beside t, x and y, which tracks of a camera have as well
    (M3ED's /prophesee/left), and tables that are called events (MVSEC's /davis/left/events).
    """
    places: list[str] = []
    # follows no link, so that it ends and stays within the file
    file.visit(places.append)
    found = {}
    for place in places:
        node = file[place]
        if isinstance(node, h5py.Dataset):
            named = node.dtype.names or place.rpartition("/")[2] == "events"
            if not named or wrong_data_set(file, place):
                continue
        columns = _columns_at(path, file, place, options)
        if {"t", "x", "y", "p"} <= set(columns):
            found[place] = columns
    return found


def _check_filters(path: Path, dataset: h5py.Dataset) -> None:
    """Load the plugins that unpack a dataset, or say what is missing."""
    properties = dataset.id.get_create_plist()
    filters = [properties.get_filter(i)[0] for i in range(properties.get_nfilters())]
    if _ECF in filters and not h5py.h5z.filter_avail(_ECF):
        raise DataError(
            f"{path}: packed with Prophesee's ECF, whose plug-in is not found; set "
            "HDF5_PLUGIN_PATH to its folder (it comes with Metavision, and alone as "
            "github.com/prophesee-ai/hdf5_ecf), or write the recording as RAW or DAT with "
            "Metavision (metavision_file_to_dat) and read that."
        )
    others = [number for number in filters if number not in (*_BUILT_IN, _ECF)]
    if others:
        try:
            import hdf5plugin  # noqa: F401 - registers the filters
        except ImportError:
            raise DataError(
                f"{path}: packed with HDF5 filter {others[0]}; pip install 'evsplat[recordings]' "
                "to read it."
            ) from None


def _unit(path: Path, times: h5py.Dataset) -> str | None:
    """Unit of the times, where an attribute of theirs says."""
    for name in ("unit", "units"):
        if name not in times.attrs:
            continue
        said = times.attrs[name]
        word = said.decode("utf-8", "replace") if isinstance(said, bytes) else said
        unit = unit_called(word.strip().lower()) if isinstance(word, str) else None
        if unit is not None:
            return unit
        raise DataError(
            f"{path}: attribute {name} of {times.name} is {brief(said)}, expected s, ms, us or ns; "
            f"correct it, or give the unit with {SAY_UNIT}."
        )
    return None


def _size(file: h5py.File) -> tuple[int | None, int | None]:
    """Width and height, where an attribute says."""
    for place in _PLACES:
        attributes = file[place].attrs if holds(file, place) else {}
        if "width" in attributes and "height" in attributes:
            return int(attributes["width"]), int(attributes["height"])
        if "sensor_resolution" in attributes:  # e2vid: rows first
            rows, columns = (int(n) for n in attributes["sensor_resolution"][:2])
            return columns, rows
        geometry = attributes.get("geometry", "")
        if isinstance(geometry, bytes):  # of a fixed length
            geometry = geometry.decode("latin-1")
        match = re.fullmatch(r"(\d+)x(\d+)", str(geometry))
        if match:
            return int(match[1]), int(match[2])
    return None, None


@contextmanager
def _opened(path: Path) -> Iterator[h5py.File]:
    with (
        broken_as(path, "its HDF5 content cannot be read"),
        open_hdf5(path) as file,
    ):
        yield file
