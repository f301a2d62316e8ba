"""The .spz of Niantic: quantised Gaussians, gzipped; 20 bytes each before compression."""

import gzip
import struct
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from evsplat.errors import DataError
from evsplat.export.cloud import SplatCloud
from evsplat.export.formats.ply import SH_C0
from evsplat.files import atomic_path

_MAGIC, _VERSION = 0x5053474E, 3
_COORDINATE_BITS = 24
_MOST_FRACTIONAL_BITS = 20
_COLOUR_SCALE = 0.15
_MAGNITUDE_BITS = 9


def write_spz(path: Path | str, cloud: SplatCloud) -> None:
    """Write version 3, SH degree 0; ``cloud`` must be in the format's axes (x right, y up, z back).

    Precision: centres by the finest power of two that holds all of them (1 micrometre where all lie
    within 8 metres of the origin), scales 3 %, rotations 0.2 degrees, opacity and colour 8 bits;
    colour from -0.44 to 1.44 of the sRGB range.
    """
    reach = float(np.abs(cloud.means).max(initial=0.0))
    bits = _fractional_bits(reach)
    if bits < 0:
        raise DataError(
            f"{path}: a Gaussian lies {reach:g} m from the origin; an .spz file holds coordinates "
            "up to 8388 km. Export the person alone with --parts human, or write a .ply."
        )
    f_dc = (cloud.rgb - 0.5) / SH_C0
    parts = (
        _fixed_point(cloud.means, bits),
        _bytes(cloud.opacities * 255),
        _bytes(f_dc * (_COLOUR_SCALE * 255) + 0.5 * 255),
        _bytes((np.log(cloud.scales) + 10) * 16),
        _smallest_three(cloud.quaternions),
    )
    header = struct.pack("<IIIBBBB", _MAGIC, _VERSION, len(cloud), 0, bits, 0, 0)
    content = header + b"".join(part.tobytes() for part in parts)
    with atomic_path(path) as temporary:
        temporary.write_bytes(gzip.compress(content, mtime=0))


def _fractional_bits(reach: float) -> int:
    """Bits behind the point of a signed 24-bit number that holds ``reach``."""
    largest = 2 ** (_COORDINATE_BITS - 1) - 1
    for bits in range(_MOST_FRACTIONAL_BITS, -1, -1):
        if reach * 2**bits <= largest:
            return bits
    return -1


def _fixed_point(values: Float32[np.ndarray, "N 3"], bits: int) -> UInt8[np.ndarray, "N 9"]:
    numbers = np.rint(values.astype(np.float64) * 2**bits).astype("<i4")
    return np.ascontiguousarray(numbers.view("u1").reshape(len(values), 3, 4)[..., :3])


def _smallest_three(quaternions: Float32[np.ndarray, "N 4"]) -> UInt8[np.ndarray, "N 4"]:
    """The three smaller of (x, y, z, w), 10 bits each (sign and magnitude), and which is missing.

    The largest is made positive, so that it follows from the others.
    """
    xyzw = quaternions[:, [1, 2, 3, 0]].astype(np.float64)
    largest = np.abs(xyzw).argmax(1)
    rows = np.arange(len(xyzw))
    xyzw = np.where(xyzw[rows, largest][:, None] < 0, -xyzw, xyzw)
    word = largest.astype(np.uint32)
    steps = 2**_MAGNITUDE_BITS - 1
    for axis in range(4):
        value = xyzw[:, axis]
        magnitude = np.floor(steps * np.abs(value) * np.sqrt(2) + 0.5).astype(np.uint32)
        stored = (value < 0).astype(np.uint32) << _MAGNITUDE_BITS | magnitude.clip(max=steps)
        word = np.where(largest == axis, word, word << (_MAGNITUDE_BITS + 1) | stored)
    return word.astype("<u4").view("u1").reshape(-1, 4)


def _bytes(values: np.ndarray) -> UInt8[np.ndarray, "..."]:
    return np.rint(values).clip(0, 255).astype(np.uint8)
