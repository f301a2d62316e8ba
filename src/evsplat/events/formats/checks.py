"""Raw blocks become event streams: sorted, on the sensor, of known polarity, or a clear error."""

from collections.abc import Iterable, Iterator

import numpy as np

from evsplat.errors import DataError
from evsplat.events.formats.base import SAY_UNIT, Damage, RawEvents, parts_said
from evsplat.events.formats.order import Block, ascending, in_order
from evsplat.events.stream import EventStream

_MAX_GAP_AT_WRAP_US = 60_000_000
# Where a counter ends and where it begins again: unsigned and signed 32 bits, 31 bits
_COUNTER_RANGES_US = ((1 << 32, 0), (1 << 31, -(1 << 31)), (1 << 31, 0))
_LEAST_RISE_TO_TOP_US = (1 << 31) - 2 * _MAX_GAP_AT_WRAP_US
_MIN_BLOCK_EVENTS = 1 << 16
_MAX_TIME_US = 1 << 60
_LONGEST_US = 24 * 3600 * 1_000_000
_SILENCE_US = 10_000_000
"""Longer times without an event are remarked: sensors have noise, where no filter takes it."""
_MOST_PER_US, _MANY = 1_000, 1_000
"""More events in a microsecond than any sensor sends, and of how many that is asked."""


def checked(
    blocks: Iterable[RawEvents],
    damage: Damage,
    width: int | None,
    height: int | None,
    has_polarity: bool,
    *,
    first: int,
) -> Iterator[EventStream]:
    """Streams that follow each other in time, as `EventStream` promises.

    ``first`` is the number of the first event in its file.

    With ``damage.repair``: times of a counter that wrapped go on rising, disorder within about one
    block is sorted and events later than that, events beside the sensor and events without
    polarity among others that have one are left out. Otherwise the first of these is a `DataError`.
    """
    settled = _Settled(blocks, damage, width, height, has_polarity, first)
    ordered = in_order(settled, damage) if damage.repair else ascending(settled, damage)
    return _within_a_day(ordered, damage)


def _within_a_day(streams: Iterable[EventStream], damage: Damage) -> Iterator[EventStream]:
    """The streams; a `DataError` where one wild time would make an index of years.

    The other way round, seconds that were read as microseconds are remarked.
    """
    first_us: int | None = None
    last_us, count = 0, 0
    for stream in streams:
        if len(stream):
            first_us = int(stream.t[0]) if first_us is None else first_us
            last_us, count = int(stream.t[-1]), count + len(stream)
            if last_us - first_us > _LONGEST_US:
                raise DataError(
                    f"{damage.path}: has events from {first_us} to {last_us} us, expected a "
                    "recording of at most a day; leave out what has a wrong time, or give the unit "
                    f"of a table with {SAY_UNIT}."
                )
        yield stream
    if first_us is not None and count > max(_MANY, _MOST_PER_US * (last_us - first_us)):
        damage.warnings["rate"] = (
            f"{count:,} events come within {last_us - first_us:,} us, more than any sensor sends; "
            f"give the unit of their times with {SAY_UNIT}"
        )


