"""Pictures with times, and a folder of them, one file each."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import Int64

from evsplat.errors import DataError
from evsplat.names import natural_order
from evsplat.pictures.files import read_image
from evsplat.untrusted.pictures import image_size

_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")


@dataclass(frozen=True, eq=False)
class TimedPicture:
    """One picture of a recording."""

    name: str
    """Stem of the picture file, or the number in the video."""
    time_us: int
    pixels: np.ndarray
    """Pixels as stored, (H, W) or (H, W, 3), uint8 or uint16."""


class Footage(Protocol):
    """A recording whose times are known before its pictures are decoded."""

    path: Path
    width: int
    height: int
    times_us: Int64[np.ndarray, "N"]
    """Strictly ascending; footage without a clock of its own begins at 0."""

    def __iter__(self) -> Iterator[TimedPicture]:
        """Decode the pictures one after the other, as many as there are times."""
        ...


def times_of_rate(count: int, fps: float) -> Int64[np.ndarray, "count"]:
    """Whole microseconds of ``count`` pictures at a rate, the first at 0."""
    return np.round(np.arange(count) * 1e6 / fps).astype(np.int64)


class FolderFootage:
    """Pictures in the order of their names, numbers in names counting as numbers (`Footage`)."""

    def __init__(self, path: Path, fps: float) -> None:
        self.path = path
        self._files = sorted(
            (file for file in path.iterdir() if _is_picture(file)),
            key=lambda file: natural_order(file.name),
        )
        if not self._files:
            raise DataError(f"{path}: holds no picture; expected PNG, JPEG, WebP, BMP or TIFF.")
        by_name: dict[str, Path] = {}
        for file in self._files:
            other = by_name.setdefault(file.stem, file)
            if other is not file:
                raise DataError(
                    f"{file}: has the name of {other.name}, expected one picture of each name; "
                    "remove one, or rename it."
                )
        self.width, self.height = image_size(self._files[0])
        self.times_us = times_of_rate(len(self._files), fps)

    def __iter__(self) -> Iterator[TimedPicture]:
        """The pictures one after the other; a picture of another size is a `DataError`."""
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
