"""Sizes that files announce, compared with the bytes that are there before memory is taken."""

import bz2
import gzip
import io
import lzma
import math
import operator
import zipfile
import zlib
from collections.abc import Iterable
from typing import IO, Any

import numpy as np

_FREE_BYTES = 1 << 29
"""What may be unpacked from however little; empty masks pack very well."""
_MOST_PER_BYTE = 200
"""Bytes unpacked per byte of a larger file: recordings and poses stay below 20."""
_LAST_CHARACTER = 0x10FFFF
_BLOCK_BYTES = 1 << 20


def count_of(shape: Iterable[Any]) -> int:
    """How many values an array has; exact, where NumPy's product of a forged shape overflows."""
    lengths = [operator.index(length) for length in shape]
    if any(length < 0 for length in lengths):
        raise ValueError(f"an array of shape {tuple(lengths)}")
    return math.prod(lengths)


def sound_text(array: np.ndarray) -> np.ndarray:
    """The array; a `ValueError` where its texts hold numbers that stand for no character."""
    for name in array.dtype.names or ():
        sound_text(array[name])
    if array.dtype.kind == "U" and array.nbytes:
        codes = np.ascontiguousarray(array).reshape(-1).view(f"{array.dtype.byteorder}u4")
        if codes.max() > _LAST_CHARACTER:
            raise ValueError("texts that hold no characters")
    return array


def check_unpacked(unpacked: int, packed: int) -> None:
    """A `ValueError` for more bytes than ``packed`` ones stand for in any sound file."""
    if unpacked > max(_FREE_BYTES, _MOST_PER_BYTE * packed):
        raise ValueError(f"{packed} bytes that unpack to {unpacked}")


def open_zip(file: IO[bytes] | str) -> zipfile.ZipFile:
    """An archive whose members together unpack to a plausible size."""
    archive = zipfile.ZipFile(file)
    members = archive.infolist()
    check_unpacked(sum(m.file_size for m in members), sum(m.compress_size for m in members))
    return archive


def unpacked(data: bytes) -> bytes:
    """``data``, or what was packed in it by gzip, bzip2, xz or zlib."""
    stream: gzip.GzipFile | bz2.BZ2File | lzma.LZMAFile
    if data.startswith(b"\x1f\x8b"):
        stream = gzip.GzipFile(fileobj=io.BytesIO(data))
    elif data.startswith(b"BZ"):
        stream = bz2.BZ2File(io.BytesIO(data))
    elif data.startswith((b"\xfd7zXZ", b"\x5d\x00")):
        stream = lzma.LZMAFile(io.BytesIO(data))
    elif data.startswith(b"\x78"):
        most = max(_FREE_BYTES, _MOST_PER_BYTE * len(data))
        worker = zlib.decompressobj()
        content = worker.decompress(data, most)
        check_unpacked(len(content) + bool(worker.unconsumed_tail), len(data))
        if not worker.eof:
            raise EOFError("the end is missing")
        return content
    else:
        return data
    parts = bytearray()
    while block := stream.read(_BLOCK_BYTES):
        parts += block
        check_unpacked(len(parts), len(data))
    return bytes(parts)
