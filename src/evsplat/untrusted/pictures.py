"""Picture files, decoded by Pillow, and by FFmpeg where they hold 16 bits per colour."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import av
import numpy as np
from jaxtyping import UInt16
from PIL import ExifTags, Image, ImageOps
from PIL.TiffImagePlugin import TiffImageFile

from evsplat.errors import DataError
from evsplat.untrusted.faults import BROKEN, ordinary_file, reason

# Pillow gives an EPS to a program that runs what it says, and knows others as rarely used.
_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "PPM", "WEBP", "GIF", "JPEG2000")
_OF_CAMERAS = ("JPEG", "MPO", "WEBP")
"""Their EXIF is looked at; of a PNG that would decode the pixels, and Pillow turns TIFF itself."""
_TURNED: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    2: lambda stored: stored[:, ::-1],
    3: lambda stored: stored[::-1, ::-1],
    4: lambda stored: stored[::-1],
    5: lambda stored: stored.swapaxes(0, 1),
    6: lambda stored: np.rot90(stored, -1),
    7: lambda stored: np.rot90(stored.swapaxes(0, 1), 2),
    8: lambda stored: np.rot90(stored),
}
"""What makes a stored picture upright, by the orientation of EXIF and TIFF."""
_ON_ITS_SIDE = 5
"""Of orientations the first by which rows become columns."""
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
    if isinstance(image, TiffImageFile) and _tiff_orientation(image) >= _ON_ITS_SIDE:
        # Pillow 13 maps a bare grey one from its file with width and height exchanged.
        image.filename = ""
    return image


def _tiff_orientation(image: Image.Image) -> int:
    """That of a TIFF whose pixels are not decoded yet; 1, upright, of other files."""
    if not isinstance(image, TiffImageFile):
        return 1
    return int(image.tag_v2.get(ExifTags.Base.Orientation, 1))


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) from the header; the pixels are decoded only where they have to be turned."""
    return read_picture(path, lambda image: image.size, fault="not a readable picture")


def read_16_bit_colour(path: Path) -> UInt16[np.ndarray, "H W 3"]:
    """Upright RGB of a picture with 16 bits each, which Pillow would cut to 8."""
    turned = _TURNED.get(read_picture(path, _tiff_orientation))
    try:
        with av.open(f"file:{path}", options={"protocol_whitelist": "file"}) as container:
            pixels = next(container.decode(video=0)).to_ndarray(format="rgb48le")
            return pixels if turned is None else np.ascontiguousarray(turned(pixels))
    except (*BROKEN, av.error.FFmpegError, StopIteration) as error:
        raise DataError(
            f"{path}: cannot be decoded as a 16-bit picture ({reason(error)}); {_SAVE_AGAIN}."
        ) from error
