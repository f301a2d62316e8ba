"""Writing event recordings in the layout that `EventStore` reads, whole or piece by piece."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from evsplat.errors import DataError
from evsplat.events.stream import EventStream
from evsplat.files import atomic_path

CHUNK_EVENTS = 65_536
_COLUMNS = {"t": np.int64, "x": np.uint16, "y": np.uint16, "p": np.uint8}


def write_events(
    path: Path | str,
    events: EventStream | Iterable[EventStream],
    *,
    compression_level: int = 4,
    attributes: Mapping[str, str | int | float] | None = None,
) -> int:
    """Write events as `EventStore` reads them, whole or not at all; gives their count.

    ``events`` is one stream or its consecutive pieces, which are written as they come: memory does
    not grow with the length of the recording. ``t_offset`` is the first event's millisecond, so
    that the index of milliseconds does not start in 1970. ``attributes`` tell where the events come
    from and are kept as the file's; readers use ``width`` and ``height``.

    Raises:
        DataError: times that go back, within a piece or from one to the next.
    """
    pieces = (events,) if isinstance(events, EventStream) else events
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        writer = _Writer(Path(path), file, compression_level)
        for piece in pieces:
            writer.append(piece)
        writer.finish()
        file.attrs.update(attributes or {})
        return writer.count


class _Writer:
    """Appends pieces to the columns of an open file and keeps the index of milliseconds."""

    def __init__(self, path: Path, file: h5py.File, compression_level: int) -> None:
        self.path, self.file = path, file
        self.count = 0
        self._offset = 0
        self._last = 0
        self._index: list[np.ndarray] = []
        self._next_ms = 0
        packing: dict[str, Any] = {
            "chunks": (CHUNK_EVENTS,),
            "compression": "gzip",
            "compression_opts": compression_level,
            # bytes of equal weight together: neighbouring times share their high bytes
            "shuffle": True,
        }
        for name, kind in _COLUMNS.items():
            file.create_dataset(f"events/{name}", (0,), kind, maxshape=(None,), **packing)

    def append(self, piece: EventStream) -> None:
        if not len(piece):
            return
        t = piece.t.astype(np.int64)
        if self.count == 0:
            self._offset = int(t[0]) // 1000 * 1000
        t -= self._offset
        if t[0] < self._last or (np.diff(t) < 0).any():
            raise DataError(f"{self.path}: events must be sorted by t before they are written.")
        end = self.count + len(t)
        for name, values in (("t", t), ("x", piece.x), ("y", piece.y), ("p", piece.p > 0)):
            column = self.file[f"events/{name}"]
            column.resize((end,))
            column[self.count :] = values
        edges = np.arange(self._next_ms, int(t[-1]) // 1000 + 1, dtype=np.int64)
        self._index.append(np.searchsorted(t, edges * 1000, side="left") + self.count)
        self._next_ms += len(edges)
        self._last, self.count = int(t[-1]), end

    def finish(self) -> None:
        """Add the index: entry m is the first event with t >= 1000 m, the last one the count."""
        # an empty recording has the millisecond 0 as any other
        tail = np.full(1 if self.count else 2, self.count)
        self.file["ms_to_idx"] = np.concatenate([*self._index, tail]).astype(np.uint64)
        self.file["t_offset"] = np.int64(self._offset)
