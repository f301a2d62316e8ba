"""Event recordings on disk, sliced by time without loading the rest (layout of DSEC's HDF5 files).

`events/{t,x,y,p}` are sorted by t; `ms_to_idx[m]` is the index of the first event with
t >= 1000 m; `t_offset` is added to every t. Times that leave this module are on the camera's clock:
``t + t_offset + clock_offset_us``.
"""

import copy
import functools
import os
from bisect import bisect_left, bisect_right
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from jaxtyping import Float, Int64

from evsplat.errors import DataError, HeldOutError
from evsplat.events.hdf5_output import has_only_darker
from evsplat.events.stream import EventStream
from evsplat.untrusted.faults import broken_as
from evsplat.untrusted.hdf5 import data_set, open_hdf5

Span = tuple[int, int]
"""Start and end of a stretch of time, microseconds, the end exclusive."""
ALWAYS: Span = (-(1 << 62), 1 << 62)
"""All of time."""

# HDF5 keeps decoded chunks of a data set as long as that is open; 4 MiB hold eight chunks of int64
# times.
_CHUNK_CACHE_BYTES = 4 << 20
_COLUMNS = ("events/t", "events/x", "events/y", "events/p")
_POLARITY_BLOCK = 1 << 16
_KEPT_BLOCK = 1 << 16
"""Rows that are decoded and kept together."""
_CHECKED_ROWS = 1 << 16
"""Entries of the index that are remembered as right."""
INDEX_PIECE = 1 << 20
"""Entries of the index that are read at a time."""
_EVENT_BYTES = 13
"""Of an `EventStream`."""
_HIDDEN = (
    ", which this training's policy hides; with --set policy.held_out_events=true it is seen, and "
    "figures are those of interpolation."
)


