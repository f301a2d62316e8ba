"""Picture files, decoded by Pillow, and by FFmpeg where they hold 16 bits per colour."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import av
import numpy as np
from jaxtyping import UInt16
from PIL import ExifTags, Image, ImageOps

from evsplat.errors import DataError
from evsplat.untrusted.faults import BROKEN, ordinary_file, reason

# Pillow gives an EPS to a program that runs what it says, and knows others as rarely used.
_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "PPM", "WEBP", "GIF", "JPEG2000")
_OF_CAMERAS = ("JPEG", "MPO", "WEBP")
"""Their EXIF is looked at; of a PNG that would decode the pixels, and Pillow turns TIFF itself."""
_MOST_PIXELS = 100_000_000
_UNREADABLE = "cannot be decoded as a picture"
_SAVE_AGAIN = "save it again as PNG"

Value = TypeVar("Value")


def read_picture(
    path: Path,
    take: Callable[[Image.Image], Value],
    *,
    fault: str = _UNREADABLE,
    remedy: str = _SAVE_AGAIN,
) -> Value:
    """What ``take`` gives of the picture in a file; one that cannot be decoded is a `DataError`.

    Pixels are decoded as ``take`` asks for them, upright: turned as a camera's EXIF says.
    """
    ordinary_file(path)
    try:
        with Image.open(path, formats=_FORMATS) as image:
            pixels = image.width * image.height
            if pixels > _MOST_PIXELS:
                raise DataError(
                    f"{path}: {fault} ({image.width}x{image.height} pixels); make it smaller."
                )
            return take(_upright(image))
    except Image.DecompressionBombError as error:
        raise DataError(f"{path}: {fault} ({reason(error)}); make it smaller.") from error
    except BROKEN as error:
        raise DataError(f"{path}: {fault} ({reason(error)}); {remedy}.") from error


def _upright(image: Image.Image) -> Image.Image:
    # Turning decodes the pixels, even where nothing is to be turned.
    if image.format in _OF_CAMERAS and image.getexif().get(ExifTags.Base.Orientation, 1) != 1:
        ImageOps.exif_transpose(image, in_place=True)
    return image


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) from the header; the pixels are decoded only where they have to be turned."""
    return read_picture(path, lambda image: image.size, fault="not a readable picture")


def read_16_bit_colour(path: Path) -> UInt16[np.ndarray, "H W 3"]:
    """RGB of a picture with 16 bits each, which Pillow would cut to 8."""
    try:
        with av.open(f"file:{path}", options={"protocol_whitelist": "file"}) as container:
            return next(container.decode(video=0)).to_ndarray(format="rgb48le")
    except (*BROKEN, av.error.FFmpegError, StopIteration) as error:
        raise DataError(
            f"{path}: cannot be decoded as a 16-bit picture ({reason(error)}); {_SAVE_AGAIN}."
        ) from error
