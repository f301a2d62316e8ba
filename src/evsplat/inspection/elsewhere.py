"""Does something else move than the person? What changes away from the body and is no shadow.

Pictures are compared with the median of those in which the body is not near. Shadow and light
change all colours by one factor, within limits; other things do so only where they are as grey, or
of the same hue, as what is behind them, and are missed there. Limits are from staged captures
(docs/experiments/ladder.md, what else moves).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.ndimage import binary_opening, distance_transform_edt, label

from evsplat.inspection.movement import CHANGED
from evsplat.pictures.squares import square_means

FEWEST_FRAMES = 8
"""A median of fewer pictures is no backdrop."""
_FIGURE_PX = 40
"""Height of the body in the maps."""
_AWAY = 0.12
"""Of the body's height: hair, cloth, blur and errors of poses are nearer to its outline."""
_FEWEST_BARE = 3
"""Pictures without the body near that a pixel's backdrop needs."""
_STRONG = 0.4
"""Of `CHANGED`: what changes more counts."""
_BLACK = 0.02
"""Added to values before the logarithm: noise of dark pixels is no change of light."""
_DEEPEST, _COLOURED, _COLOURED_LEAST, _COLOURED_MOST = 0.9, 0.2, 0.04, 0.12
"""A shadow is a factor of all colours of at most exp(0.9) in coded values, which channels differ
from by at most a fifth of its logarithm and 0.04, and never by more than 0.12: those of 60 right
captures had 0.83, and differed by up to 0.09."""
_LARGE = 0.04
"""Share of the body's area that is told: all but one of the right captures had 0."""
_OFTEN = 4
"""Told if it is so large in one of so many pictures, or more of them."""


@dataclass(frozen=True)
class Elsewhere:
    """A place away from the body that changes, and not as shadow does."""

    box_px: tuple[int, int, int, int]
    """Left, top, right and bottom of the place, in pixels of the picture."""
    picture_px: tuple[int, int]
    """Width and height of the picture."""
    frames: int
    """Pictures in which it changes there ..."""
    looked_at: int
    """... of so many."""
    shares: tuple[tuple[str, float], ...]
    """Share of "events" and of "frames" (their differences) in the place and away from the body."""

    @property
    def where(self) -> str:
        """Such as "at the upper right, 120..180 x 40..110 px"."""
        left, top, right, bottom = self.box_px
        across = _third((left + right) / (2 * self.picture_px[0]), "left", "right")
        down = _third((top + bottom) / (2 * self.picture_px[1]), "upper", "lower")
        side = {"": "in the middle", "left": "at the left", "right": "at the right"}[across]
        if down and across:
            side = f"at the {down} {across}"
        elif down:
            side = f"in the {down} middle"
        return f"{side}, {left}..{right} x {top}..{bottom} px"

    @property
    def sentence(self) -> str:
        """The place and what is there, in words and figures."""
        names = {"events": "of the events", "frames": "of what changes between frames"}
        said = " and ".join(f"{share:.0%} {names[name]}" for name, share in self.shares)
        return (
            f"something that moves or changes beside the person, {self.where} (in {self.frames} of "
            f"{self.looked_at} pictures looked at; {said})"
        )


EXPECTED = "a scene that stands still but for the person and their shadow"
REMEDY = (
    "Training takes the scene to stand still: there it becomes the mean of what was seen, and the "
    "person before it is a little worse. Crop it away or leave those frames out, or go on if that "
    "place does not matter."
)


