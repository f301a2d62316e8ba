"""What a video file and a folder of pictures have in common, and which of the two a path is."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import Int64

from evsplat.errors import ConfigError, DataError


@dataclass(frozen=True, eq=False)
class TimedPicture:
    """One picture of a recording."""

    name: str
    """Of the picture file, or its number in the video."""
    time_us: int
    pixels: np.ndarray
    """As stored, (H, W) or (H, W, 3), uint8 or uint16."""


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


def open_footage(path: Path | str, fps: float | None = None) -> Footage:
    """A video file, or a folder of equally large pictures in the order of their names.

    ``fps`` is the rate at which the pictures were taken. A folder needs it; for a video it replaces
    the file's own times (slow-motion files say how fast to play, not how fast they were shot).

    Raises:
        DataError: nothing there, or nothing that can be read.
        ConfigError: ``fps`` is missing for a folder or makes no sense.
    """
    from evsplat.footage.folder import FolderFootage
    from evsplat.footage.video import VideoFootage

    path = Path(path)
    if fps is not None and not 0 < fps <= 1e6:
        raise ConfigError(f"--source-fps {fps:g}: expected a rate above 0 and at most 1e6 Hz.")
    if path.is_dir():
        if fps is None:
            raise ConfigError(
                f"{path}: a folder of pictures has no times; give the rate at which they were "
                "taken with --source-fps."
            )
        return FolderFootage(path, fps)
    if not path.is_file():
        raise DataError(f"{path}: no such video file or folder of pictures.")
    return VideoFootage(path, fps)


def times_of_rate(count: int, fps: float) -> Int64[np.ndarray, "count"]:
    """Whole microseconds of ``count`` pictures at a rate, the first at 0."""
    return np.round(np.arange(count) * 1e6 / fps).astype(np.int64)
