"""Writing event recordings, whole or piece by piece: HDF5, .npz, .csv and Prophesee's EVT 2."""

import zipfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path
from shutil import copyfileobj
from typing import IO, Any

import h5py
import numpy as np

from evsplat.disk import uninterrupted
from evsplat.errors import ConfigError, DataError
from evsplat.events.hdf5_output import Hdf5Output, note_only_darker
from evsplat.events.stream import EventStream
from evsplat.files import atomic_path, open_output, try_target, unnamed_file

CHUNK_EVENTS = 65_536
_COPY_BYTES = 1 << 20
_EVT2_PIXELS = 1 << 11
_EVT2_LOW_BITS, _EVT2_TIME_BITS = 6, 34
_SUFFIXES = {
    ".h5": "hdf5",
    ".hdf5": "hdf5",
    ".npz": "npz",
    ".csv": "csv",
    ".txt": "csv",
    ".raw": "evt2",
}
WRITTEN_FORMATS = ("hdf5", "npz", "csv", "evt2")

Size = tuple[int, int] | None
"""Width and height of the sensor, where they are known."""


def write_events(
    path: Path | str,
    events: EventStream | Iterable[EventStream],
    *,
    format: str | None = None,
    width: int | None = None,
    height: int | None = None,
    compression_level: int = 4,
    attributes: Mapping[str, str | int | float] | None = None,
) -> int:
    """Write a recording, whole or not at all; gives the count of events.

    ``events`` is one stream or its consecutive pieces, which are written as they come: memory does
    not grow with the length of the recording.

    Args:
        path: The file; its suffix chooses the format: .h5 and .hdf5 (as `EventStore` reads them),
            .npz (t, x, y, p), .csv and .txt (named columns), .raw (EVT 2).
        events: Sorted events.
        format: "hdf5", "npz", "csv" or "evt2", whatever the suffix.
        width: Columns of the sensor, written down where the format has a place for it.
        height: Rows of the sensor, likewise.
        compression_level: Of HDF5, 0 to 9.
        attributes: Of HDF5: where the events come from, kept as the file's attributes; readers
            use ``width`` and ``height``.

    Raises:
        DataError: Times that go back, within a piece or from one to the next, or events that the
            format cannot hold.
        ConfigError: No such format.
    """
    path = Path(path)
    format = written_format(path, format)
    try_target(path)
    size = None if width is None or height is None else (width, height)
    stored = {**(attributes or {}), **dict(zip(("width", "height"), size or (), strict=False))}
    makers: dict[str, Callable[[Path], Writer]] = {
        "hdf5": lambda temporary: Hdf5Writer(temporary, stored, compression_level),
        "npz": lambda temporary: NpzWriter(temporary, size),
        "csv": lambda temporary: CsvWriter(temporary, size),
        "evt2": lambda temporary: Evt2Writer(temporary, size, path),
    }
    last_us: int | None = None
    count = 0
    with atomic_path(path) as temporary, ExitStack() as stack:
        with uninterrupted():
            writer = stack.enter_context(makers[format](temporary))
        for piece in (events,) if isinstance(events, EventStream) else events:
            if not len(piece):
                continue
            back = (np.diff(piece.t) < 0).any() or (last_us is not None and piece.t[0] < last_us)
            if back:
                raise DataError(f"{path}: events must be sorted by t before they are written.")
            writer.append(piece)
            last_us, count = int(piece.t[-1]), count + len(piece)
        writer.finish()
    return count


def written_format(path: Path, asked: str | None = None) -> str:
    """The format of `write_events` that is asked for, or else that of the suffix.

    Raises:
        ConfigError: No such format.
        DataError: ``path`` is a device, and the format cannot be written to one, or a folder.
    """
    if asked is None and path.suffix.lower() not in _SUFFIXES:
        raise ConfigError(
            f"{path}: the suffix names no format that evsplat writes events in; give a name that "
            f"ends in {', '.join(_SUFFIXES)}."
        )
    chosen = asked or _SUFFIXES[path.suffix.lower()]
    if chosen not in WRITTEN_FORMATS:
        raise ConfigError(f"format is {chosen!r}, expected one of {', '.join(WRITTEN_FORMATS)}.")
    if chosen == "hdf5" and path.exists() and not path.is_file() and not path.is_dir():
        raise DataError(f"{path}: is a device, which HDF5 cannot be written to; write csv or evt2.")
    if path.is_dir():
        raise DataError(f"{path}: is a folder; give the name of a file.")
    return chosen


