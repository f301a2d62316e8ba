"""Encoding pictures as PNG, 8 or 16 bit, grey or RGB."""

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from PIL import Image

from evsplat.errors import DataError


def write_image(path: Path, pixels: np.ndarray, *, source: str = "") -> None:
    """Write (H, W) or (H, W, 3) as PNG: uint8 and uint16 as they are, the rest as 8 bit.

    Booleans and floats mean the range [0, 1], which floats may leave by no more than rounding.
    ``source`` is what errors call the picture, by default ``path``.
    """
    source = source or str(path)
    if pixels.ndim != 2 and not (pixels.ndim == 3 and pixels.shape[2] == 3):
        raise DataError(f"{source}: has shape {pixels.shape}, expected (H, W) or (H, W, 3).")
    if pixels.dtype.kind in "fb":
        pixels = _eight_bits(pixels, source)
    if pixels.dtype == np.uint16 and pixels.ndim == 3:
        path.write_bytes(_encode_16_bit_colour(pixels))
    elif pixels.dtype in (np.uint8, np.uint16):
        Image.fromarray(np.ascontiguousarray(pixels)).save(path)
    else:
        raise DataError(f"{source}: holds {pixels.dtype}, expected uint8, uint16 or floats.")


def _eight_bits(pixels: np.ndarray, source: str) -> np.ndarray:
    low, high = float(pixels.min()), float(pixels.max())
    if not (low >= -1e-3 and high <= 1 + 1e-3):
        raise DataError(f"{source}: has values in [{low:.4g}, {high:.4g}], expected [0, 1].")
    return (pixels.clip(0, 1) * 255 + 0.5).astype(np.uint8)


def _encode_16_bit_colour(pixels: np.ndarray) -> bytes:
    """PNG of (H, W, 3) uint16, which Pillow cannot write."""
    context = av.CodecContext.create("png", "w")
    assert isinstance(context, av.VideoCodecContext)
    context.height, context.width = pixels.shape[:2]
    context.pix_fmt, context.time_base = "rgb48be", Fraction(1)
    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb48le")
    packets = [*context.encode(frame.reformat(format="rgb48be")), *context.encode(None)]
    return b"".join(bytes(packet) for packet in packets)