class EventStore:
    """One event file; opened at the first read and again after a fork or unpickling.

    ``pixel_lookup`` (H, W, 2), int32, maps a sensor pixel to the (x, y) of the undistorted image,
    -1 where it falls outside; those events are dropped from slices (but counted by ``len``).

    ``readable_us`` are the stretches of time that may be read, in order; what lies between them is
    held out: to ask for it is a `HeldOutError`, and nothing that is said of the recording depends
    on it.
    """

    def __init__(
        self,
        path: Path | str,
        width: int,
        height: int,
        clock_offset_us: int = 0,
        pixel_lookup: np.ndarray | None = None,
        readable_us: Sequence[Span] = (ALWAYS,),
    ) -> None:
        self.path = Path(path)
        self.width = width
        self.height = height
        self.clock_offset_us = clock_offset_us
        self._pixel_lookup = pixel_lookup
        self._readable_us = tuple(readable_us)
        self._keep_bytes = 0
        self._kept: OrderedDict[int, EventStream] = OrderedDict()
        self._checked_rows: dict[int, int] = {}
        self._file: h5py.File | None = None
        self._data: dict[str, h5py.Dataset] = {}
        self._owner_pid = -1
        self._shift_us = 0
        self._has_polarity: bool | None = None

    def __getstate__(self) -> dict[str, Any]:
        closed: dict[str, Any] = {"_file": None, "_data": {}, "_owner_pid": -1}
        return self.__dict__ | closed | {"_kept": OrderedDict()}

    def __len__(self) -> int:
        """Count of events, without held-out ones."""
        return sum(last - first for first, last in self._readable_rows)

    @property
    def time_range_us(self) -> Span:
        """First event and one past the last, so that of a recording without held-out intervals
        ``between(*time_range_us)`` is everything.

        (0, 0) where there are no events.
        """
        rows = [pair for pair in self._readable_rows if pair[0] < pair[1]]
        if not rows:
            return 0, 0
        first, last = (self._time_of(row) for row in (rows[0][0], rows[-1][1] - 1))
        return first + self._shift_us, last + self._shift_us + 1

    @property
    def stretches_us(self) -> tuple[Span, ...]:
        """Stretches of `time_range_us` that may be read; one where nothing is held out."""
        start, end = self.time_range_us
        within = ((max(first, start), min(last, end)) for first, last in self._readable_us)
        return tuple((first, last) for first, last in within if first < last)

    def readable_around(self, time_us: int) -> Span:
        """The stretch of time that may be read and holds an instant, or ends with it."""
        span = self._readable_from(time_us)
        if span is None or time_us > span[1]:
            raise HeldOutError(f"{self.path}: {time_us} us lies in a held-out interval{_HIDDEN}")
        return span

    def restricted_to(self, readable_us: Sequence[Span]) -> "EventStore":
        """The same recording as it is seen where only ``readable_us`` may be read."""
        size, lookup = (self.width, self.height), self._pixel_lookup
        return EventStore(self.path, *size, self.clock_offset_us, lookup, readable_us)

    def keeping(self, limit_bytes: int) -> "EventStore":
        """The same recording, for slices that overlap: up to so many bytes of it stay decoded."""
        kept = copy.copy(self)
        kept._keep_bytes, kept._kept = limit_bytes, OrderedDict()
        kept._file, kept._data = None, {}
        return kept

    @property
    def has_polarity(self) -> bool:
        """False where every stored polarity is 0: the sensor did not say, and slices have p = 0.

        Unless the file says that all of them are darker, as `write_events` has it; where some are
        held out that is not asked, as it depends on them.
        """
        if self._has_polarity is None:
            blocks = [
                (start, min(start + _POLARITY_BLOCK, last))
                for first, last in self._readable_rows
                for start in range(first, last, _POLARITY_BLOCK)
            ]
            self._has_polarity = (
                not blocks
                or self._has_only_darker()
                or any(bool(self._read("events/p", *block).any()) for block in blocks)
            )
        return self._has_polarity

    def between(self, start_us: int, end_us: int) -> EventStream:
        """Events with ``start_us <= t < end_us``, read from disk where they are not kept.

        Only the milliseconds that the window touches are read, or the blocks of what is kept.
        Raises `DataError` where what was read is out of order or outside of the sensor, so that a
        bad file is never used silently, and `HeldOutError` where the window reaches into a held-out
        interval.
        """
        self._check_readable(start_us, end_us)
        self._open()  # the shift stands in the file
        start, end = start_us - self._shift_us, end_us - self._shift_us
        if not self._keep_bytes:
            return self._decoded(*self._times_around(start, max(start, end)), start_us, end_us)
        first = self._checked_index_at_ms(start // 1000)
        last = self._checked_index_at_ms(-(-max(start, end) // 1000))
        blocks = (self._block(*rows) for rows in self._block_rows(first, last))
        parts = [block.between(start_us, end_us) for block in blocks]
        ends = [(a.t[-1], b.t[0]) for a, b in pairwise(part for part in parts if len(part))]
        if any(before > after for before, after in ends):
            raise DataError(
                f"{self.path}: events/t is not ascending between rows {first} and {last}; sort the "
                "events by t and rebuild ms_to_idx."
            )
        return parts[0] if len(parts) == 1 else EventStream.joined(parts)

    def _block_rows(self, first: int, last: int) -> Iterator[tuple[int, int]]:
        """Rows of the blocks that hold readable ones of [first, last)."""
        for low, high in self._readable_rows:
            start, end = max(first, low), min(last, high)
            if start >= end:
                continue
            for row in range(start - (start - low) % _KEPT_BLOCK, end, _KEPT_BLOCK):
                yield row, min(row + _KEPT_BLOCK, high)

    def _block(self, first: int, last: int) -> EventStream:
        if first not in self._kept:
            t = self._read("events/t", first, last).astype(np.int64)
            self._kept[first] = self._decoded(first, t, *ALWAYS)
            most = max(1, self._keep_bytes // (_KEPT_BLOCK * _EVENT_BYTES))
            while len(self._kept) > most:
                self._kept.popitem(last=False)
        self._kept.move_to_end(first)
        return self._kept[first]

    def _decoded(self, first: int, t: np.ndarray, start_us: int, end_us: int) -> EventStream:
        """The events within two times, of the rows from ``first`` on whose times are ``t``."""
        if len(t) and (np.diff(t) < 0).any():
            index = first + int(np.argmax(np.diff(t) < 0)) + 1
            raise DataError(
                f"{self.path}: events/t[{index}] is earlier than the event before it, expected "
                "ascending times; sort the events by t and rebuild ms_to_idx."
            )
        start, end = start_us - self._shift_us, end_us - self._shift_us
        low, high = np.searchsorted(t, [start, end], side="left")
        high = max(low, high)
        x, y, p = (self._read(f"events/{name}", first + low, first + high) for name in "xyp")
        self._check(x, y, p, first + low)
        signs = np.where(p > 0, np.int8(1), np.int8(-1)) if self.has_polarity else 0 * p
        pixels = x.astype(np.uint16), y.astype(np.uint16)
        stream = EventStream(t[low:high] + self._shift_us, *pixels, signs.astype(np.int8))
        return stream if self._pixel_lookup is None else self._undistort(stream)

    def rate(self, bins: int) -> tuple[Int64[np.ndarray, "bins+1"], Float[np.ndarray, "bins"]]:
        """Edges in camera microseconds and events per second between them, over the recording.

        Edges lie on whole milliseconds of the file's clock, so that only the index is read;
        recordings shorter than ``bins`` milliseconds get fewer bins. Raises `HeldOutError` where
        anything is held out.
        """
        self._check_readable(*self.time_range_us)
        start, end = (time - self._shift_us for time in self.time_range_us)
        first_ms, last_ms = start // 1000, max(start // 1000 + 1, -(-end // 1000))
        edges_ms = np.unique(np.linspace(first_ms, last_ms, bins + 1).round().astype(np.int64))
        indices = np.array([self._index_at_ms(int(ms)) for ms in edges_ms])
        per_second = np.diff(indices) / (np.diff(edges_ms) / 1000.0)
        return edges_ms * 1000 + self._shift_us, per_second

    def counts(self, spans_us: Int64[np.ndarray, "N 2"]) -> Int64[np.ndarray, "N"]:
        """Readable events of the milliseconds that each span touches, by the index alone.

        It is read in pieces. Raises `HeldOutError` where a span reaches into a held-out interval.
        """
        starts, ends = np.array(self._readable_us, np.int64).T
        stretch = np.searchsorted(starts, spans_us[:, 0], side="right") - 1
        hidden = (stretch < 0) | (spans_us[:, 1] > ends[stretch])
        if hidden.any():
            start, end = spans_us[int(np.argmax(hidden))].tolist()
            self._check_readable(start, end)
        self._open()  # the shift stands in the file
        first_ms = (spans_us[:, 0] - self._shift_us) // 1000
        last_ms = -((self._shift_us - spans_us[:, 1]) // 1000)
        # A millisecond at the end of a stretch is held out in part.
        low, high = np.array(self._readable_rows, np.int64)[stretch].T
        rows = self._indices_at_ms(np.concatenate([first_ms, last_ms]))
        first, last = (np.clip(part, low, high) for part in np.split(rows, 2))
        return last - first

    def close(self) -> None:
        """Close the file; the next read opens it again."""
        if self._file is not None and self._owner_pid == os.getpid():
            self._file.close()
        self._file, self._data = None, {}

    def _open(self) -> dict[str, h5py.Dataset]:
        if self._file is None or self._owner_pid != os.getpid():
            file = open_hdf5(self.path, rdcc_nbytes=_CHUNK_CACHE_BYTES)
            data = self._checked_layout(file)
            self._shift_us = self.clock_offset_us + int(data["t_offset"][()])
            self._file, self._data, self._owner_pid = file, data, os.getpid()
        return self._data

    def _checked_layout(self, file: h5py.File) -> dict[str, h5py.Dataset]:
        found = {name: data_set(file, name) for name in (*_COLUMNS, "ms_to_idx", "t_offset")}
        wrong = [
            name
            for name, data in found.items()
            if data.dtype.kind not in "iu" or data.ndim != (name != "t_offset")
        ]
        if wrong:
            data = found[wrong[0]]
            raise DataError(
                f"{self.path}: {wrong[0]} has shape {data.shape} of {data.dtype}, expected whole "
                "numbers, a column of them or, for t_offset, one; write the file anew."
            )
        lengths = {name: len(found[name]) for name in _COLUMNS}
        if len(set(lengths.values())) > 1:
            raise DataError(
                f"{self.path}: its columns differ in length ({lengths}), expected one number per "
                "event in each; write the file anew."
            )
        return found

    @functools.cached_property
    def _readable_rows(self) -> list[tuple[int, int]]:
        """First row and one past the last of each readable stretch, of the file's columns."""
        if self._readable_us == (ALWAYS,):
            return [(0, int(self._open()["events/t"].shape[0]))]
        return [(self._row_at(start), self._row_at(end)) for start, end in self._readable_us]

    def _row_at(self, time_us: int) -> int:
        """Row of the first event at or after a time."""
        self._open()
        time = time_us - self._shift_us
        first = self._index_at_ms(time // 1000)
        near = self._read("events/t", first, self._index_at_ms(-(-time // 1000)))
        return first + int(np.searchsorted(near, time))

    def _readable_from(self, time_us: int) -> Span | None:
        """The last readable stretch that begins at or before a time."""
        after = bisect_right(self._readable_us, time_us, key=lambda span: span[0])
        return self._readable_us[after - 1] if after else None

    def _check_readable(self, start_us: int, end_us: int) -> None:
        if start_us >= end_us:
            return
        span = self._readable_from(start_us)
        if span is None or end_us > span[1]:
            raise HeldOutError(
                f"{self.path}: events from {start_us} to {end_us} us lie in a held-out interval, "
                f"at least in part{_HIDDEN}"
            )

    def _index_at_ms(self, millisecond: int) -> int:
        """Index of the first event at or after a millisecond of the file's clock."""
        data = self._open()
        count = int(data["events/t"].shape[0])
        if millisecond < 0:  # of which the index has no entries
            before_zero = range(self._index_at_ms(0))
            return bisect_left(before_zero, 1000 * millisecond, key=self._time_of)
        if millisecond >= data["ms_to_idx"].shape[0]:
            return count
        row = int(self._read("ms_to_idx", millisecond, millisecond + 1)[0])
        if not 0 <= row <= count:
            raise self._wrong_index(millisecond)
        return row

    def _indices_at_ms(self, milliseconds: Int64[np.ndarray, "M"]) -> Int64[np.ndarray, "M"]:
        """`_index_at_ms` of many."""
        data = self._open()
        count, length = int(data["events/t"].shape[0]), int(data["ms_to_idx"].shape[0])
        rows = np.full(len(milliseconds), count)
        for at in np.flatnonzero(milliseconds < 0):
            rows[at] = self._index_at_ms(int(milliseconds[at]))
        for piece in range(0, length, INDEX_PIECE):
            within = (milliseconds >= piece) & (milliseconds < min(piece + INDEX_PIECE, length))
            if within.any():
                first, last = int(milliseconds[within].min()), int(milliseconds[within].max())
                read = self._read("ms_to_idx", first, last + 1)
                rows[within] = read[milliseconds[within] - first]
        wrong = (rows < 0) | (rows > count)
        if wrong.any():
            raise self._wrong_index(int(milliseconds[int(np.argmax(wrong))]))
        return rows

    def _checked_index_at_ms(self, millisecond: int) -> int:
        """`_index_at_ms`, compared with the times of the event there and the one before, once."""
        if millisecond not in self._checked_rows:
            row = self._index_at_ms(millisecond)
            t = self._read("events/t", max(row - 1, 0), row + 1)
            before = min(row, 1)
            if (t[:before] >= 1000 * millisecond).any() or (t[before:] < 1000 * millisecond).any():
                raise self._wrong_index(millisecond)
            if len(self._checked_rows) >= _CHECKED_ROWS:
                self._checked_rows.clear()
            self._checked_rows[millisecond] = row
        return self._checked_rows[millisecond]

    def _times_around(self, start: int, end: int) -> tuple[int, np.ndarray]:
        """Times of the milliseconds from ``start`` to ``end``, and the row of the first of them.

        With the event before and the one after: they show whether the index leads where it should.
        """
        first_ms, last_ms = start // 1000, -(-end // 1000)
        first, last = self._index_at_ms(first_ms), self._index_at_ms(last_ms)
        if last < first:
            raise self._wrong_index(last_ms)
        row = max(first - 1, 0)
        t = self._read("events/t", row, last + 1).astype(np.int64)
        if first > 0 and t[0] >= 1000 * first_ms:
            raise self._wrong_index(first_ms)
        if len(t) > last - row and t[-1] < 1000 * last_ms:
            raise self._wrong_index(last_ms)
        return row, t

    def _wrong_index(self, millisecond: int) -> DataError:
        return DataError(
            f"{self.path}: ms_to_idx[{millisecond}] is not the first event with t >= "
            f"{1000 * millisecond}; rebuild ms_to_idx, or write the recording anew with evsplat "
            "convert."
        )

    def _time_of(self, row: int) -> int:
        return int(self._read("events/t", row, row + 1)[0])

    def _read(self, key: str, first: int, last: int) -> np.ndarray:
        with broken_as(self.path, f"{key}[{first}:{last}] cannot be read", "copy the file again"):
            return self._open()[key][first:last]

    def _has_only_darker(self) -> bool:
        if self._readable_us != (ALWAYS,):
            return False
        self._open()
        assert self._file is not None
        with broken_as(self.path, "its attributes cannot be read", "copy the file again"):
            return has_only_darker(self._file)

    def _check(self, x: np.ndarray, y: np.ndarray, p: np.ndarray, first: int) -> None:
        neither = (p != 0) & (p != 1)
        if neither.any():
            at = int(np.argmax(neither))
            raise DataError(
                f"{self.path}: event {first + at} has polarity {p[at]}, expected 0 (darker) or 1 "
                "(brighter); convert the polarities."
            )
        outside = (x < 0) | (x >= self.width) | (y < 0) | (y >= self.height)
        if outside.any():
            at = int(np.argmax(outside))
            raise DataError(
                f"{self.path}: event {first + at} is at x={x[at]}, y={y[at]}, expected x < "
                f"{self.width} and y < {self.height}; correct events.width and events.height in "
                "capture.json or remove the event."
            )

    def _undistort(self, stream: EventStream) -> EventStream:
        assert self._pixel_lookup is not None
        x, y = self._pixel_lookup[stream.y, stream.x].T
        keep = x >= 0
        return EventStream(stream.t, x.astype(np.uint16), y.astype(np.uint16), stream.p).take(keep)
