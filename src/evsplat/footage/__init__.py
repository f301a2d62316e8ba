"""Ordinary footage: a video file or a folder of pictures, read as pictures with times."""

from pathlib import Path

from evsplat.errors import ConfigError, DataError
from evsplat.footage.pictures import FolderFootage, Footage, TimedPicture
from evsplat.footage.video import VideoFootage

__all__ = ["Footage", "TimedPicture", "open_footage"]


def open_footage(
    path: Path | str, fps: float | None = None, *, rate_option: str = "fps"
) -> Footage:
    """A video file, or a folder of equally large pictures in the order of their names.

    ``fps`` is the rate at which the pictures were taken. A folder needs it; for a video it replaces
    the file's own times (slow-motion files say how fast to play, not how fast they were shot).
    ``rate_option`` is what errors call it: the option by which the caller's user gives it.

    Raises:
        DataError: nothing there, or nothing that can be read.
        ConfigError: ``fps`` is missing for a folder or makes no sense.
    """
    path = Path(path)
    if fps is not None and not 0 < fps <= 1e6:
        raise ConfigError(f"{rate_option} {fps:g}: expected a rate above 0 and at most 1e6 Hz.")
    if path.is_dir():
        if fps is None:
            raise ConfigError(
                f"{path}: a folder of pictures has no times; give the rate at which they were "
                f"taken with {rate_option}."
            )
        return FolderFootage(path, fps)
    if not path.is_file():
        raise DataError(f"{path}: no such video file or folder of pictures.")
    return VideoFootage(path, fps, rate_option)