class Writer(ExitStack, ABC):
    """Takes sorted pieces one after the other; closes its files at the end of a ``with``."""

    @abstractmethod
    def append(self, piece: EventStream) -> None:
        """Add events, at least one."""

    def finish(self) -> None:
        """Write what can only be known at the end."""
        return


class Hdf5Writer(Writer):
    """The layout that `EventStore` and DSEC's tools read.

    ``t_offset`` is the first event's millisecond, so that the index of milliseconds does not start
    in 1970.
    """

    def __init__(
        self, path: Path, attributes: Mapping[str, object], compression_level: int
    ) -> None:
        super().__init__()
        # In this order, as the last one is closed first.
        self._output = self.enter_context(Hdf5Output(path))
        self._file = h5py.File(self._output, "w")
        self.callback(self._close)
        self._count = self._offset = self._next_ms = 0
        self._only_darker = True
        self._index: list[np.ndarray] = []
        packing: dict[str, Any] = {
            "chunks": (CHUNK_EVENTS,),
            "compression": "gzip",
            "compression_opts": compression_level,
            # bytes of equal weight together: neighbouring times share their high bytes
            "shuffle": True,
        }
        for name, kind in (("t", "i8"), ("x", "u2"), ("y", "u2"), ("p", "u1")):
            self._file.create_dataset(f"events/{name}", (0,), kind, maxshape=(None,), **packing)
        self._file.attrs.update(attributes)

    def append(self, piece: EventStream) -> None:
        """Add rows to the columns and to the index of milliseconds."""
        with uninterrupted():
            self._append(piece)
        self._output.raise_error()

    def _append(self, piece: EventStream) -> None:
        if self._count == 0:
            self._offset = int(piece.t[0]) // 1000 * 1000
        t = piece.t.astype(np.int64) - self._offset
        end = self._count + len(t)
        for name, values in (("t", t), ("x", piece.x), ("y", piece.y), ("p", piece.p > 0)):
            column = self._file[f"events/{name}"]
            column.resize((end,))
            column[self._count :] = values
        self._only_darker &= bool((piece.p < 0).all())
        edges = np.arange(self._next_ms, int(t[-1]) // 1000 + 1, dtype=np.int64)
        self._index.append(np.searchsorted(t, edges * 1000, side="left") + self._count)
        self._next_ms += len(edges)
        self._count = end

    def finish(self) -> None:
        """Add the index: entry m is the first event with t >= 1000 m, the last one the count."""
        # an empty recording has the millisecond 0 as any other
        tail = np.full(1 if self._count else 2, self._count)
        with uninterrupted():
            self._file["ms_to_idx"] = np.concatenate([*self._index, tail]).astype(np.uint64)
            self._file["t_offset"] = np.int64(self._offset)
            if self._count and self._only_darker:
                note_only_darker(self._file)
        self._close()
        self._output.raise_error()

    def _close(self) -> None:
        with uninterrupted():
            self._file.close()


class NpzWriter(Writer):
    """Arrays t (int64 us), x, y (uint16) and p (int8: 1, -1, or 0 throughout), not packed."""

    def __init__(self, path: Path, size: Size) -> None:
        super().__init__()
        self._path, self._size = path, size
        self._count = 0
        # the header of an array says its length, which is known at the end
        self._columns: dict[str, tuple[IO[bytes], np.dtype]] = {
            name: (self.enter_context(unnamed_file(path.parent)), np.dtype(kind))
            for name, kind in (("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "i1"))
        }

    def append(self, piece: EventStream) -> None:
        """Add rows to the columns, each in a file of its own."""
        for name, (file, kind) in self._columns.items():
            file.write(np.ascontiguousarray(getattr(piece, name), dtype=kind).tobytes())
        self._count += len(piece)

    def finish(self) -> None:
        """Put the columns into one archive."""
        with zipfile.ZipFile(self._path, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
            for name, (column, kind) in self._columns.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    header = np.lib.format.header_data_from_array_1_0(np.zeros(0, kind))
                    header["shape"] = (self._count,)
                    np.lib.format.write_array_header_1_0(member, header)
                    column.seek(0)
                    copyfileobj(column, member, _COPY_BYTES)
            for name, value in zip(("width", "height"), self._size or (), strict=False):
                with archive.open(f"{name}.npy", "w") as member:
                    np.lib.format.write_array(member, np.asarray(value))


class CsvWriter(Writer):
    """Lines ``t,x,y,on`` of whole microseconds and 0 or 1; without ``on`` where there is none."""

    def __init__(self, path: Path, size: Size) -> None:
        super().__init__()
        self._file = self.enter_context(open_output(path))
        self._names = ["t", "x", "y"] if size is None else ["t", f"x@{size[0]}", f"y@{size[1]}"]
        self._has_polarity: bool | None = None

    def append(self, piece: EventStream) -> None:
        """Add lines; the first piece decides whether there is a column of polarity."""
        if self._has_polarity is None:
            self._write_header(bool(piece.p.any()))
        columns = [piece.t.tolist(), piece.x.tolist(), piece.y.tolist()]
        if self._has_polarity:
            columns.append((piece.p > 0).astype(np.uint8).tolist())
        line = ",".join(["%d"] * len(columns)) + "\n"
        self._write("".join(map(line.__mod__, zip(*columns, strict=True))))

    def finish(self) -> None:
        """An empty recording has its header."""
        if self._has_polarity is None:
            self._write_header(True)

    def _write_header(self, has_polarity: bool) -> None:
        self._has_polarity = has_polarity
        self._write(",".join([*self._names, *(["on"] if has_polarity else [])]) + "\n")

    def _write(self, text: str) -> None:
        self._file.write(text.encode("ascii"))


class Evt2Writer(Writer):
    """Prophesee RAW of EVT 2: times of 34 bits, pixels of 11, always a polarity."""

    def __init__(self, path: Path, size: Size, name: Path) -> None:
        super().__init__()
        self._name = name
        self._file = self.enter_context(open_output(path))
        self._high = -1
        lines = ["evt 2.0", "format EVT2" + (f";height={size[1]};width={size[0]}" if size else "")]
        lines += [f"geometry {size[0]}x{size[1]}"] if size else []
        self._file.write("".join(f"% {line}\n" for line in [*lines, "end"]).encode())

    def append(self, piece: EventStream) -> None:
        """Add words, one with the high bits of the time before the events that share them."""
        if piece.t[0] < 0 or piece.t[-1] >= 1 << _EVT2_TIME_BITS:
            raise DataError(
                f"{self._name}: times from {piece.t[0]} to {piece.t[-1]} us do not fit in the 34 "
                "bits of EVT 2; let the recording begin at zero (--from-zero)."
            )
        if max(piece.x.max(), piece.y.max()) >= _EVT2_PIXELS:
            raise DataError(
                f"{self._name}: pixel x={piece.x.max()}, y={piece.y.max()} does not fit in the 11 "
                "bits of EVT 2; write .h5, .npz or .csv."
            )
        if not piece.p.all():
            raise DataError(
                f"{self._name}: EVT 2 cannot say that an event has no polarity; write .h5, .npz or "
                ".csv."
            )
        high = piece.t >> _EVT2_LOW_BITS
        changes = np.diff(high, prepend=self._high) != 0
        self._high = int(high[-1])
        words = np.empty(len(piece) + int(changes.sum()), dtype="<u4")
        at = np.arange(len(piece)) + np.cumsum(changes)
        low = (piece.t & ((1 << _EVT2_LOW_BITS) - 1)).astype(np.uint32)
        on = (piece.p > 0).astype(np.uint32)
        words[at] = on << 28 | low << 22 | piece.x.astype(np.uint32) << 11 | piece.y
        words[at[changes] - 1] = 0x8 << 28 | high[changes].astype(np.uint32)
        self._file.write(words.tobytes())
