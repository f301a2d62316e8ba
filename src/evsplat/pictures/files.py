"""Picture files, 8 or 16 bit, grey or RGB: reading, a cache bounded in bytes, writing as PNG."""

import threading
import zlib
from collections import OrderedDict
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from PIL.TiffImagePlugin import BITSPERSAMPLE, TiffImageFile
from torch import Tensor

from evsplat.compiled import native
from evsplat.errors import DataError
from evsplat.files import atomic_path, open_output
from evsplat.untrusted.pictures import read_16_bit_colour, read_picture


def read_image(path: Path) -> np.ndarray:
    """The stored pixels: (H, W) or (H, W, 3), uint8 or uint16; transparency is dropped."""
    pixels = read_picture(path, lambda image: _pixels(path, image))
    return read_16_bit_colour(path) if pixels is None else pixels


def holds_16_bits(path: Path) -> bool:
    """Whether `read_image` gives uint16, by the header alone: no pixel is decoded."""
    return read_picture(path, _is_16_bit)


def read_opaque(path: Path) -> np.ndarray | None:
    """As `read_image`; None where the picture is transparent in places."""

    def looked_at(image: Image.Image) -> tuple[bool, np.ndarray | None]:
        pixels = _pixels(path, image)
        if not image.has_transparency_data:
            return False, pixels
        return bool(np.asarray(image.convert("RGBA"))[..., 3].min() < 255), pixels

    clear, pixels = read_picture(path, looked_at)
    if clear:
        return None
    return read_16_bit_colour(path) if pixels is None else pixels


def to_unit_range(pixels: np.ndarray) -> Float[Tensor, "..."]:
    """Float32 in [0, 1] of stored pixels; float pixels are taken to be in that range already."""
    if pixels.dtype == np.float32:
        return torch.from_numpy(pixels.copy(order="K"))
    planes = np.moveaxis(pixels, -1, 0) if pixels.ndim == 3 else pixels
    if native is not None and pixels.dtype == np.uint8 and planes.flags.c_contiguous:
        # Training asks at each step; NumPy would take one thread and two passes.
        shares = torch.empty(planes.shape)
        native.share_of_range(planes, shares, torch.get_num_threads())
        return shares.movedim(0, -1) if pixels.ndim == 3 else shares
    scale = float(np.iinfo(pixels.dtype).max)
    return torch.from_numpy(pixels.astype(np.float32) / np.float32(scale))


def planar(pixels: np.ndarray) -> np.ndarray:
    """The same (H, W) or (H, W, C) array, each channel in one piece of memory as in renders."""
    if pixels.ndim == 2:
        return pixels
    return np.moveaxis(np.ascontiguousarray(np.moveaxis(pixels, -1, 0)), 0, -1)


def to_rgb(image: Float[Tensor, "..."]) -> Float[Tensor, "H W 3"]:
    """Grey is replicated; RGB stays."""
    return image[..., None].repeat(1, 1, 3) if image.ndim == 2 else image


def to_grey(image: Float[Tensor, "..."]) -> Float[Tensor, "H W"]:
    """The mean of the channels; grey stays."""
    return image if image.ndim == 2 else image.mean(-1)


class ImageCache:
    """Least recently used pixel arrays, at most ``limit_bytes`` of them; safe between threads."""

    def __init__(self, limit_bytes: int) -> None:
        self.limit_bytes = limit_bytes
        self.bytes = 0
        self._arrays: OrderedDict[Any, np.ndarray] = OrderedDict()
        self._lock = threading.Lock()

    def __getstate__(self) -> dict[str, Any]:
        return {"limit_bytes": self.limit_bytes}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["limit_bytes"])  # type: ignore[misc]

    def get(self, key: Any, make: Callable[[], np.ndarray]) -> np.ndarray:
        """The array of ``key``, made and kept when absent; not to be written to."""
        with self._lock:
            if key in self._arrays:
                self._arrays.move_to_end(key)
                return self._arrays[key]
        array = make()
        with self._lock:
            if key not in self._arrays and array.nbytes <= self.limit_bytes:
                self._arrays[key] = array
                self.bytes += array.nbytes
                while self.bytes > self.limit_bytes:
                    self.bytes -= self._arrays.popitem(last=False)[1].nbytes
        return array


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
        with open_output(path) as file:
            file.write(_encode_16_bit_colour(pixels))
    elif pixels.dtype in (np.uint8, np.uint16):
        _save_png(path, pixels)
    else:
        raise DataError(f"{source}: holds {pixels.dtype}, expected uint8, uint16 or floats.")


def save_png(path: Path, picture: UInt8[np.ndarray, "H W 3"]) -> None:
    """Write a PNG, whole or not at all."""
    with atomic_path(path) as temporary:
        _save_png(temporary, picture)


def _save_png(path: Path, pixels: np.ndarray) -> None:
    # Of what the filters leave of a picture runs are all that is worth looking for: half of the
    # time of level 4 for as many bytes of a render, a quarter of level 6 for 2 % more of a frame.
    Image.fromarray(np.ascontiguousarray(pixels)).save(path, compress_type=zlib.Z_RLE)


def _pixels(path: Path, image: Image.Image) -> np.ndarray | None:
    """None for 16 bits per colour, which Pillow would cut to 8."""
    if image.mode == "I" and image.format == "PPM":  # of at most 16 bits, scaled to 0..65535
        return np.array(image).astype(np.uint16)
    if image.mode in ("I", "F"):  # Pillow would clip both at 255
        kind = "whole numbers of 32 bits" if image.mode == "I" else "floating-point numbers"
        raise DataError(
            f"{path}: its pixels are {kind}, whose range a file does not say, expected 8 or 16 "
            "bits; scale them to 0..65535 and save them as 16 bits."
        )
    if image.mode in ("RGB", "RGBA") and _has_16_bits(image):
        return None
    if image.mode in ("L", "RGB", "I;16"):
        return np.array(image)
    if image.mode == "I;16B":
        return np.array(image).astype(np.uint16)
    return np.array(image.convert("L" if image.mode in ("1", "LA") else "RGB"))


def _is_16_bit(image: Image.Image) -> bool:
    """Of a picture that `_pixels` takes."""
    if image.mode in ("RGB", "RGBA"):
        return _has_16_bits(image)
    return image.mode in ("I;16", "I;16B") or (image.mode == "I" and image.format == "PPM")


def _has_16_bits(image: Image.Image) -> bool:
    if image.format == "BMP":  # whose 16 bits are those of all three colours
        return False
    if isinstance(image, TiffImageFile):  # a packed one's tiles do not say it
        return max(image.tag_v2.get(BITSPERSAMPLE, (8,))) > 8
    packings = [tile[3] for tile in getattr(image, "tile", [])]
    if image.format == "PPM":  # its greatest value is said where it is not 255
        return any(isinstance(packed, tuple) and packed[-1] > 255 for packed in packings)
    return any("16" in str(one[0] if isinstance(one, tuple) else one) for one in packings)


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