def find_elsewhere(
    pictures: Float32[np.ndarray, "K 3 h w"],
    found: dict[str, Float32[np.ndarray, "K h w"]],
    body: Bool[np.ndarray, "K h w"],
    picture_px: tuple[int, int],
) -> Elsewhere | None:
    """The largest place away from the body that changes as other things than shadow do, or None.

    ``pictures`` are coded values of a camera that stands still, ``found`` what moves
    (`evsplat.inspection.movement.movement`), ``body`` where the body is about each picture's
    exposure. None as well where pictures are few, or where the body is in none.
    """
    size = _tall(body)
    if len(pictures) < FEWEST_FRAMES or size == 0:
        return None
    step = max(1, round(size / _FIGURE_PX))
    here = square_means(body, step) > 0
    near = np.stack(
        [distance_transform_edt(~one) <= max(2, round(_AWAY * size / step)) for one in here]
    )
    colours = np.stack(
        [square_means(channel, step) for channel in pictures.swapaxes(0, 1)], axis=-1
    )
    other = _other_than_shadow(colours, near)
    area = float(np.median(here.sum((1, 2))))
    largest = np.stack([_largest_piece(one) for one in other])
    large = largest.sum((1, 2)) >= _LARGE * area
    if large.sum() * _OFTEN < len(pictures):
        return None
    place = _place(largest[large])
    rows, columns = np.flatnonzero(place.any(1)), np.flatnonzero(place.any(0))
    width, height = picture_px
    # maps' last pixels, less than a step, are left out of the reduced ones
    across, down = (step * width / body.shape[2], step * height / body.shape[1])
    box = (
        round(columns[0] * across), round(rows[0] * down),
        min(width, round((columns[-1] + 1) * across)), min(height, round((rows[-1] + 1) * down)),
    )  # fmt: skip
    shares = []
    for name, maps in found.items():
        moving = square_means(maps, step)
        shares.append((name, float(moving[place & ~near].sum() / max(moving.sum(), 1e-9))))
    return Elsewhere(
        box, picture_px, int((largest & place).any((1, 2)).sum()), len(pictures), tuple(shares)
    )


def _third(share: float, first: str, last: str) -> str:
    return first if share < 1 / 3 else last if share > 2 / 3 else ""


def _tall(body: Bool[np.ndarray, "K h w"]) -> float:
    """Median height or width of the body where there is some, the larger; 0 where there is none."""
    sizes = [
        max(np.ptp(row), np.ptp(column)) + 1
        for row, column in (np.nonzero(one) for one in body)
        if len(row)
    ]
    return float(np.median(sizes)) if sizes else 0.0


def _other_than_shadow(
    colours: Float32[np.ndarray, "K h w 3"], near: Bool[np.ndarray, "K h w"]
) -> Bool[np.ndarray, "K h w"]:
    """Where pictures differ much from the backdrop, away from the body, and not as shadow does."""
    backdrop = _bare_median(colours, ~near) + _BLACK
    usable = ~near & ~np.isnan(backdrop[..., 0])
    with np.errstate(invalid="ignore"):
        factor = np.log((colours + _BLACK) / backdrop)
    for one, seen in zip(factor, usable, strict=True):
        if seen.any():
            one -= np.median(one[seen], axis=0)  # a camera or lamps that change all of the picture
    change = np.abs(np.expm1(factor) * backdrop).max(-1)
    light = factor.mean(-1)
    coloured = np.abs(factor - light[..., None]).max(-1)
    allowed = np.minimum(_COLOURED_LEAST + _COLOURED * np.abs(light), _COLOURED_MOST)
    shadow = (np.abs(light) < _DEEPEST) & (coloured < allowed)
    return usable & (change > _STRONG * CHANGED) & ~shadow


def _bare_median(
    colours: Float32[np.ndarray, "K h w 3"], bare: Bool[np.ndarray, "K h w"]
) -> Float[np.ndarray, "h w 3"]:
    """Median over the pictures that are ``bare``; nan where they are too few."""
    ordered = np.sort(np.where(bare[..., None], colours, np.inf), axis=0)
    count = bare.sum(0)[None, ..., None]
    middle = [
        np.take_along_axis(ordered, np.clip(at, 0, len(colours) - 1), axis=0)[0]
        for at in ((count - 1) // 2, count // 2)
    ]
    return np.where(count[0] < _FEWEST_BARE, np.nan, (middle[0] + middle[1]) / 2)


def _largest_piece(moves: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The largest connected part; single pixels and lines of one are none."""
    pieces, count = label(binary_opening(moves, np.ones((2, 2))), np.ones((3, 3)))
    if count == 0:
        return np.zeros_like(moves)
    return pieces == np.bincount(pieces.ravel())[1:].argmax() + 1


def _place(pieces: Bool[np.ndarray, "K h w"]) -> Bool[np.ndarray, "h w"]:
    """The connected place in which most of the pieces are."""
    places, count = label(pieces.any(0), np.ones((3, 3)))
    weights = [float(pieces[:, places == k + 1].sum()) for k in range(count)]
    return places == int(np.argmax(weights)) + 1