class _Settled:
    """Blocks with pixels, polarity and wrapped times settled; knows the index of each event."""

    def __init__(
        self,
        blocks: Iterable[RawEvents],
        damage: Damage,
        width: int | None,
        height: int | None,
        has_polarity: bool,
        first: int,
    ) -> None:
        self._blocks = blocks
        self._first = first
        self._damage = damage
        # x and y are kept in 16 bits
        self._limits = (width or 1 << 16, height or 1 << 16)
        self._has_polarity = has_polarity
        self._seen_zero = self._seen_negative = self._zeros_as_darker = False
        self._shift_us = self._most_shift_us = 0
        self._last_raw_us: int | None = None
        self._latest_us: int | None = None
        self._longest_us = _SILENCE_US

    def __iter__(self) -> Iterator[Block]:
        index = self._first
        for block in _gathered(self._blocks):
            t, rising = self._unwrapped(block.t.astype(np.int64, copy=False), index)
            self._remark_silence(t, rising, index)
            p, keep = self._polarity(block.p, index)
            keep = self._on_sensor(block.x, block.y, keep, index)
            x, y = block.x, block.y
            if keep is not None:
                t, x, y, p = t[keep], x[keep], y[keep], p[keep]
            x, y = x.astype(np.uint16, copy=False), y.astype(np.uint16, copy=False)
            yield Block(index, EventStream(t, x, y, p), rising)
            index += len(block.t)

    def _unwrapped(self, t: np.ndarray, index: int) -> tuple[np.ndarray, bool]:
        """Times that go on where a counter began again (repair), and whether they are in order."""
        before = int(t[0]) if self._last_raw_us is None else self._last_raw_us
        self._last_raw_us = int(t[-1])
        rising = t[0] >= before and not (t[1:] < t[:-1]).any()
        low, high = (int(t[0]), int(t[-1])) if rising else (int(t.min()), int(t.max()))
        if low < -_MAX_TIME_US or high > _MAX_TIME_US:
            raise DataError(
                f"{self._damage.path}: events {index} to {index + len(t) - 1} have times from "
                f"{low} to {high} us; no recording is that long, check the "
                f"file, or give the unit of a table with {SAY_UNIT}."
            )
        if rising and not self._shift_us:
            return t, True
        if rising and high - before < _LEAST_RISE_TO_TOP_US:
            return t + self._shift_us, True
        shifts = np.zeros(len(t), dtype=np.int64)
        previous = np.concatenate([[before], t[:-1]])
        for top, bottom in _COUNTER_RANGES_US:
            shifts[_at_end(previous, top) & _at_begin(t, bottom)] = top - bottom
            # an event from before the counter began again, which came after others that are not
            shifts[_at_begin(previous, bottom) & _at_end(t, top)] = bottom - top
        shift_us = self._shift_us
        for at in np.flatnonzero(shifts):
            if shift_us + shifts[at] < 0:
                shifts[at] = 0  # the counter did not begin again yet
            shift_us += int(shifts[at])
            if shift_us > self._most_shift_us:
                self._most_shift_us = shift_us
                self._damage.found(
                    f"the time falls from {previous[at]} to {t[at]} us at event {index + at}: its "
                    f"{int(shifts[at]).bit_length() - 1}-bit counter began again",
                    repaired_by="adds up the periods of a counter that began again",
                )
        shifts = np.cumsum(shifts) + self._shift_us
        self._shift_us = shift_us
        return t + shifts, False

    def _remark_silence(self, t: np.ndarray, rising: bool, index: int) -> None:
        """Warn of the longest time without an event, as between two recordings in a file."""
        before = int(t[0]) if self._latest_us is None else self._latest_us
        self._latest_us = max(before, int(t[-1] if rising else t.max()))
        if self._latest_us - before <= self._longest_us:
            return
        latest = np.maximum.accumulate(np.concatenate([[before], t]))
        silent = np.diff(latest)
        at = int(silent.argmax())
        if silent[at] > self._longest_us:
            self._longest_us = int(silent[at])
            self._damage.warnings["silence"] = (
                f"no event comes for {1e-6 * self._longest_us:,.1f} s before event {index + at} at "
                f"{t[at]} us; unless nothing moved meanwhile, two recordings are in this file: "
                + parts_said(self._damage.path, index + at)
            )

    def _polarity(self, p: np.ndarray, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Polarity +1/-1 (all 0 where there is none), and which events to keep (None: all)."""
        if not self._has_polarity:
            return np.zeros(len(p), dtype=np.int8), None
        if p.dtype == np.bool_ or p.dtype.kind == "u":
            return _signs(p != 0), None
        positive, negative = p > 0, p < 0
        zeros = len(p) - int(positive.sum()) - int(negative.sum())
        self._seen_negative |= bool(negative.any())
        self._seen_zero |= bool(zeros)
        if not (self._seen_negative and self._seen_zero):
            self._zeros_as_darker = self._seen_zero
            return _signs(positive), None
        if self._zeros_as_darker:
            raise DataError(
                f"{self._damage.path}: polarity is 0 before event {index} and -1 after it; say "
                "which events have none, or leave the polarity out."
            )
        self._damage.found(
            f"{zeros or int(negative.sum())} of events {index} to {index + len(p) - 1} have "
            f"polarity {0 if zeros else -1} although others have {-1 if zeros else 0}",
            repaired_by="leaves out events of polarity 0 where others have -1",
            count=zeros,
        )
        return _signs(positive), positive | negative

    def _on_sensor(
        self, x: np.ndarray, y: np.ndarray, keep: np.ndarray | None, index: int
    ) -> np.ndarray | None:
        width, height = self._limits
        if x.min() >= 0 and y.min() >= 0 and x.max() < width and y.max() < height:
            return keep
        outside = (x < 0) | (y < 0) | (x >= width) | (y >= height)
        at = int(np.argmax(outside))
        count = int(outside.sum())
        self._damage.found(
            f"event {index + at} is at x={x[at]}, y={y[at]}, expected x < {width} and y < {height} "
            f"({count} such events among {index} to {index + len(x) - 1})",
            repaired_by="leaves out events beside the sensor",
            count=count,
        )
        return ~outside if keep is None else keep & ~outside


def _at_end(t: np.ndarray, top: int) -> np.ndarray:
    """Whether times may be the last ones before a counter that ends at ``top`` begins again."""
    return (t < top) & (t >= top - _MAX_GAP_AT_WRAP_US)


def _at_begin(t: np.ndarray, bottom: int) -> np.ndarray:
    """Whether times may be the first ones after a counter began again at ``bottom``."""
    return (t >= bottom) & (t < bottom + _MAX_GAP_AT_WRAP_US)


def _signs(positive: np.ndarray) -> np.ndarray:
    return positive.view(np.int8) * np.int8(2) - np.int8(1)


def _gathered(blocks: Iterable[RawEvents]) -> Iterator[RawEvents]:
    """Small blocks put together: what follows costs as much for ten events as for thousands."""
    waiting: list[RawEvents] = []
    count = 0
    for block in blocks:
        if len(block.t):
            waiting.append(block)
            count += len(block.t)
        if count >= _MIN_BLOCK_EVENTS:
            yield _joined(waiting)
            waiting, count = [], 0
    if waiting:
        yield _joined(waiting)


def _joined(blocks: list[RawEvents]) -> RawEvents:
    if len(blocks) == 1:
        return blocks[0]
    return RawEvents(*(np.concatenate(column) for column in zip(*blocks, strict=True)))
