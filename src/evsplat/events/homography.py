"""Events moved into the pixels of pictures, by a homography between the two cameras."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float

from evsplat.errors import ConfigError, DataError
from evsplat.events.recording import SIZE_UNKNOWN, EventRecording
from evsplat.events.stream import EventStream
from evsplat.files import write_text
from evsplat.untrusted.arrays import read_plain_arrays, read_table

Homography = Float[np.ndarray, "3 3"]
"""Takes (x, y, 1) of an event to (w x', w y', w) in the pictures; the centre of the first pixel is
(0, 0) in both, as in OpenCV."""

_EXPECTED = "3 lines of 3 numbers, the homography from the events' pixels to the pictures'"
_PIXELS = 1_000.0
"""Sensors are about as wide: by it numbers for pixels are compared with those without a unit."""
_LEAST = 1e-9
"""Of the largest singular value, what the least is at least; rounding alone leaves 1e-16."""


def moved(
    pieces: Iterable[EventStream], homography: Homography, width: int, height: int
) -> Iterator[EventStream]:
    """Events at the nearest pixels of the pictures; those that fall outside are left out.

    Args:
        pieces: Consecutive pieces of a recording, such as `EventRecording.chunks`; each is moved as
            it comes, so that memory does not grow. Of a piece that falls outside nothing comes.
        homography: (3, 3), from the events' pixels to the pictures', as ``cv2.findHomography(
            in_events, in_pictures)`` gives it: the first pixel's centre is (0, 0) in both.
        width: Columns of the pictures.
        height: Rows of the pictures.

    Raises:
        ConfigError: ``homography`` is not 3 x 3, not finite or singular.
    """
    homography = np.asarray(homography, np.float64)
    fault = _fault(homography)
    if fault:
        raise ConfigError(f"homography: found {fault}, expected {_EXPECTED}.")
    each = (_moved(piece, homography, width, height) for piece in pieces)
    return (piece for piece in each if len(piece))


def _moved(piece: EventStream, homography: Homography, width: int, height: int) -> EventStream:
    # where w is 0 a place is infinitely far, and as such outside
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        x, y, w = homography @ np.stack([piece.x, piece.y, np.ones(len(piece))])
        x, y = np.rint(x / w), np.rint(y / w)
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    columns, rows = (values[inside].astype(np.uint16) for values in (x, y))
    return EventStream(piece.t[inside], columns, rows, piece.p[inside])


def _fault(homography: np.ndarray) -> str:
    """What keeps an array from being a homography; empty where nothing does."""
    if homography.shape != (3, 3):
        shape = " x ".join(map(str, homography.shape))
        return f"{shape} numbers" if homography.size else "no numbers"
    if not np.isfinite(homography).all():
        return "numbers that are not finite"
    sizes = np.array([_PIXELS, _PIXELS, 1.0])
    alike = homography / max(np.abs(homography).max(), 1e-300) * sizes / sizes[:, None]
    values = np.linalg.svd(alike, compute_uv=False)
    if values[-1] <= _LEAST * values[0]:
        return "a singular matrix, by which all events fall onto a line"
    return ""


def read_homography(path: Path | str) -> Homography:
    """The homography in a text of 3 lines of 3 numbers (`numpy.savetxt`), or in a .npy.

    Raises:
        DataError: The file is missing or holds something else.
    """
    path = Path(path)
    if path.suffix == ".npy":
        found = read_plain_arrays(path).get("", np.zeros(0))
        fault = "" if found.dtype.kind in "iuf" else f"an array of {found.dtype}"
    else:
        try:
            found, fault = read_table(path, rows=4), ""
        except ValueError as error:
            found, fault = np.zeros(0), f"something else ({error})"
    fault = fault or _fault(found)
    if fault:
        raise DataError(
            f"{path}: found {fault}, expected {_EXPECTED}; write what cv2.findHomography(in_events,"
            " in_pictures) gives by numpy.savetxt."
        )
    return found.astype(np.float64)


def write_homography(path: Path, homography: Homography, size: tuple[int, int]) -> None:
    """Write a text that `read_homography` gives back, to pictures of ``size``, width and height."""
    rows = [" ".join(map(repr, row)) for row in homography.tolist()]
    title = f"# from the events' pixels to those of pictures of {size[0]}x{size[1]}"
    write_text(path, "\n".join([title, *rows]) + "\n")


class Mover:
    """Moves events by a homography, and knows how many of a pass fell outside."""

    def __init__(self, file: Path, homography: Homography, size: tuple[int, int]) -> None:
        """``file`` is what holds it, ``size`` the width and height of the pictures."""
        self._file, self._size = file, size
        self._homography = homography
        self._events = self._inside = 0

    @classmethod
    def read(cls, file: Path, size: tuple[int, int]) -> "Mover":
        """By the homography in a file (`read_homography`)."""
        return cls(file, read_homography(file), size)

    def moved(self, pieces: Iterable[EventStream], path: Path) -> Iterator[EventStream]:
        """The pieces of the recording ``path`` as of `moved`, counted anew.

        Raises:
            DataError: At the end, where all events fall outside of the pictures.
        """
        self._events = self._inside = 0
        for piece in moved(self._counted(pieces), self._homography, *self._size):
            self._inside += len(piece)
            yield piece
        if self._events and not self._inside:
            raise DataError(
                f"{path}: by {self._file} all of its events fall outside of the pictures' "
                f"{self._size[0]}x{self._size[1]} pixels, expected a homography from the events' "
                "pixels to the pictures'; if it is the other way round, write its inverse."
            )

    def _counted(self, pieces: Iterable[EventStream]) -> Iterator[EventStream]:
        for piece in pieces:
            self._events += len(piece)
            yield piece

    def notes(self, recording: EventRecording) -> list[str]:
        """Those of the recording that still matter, and how many events of a pass fell outside."""
        known = [note for note in recording.notes if note != SIZE_UNKNOWN]
        width, height = self._size
        outside = self._events - self._inside
        told = "none of them fell outside"
        if outside:
            told = f"{outside / self._events:.1%} of them fell outside and were left out"
        return [
            *known,
            f"events were moved into {width}x{height} pixels by {self._file.name}; {told}",
        ]
