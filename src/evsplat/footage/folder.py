"""A folder of pictures, one file each."""

import re
from collections.abc import Iterator
from pathlib import Path

from evsplat.capture.images import image_size, read_image
from evsplat.errors import DataError
from evsplat.footage.footage import TimedPicture, times_of_rate

_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")


class FolderFootage:
    """Pictures in the order of their names, numbers in names counting as numbers (`Footage`)."""

    def __init__(self, path: Path, fps: float) -> None:
        self.path = path
        self._files = sorted(
            (file for file in path.iterdir() if _is_picture(file)), key=_natural_order
        )
        if not self._files:
            raise DataError(f"{path}: holds no picture; expected PNG, JPEG, WebP, BMP or TIFF.")
        self.width, self.height = image_size(self._files[0])
        self.times_us = times_of_rate(len(self._files), fps)

    def __iter__(self) -> Iterator[TimedPicture]:
        """See `Footage`; a picture of another size is a `DataError`."""
        for file, time_us in zip(self._files, self.times_us, strict=True):
            pixels = read_image(file)
            if pixels.shape[:2] != (self.height, self.width):
                raise DataError(
                    f"{file}: has {pixels.shape[1]}x{pixels.shape[0]} pixels, expected "
                    f"{self.width}x{self.height} as {self._files[0].name}."
                )
            yield TimedPicture(file.stem, int(time_us), pixels)


def _is_picture(file: Path) -> bool:
    return file.is_file() and file.suffix.lower() in _SUFFIXES and not file.name.startswith(".")


def _natural_order(file: Path) -> list[tuple[int, str]]:
    """Key by which frame9 comes before frame10."""
    parts = re.findall(r"\d+|\D+", file.name)
    return [(int(part), part) if part.isdecimal() else (-1, part) for part in parts]
