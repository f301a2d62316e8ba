"""Ways in which events may be mirrored or turned beside the frames, in words and numbers."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Int

from evsplat.events.homography import Homography

Way = Int[np.ndarray, "2 2"]
"""Takes (x, y) from the middle of the events to (x, y) from the middle of the frames."""


def _way(*numbers: int) -> Way:
    return np.array(numbers).reshape(2, 2)


# Each is named by what would turn the events onto the frames.
UPRIGHT: Mapping[str, Way] = {
    "": _way(1, 0, 0, 1),
    "mirrored left to right": _way(-1, 0, 0, 1),
    "mirrored top to bottom": _way(1, 0, 0, -1),
    "turned by 180 degrees": _way(-1, 0, 0, -1),
}
QUARTERS: Mapping[str, Way] = {
    "mirrored with x and y exchanged": _way(0, 1, 1, 0),
    "turned by 90 degrees to the right": _way(0, -1, 1, 0),
    "turned by 90 degrees to the left": _way(0, 1, -1, 0),
    "turned by 180 degrees with x and y exchanged": _way(0, -1, -1, 0),
}
"""Of these the rows of the frames are the columns of the events."""
WAYS: Mapping[str, Way] = {**UPRIGHT, **QUARTERS}


def ways_of(size: tuple[int, int]) -> Mapping[str, Way]:
    """The ways in which events of a sensor of that width and height lie in its own pixels."""
    return WAYS if size[0] == size[1] else UPRIGHT


def in_words(name: str, *, inverted: bool) -> str:
    """A way of `WAYS`, and whether polarities are exchanged as well; empty where all is right."""
    return " and ".join([*([name] if name else []), *(["of the other polarity"] * inverted)])


def turned(maps: np.ndarray, way: Way) -> np.ndarray:
    """Maps (..., H, W) of the frames as the events see them, that way."""
    (right, down), exchanged = way[way != 0], way[0, 0] == 0
    # `right` is the sign of the frames' x, which is the events' y where both are exchanged
    if exchanged:
        return np.swapaxes(maps, -1, -2)[..., ::right, ::down]
    return maps[..., ::down, ::right]


def way_homography(way: Way, size: tuple[int, int]) -> Homography:
    """(3, 3), by which `evsplat.events.moved` brings events into pictures of ``size``."""
    middle = (np.array(size) - 1) / 2
    matrix = np.eye(3)
    matrix[:2, :2], matrix[:2, 2] = way, middle - way @ middle
    return matrix
