"""Streams of the words that event cameras write, decoded by the compiled module."""

from collections.abc import Iterator

import numpy as np

from evsplat.compiled import native_for
from evsplat.events.formats.base import BLOCK_EVENTS, ByteReader, Damage, RawEvents

_READ_BYTES = 1 << 20
# Fields of EventState in native/event_words.h
_STATE_FIELDS, _UNTIMED, _UNKNOWN, _UNKNOWN_AT = 10, 7, 8, 9


class WordDecoder:
    """Decodes one stream piece by piece; keeps what the words so far have said.

    ``kind``: "evt2", "evt21" (64-bit words), "evt21_swapped" (their 32-bit halves exchanged, as
    IMX636 cameras write), "evt3", "es_dvs" or "es_atis". Events before the first word with a time
    have none and are left out, as in Prophesee's own decoder.
    """

    def __init__(self, kind: str, damage: Damage) -> None:
        self._native = native_for(f"{damage.path}: reading {kind}")
        self._kind = kind
        self._damage = damage
        self._state = np.zeros(_STATE_FIELDS, dtype=np.int64)

    @property
    def untimed(self) -> int:
        """Events left out so far because no time came before them."""
        return int(self._state[_UNTIMED])

    def decode(self, data: bytes, offset: int) -> tuple[RawEvents, int]:
        """Events of the whole words at the beginning of ``data``, at most about `BLOCK_EVENTS`.

        Also the bytes taken. ``offset`` is where in the file ``data`` begins, for errors.
        """
        # room for one more word of 32 events at least; what does not fit waits for the next call
        capacity = min(BLOCK_EVENTS, 4 * len(data)) + 32
        t = np.empty(capacity, dtype=np.int64)
        x, y = np.empty(capacity, dtype=np.uint16), np.empty(capacity, dtype=np.uint16)
        p = np.empty(capacity, dtype=np.int8)
        view = np.frombuffer(data, dtype=np.uint8)
        taken, count = self._native.decode_events(self._kind, view, self._state, t, x, y, p)
        unknown = int(self._state[_UNKNOWN])
        if unknown:
            self._damage.found(
                f"{unknown} words among bytes {offset} to {offset + taken - 1} are of no type that "
                f"{self._kind.upper()} has, the first at byte {offset + self._state[_UNKNOWN_AT]}",
                repaired_by="leaves out words of unknown type",
                count=unknown,
            )
            self._state[_UNKNOWN] = 0
        return RawEvents(t[:count], x[:count], y[:count], p[:count]), taken

    def blocks(self, reader: ByteReader) -> Iterator[RawEvents]:
        """All events from where the reader stands to the end of the file."""
        rest = b""
        while data := reader.read(_READ_BYTES):
            data = rest + data if rest else data
            start = 0
            while start < len(data):
                piece = data[start:] if start else data
                events, taken = self.decode(piece, reader.offset - len(piece))
                if not taken:
                    break
                start += taken
                yield events
            rest = data[start:]
        if rest:
            self._damage.found(
                f"ends in the middle of a word, {len(rest)} bytes after byte "
                f"{reader.offset - len(rest)}",
                repaired_by="keeps the words before the cut",
            )
