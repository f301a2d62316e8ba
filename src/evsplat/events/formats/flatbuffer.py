"""The few parts of FlatBuffers that AEDAT4 uses, read with every offset checked.

Layout: https://flatbuffers.dev/internals/. The official package trusts its offsets, which a damaged
file cannot be read with.
"""

import struct


class FlatbufferError(ValueError):
    """An offset leads outside of the buffer."""


class Table:
    """One table of a buffer; fields are numbered as in the schema."""

    def __init__(self, data: bytes, position: int) -> None:
        self._data = data
        self._position = position
        self._vtable = position - self._unpack("<i", position)
        self._vtable_size = self._unpack("<H", self._vtable)

    @classmethod
    def root(cls, data: bytes, start: int = 0) -> "Table":
        """The table that the buffer at ``start`` (after a size prefix) begins with."""
        if start + 4 > len(data):
            raise FlatbufferError("the buffer ends early")
        return cls(data, start + struct.unpack_from("<I", data, start)[0])

    def integer(self, index: int, code: str, default: int = 0) -> int:
        """A scalar field; ``code`` is that of `struct`, without byte order."""
        at = self._field(index)
        return default if at is None else self._unpack(f"<{code}", at)

    def vector(self, index: int, item_bytes: int) -> memoryview:
        """The bytes of a vector (or string, ``item_bytes=1``); empty where the field is absent."""
        at = self._field(index)
        if at is None:
            return memoryview(b"")
        start = at + self._unpack("<I", at)
        size = self._unpack("<I", start) * item_bytes
        if start + 4 + size > len(self._data):
            raise FlatbufferError(f"a vector of {size} bytes does not fit in the buffer")
        return memoryview(self._data)[start + 4 : start + 4 + size]

    def _field(self, index: int) -> int | None:
        slot = 4 + 2 * index
        if slot + 2 > self._vtable_size:
            return None
        offset = self._unpack("<H", self._vtable + slot)
        return self._position + offset if offset else None

    def _unpack(self, code: str, position: int) -> int:
        if position < 0 or position + struct.calcsize(code) > len(self._data):
            raise FlatbufferError(f"an offset leads to byte {position} of {len(self._data)}")
        return struct.unpack_from(code, self._data, position)[0]
