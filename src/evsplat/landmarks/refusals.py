"""What the search for the person refuses, each in one sentence, rather than find a wrong one."""

import logging
from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from evsplat.capture import TrainingCapture
from evsplat.errors import DataError
from evsplat.landmarks.detect import Found, Region
from evsplat.landmarks.landmarks import LIMB_POINTS
from evsplat.landmarks.motion import Bounds, Motion, global_shift, pieces
from evsplat.landmarks.pictures import SharpPicture
from evsplat.spread import evenly_spread

logger = logging.getLogger(__name__)

_SECOND_FLAG, _SECOND_DOUBT = 0.9, 0.012
_SECOND_SIZE = 0.35
"""A second person is at least this tall beside the first."""
_EXAMINED = 8
"""Pictures, spread over the recording, in which a second person is looked for."""
_LEAST_SHIFT_PX = 2.0
_LEAST_SHOWN = 2
"""Of the pictures looked at first: furniture may once be taken for somebody."""
_NOBODY = (
    "expected one person, from head to feet, in most of them; look at them with evsplat inspect, "
    "and give key points of another tool with --keypoints if there is one to be seen."
)
_HALF_OUT = 0.25
"""Share of limb joints beyond the border of which a picture shows too little."""


def refuse_empty(
    capture: TrainingCapture,
    pictures: Sequence[SharpPicture],
    is_somebody: Callable[[SharpPicture], bool],
) -> None:
    """A `DataError` where next to none of a few pictures show a person.

    Searches where nobody is take longest, so this is known before all pictures are searched.
    """
    needed = min(_LEAST_SHOWN, len(pictures))
    shown = 0
    for picture in pictures:
        shown += is_somebody(picture)
        if shown == needed:
            return
    raise DataError(
        f"{capture.path}: nobody was found in {len(pictures) - shown} of {len(pictures)} pictures "
        f"looked at first, {_NOBODY}"
    )


def refuse_nobody(
    capture: TrainingCapture, pictures: Sequence[SharpPicture], found: Sequence[Found]
) -> None:
    """A `DataError` where most pictures show no person."""
    missed = sum(not person.is_person for person in found)
    if 2 * missed > len(pictures):
        raise DataError(
            f"{capture.path}: nobody was found in {missed} of {len(pictures)} pictures, {_NOBODY}"
        )


def refuse_half_out_of_view(
    capture: TrainingCapture, pictures: Sequence[SharpPicture], places: Float[np.ndarray, "N 33 2"]
) -> None:
    """A `DataError` where most pictures show only part of the person."""
    height, width = pictures[0].image.shape[:2]
    limbs = places[:, LIMB_POINTS]
    outside = ((limbs < 0) | (limbs > np.array([width, height]))).any(-1).mean(1)
    cut = int((outside > _HALF_OUT).sum())
    if 2 * cut > len(pictures):
        raise DataError(
            f"{capture.path}: the person is partly out of view in {cut} of {len(pictures)} "
            f"pictures (more than {_HALF_OUT:.0%} of shoulders, elbows, wrists, hips, knees and "
            "ankles lie beyond the border), expected the whole body in most of them; record from "
            "farther away."
        )
    if cut:
        logger.warning(
            "images: the person is partly out of view in %d of %d pictures.", cut, len(pictures)
        )


def refuse_moving_camera(
    capture: TrainingCapture,
    found: tuple[Sequence[SharpPicture], Float[np.ndarray, "N 33 2"]] | None,
) -> None:
    """A `DataError` where the camera moves: by what the capture says, or by the background.

    ``found`` are pictures with the person's places, outside of which nothing should move.
    """
    if not capture.is_static_camera:
        raise DataError(
            f"{capture.path}: has a moving camera or several, and landmarks are found before a "
            "static background; give key points of another tool with --keypoints."
        )
    if found is None:
        return
    frames = sorted(capture.train_frames, key=lambda frame: frame.mid_us)
    images = [capture.image(frame) for frame in frames]
    still = [
        ~_covered(person_bounds(_nearest(*found, frame.mid_us)), *image.shape[:2])
        for frame, image in zip(frames, images, strict=True)
    ]
    shifts = [
        np.hypot(*global_shift(images[k], images[k + 1], still[k] & still[k + 1]))
        for k in range(len(frames) - 1)
    ]
    moved = int(np.sum(np.array(shifts) >= _LEAST_SHIFT_PX))
    if 2 * moved > max(1, len(shifts)):
        raise DataError(
            f"{capture.path}: the background moves by {np.median(shifts):.0f} pixels from frame to "
            f"frame (in {moved} of {len(shifts)} pairs of frames), expected a camera that stands "
            "still; record with a tripod, or give key points of another tool with --keypoints."
        )


def refuse_two_people(
    capture: TrainingCapture,
    motion: Motion,
    pictures: Sequence[SharpPicture],
    found: Sequence[Found],
    search: Callable[[Tensor, Sequence[Region]], Found],
) -> None:
    """A `DataError` where a second person moves beside the one that was found.

    The first is painted over with the background; in what else moves another is searched for.
    """
    examined = evenly_spread(range(len(pictures)), _EXAMINED)
    chosen = [k for k in examined if found[k].is_person]
    seconds = [
        person
        for k in chosen
        if (person := _second(motion, pictures[k], found[k], search)) is not None
    ]
    if seconds and 2 * len(seconds) >= len(chosen):
        x, y = np.mean([person.region.centre for person in seconds], axis=0)
        raise DataError(
            f"{capture.path}: a second person moves at about x={x:.0f}, y={y:.0f} (in "
            f"{len(seconds)} of {len(chosen)} pictures examined), expected one person; crop the "
            "recording to one of them."
        )


def _second(
    motion: Motion,
    picture: SharpPicture,
    first: Found,
    search: Callable[[Tensor, Sequence[Region]], Found],
) -> Found | None:
    """Another person in a picture, who moves and is not much smaller than the first."""
    height, width = picture.image.shape[:2]
    box = person_bounds(first.places)
    covered = _covered(box, height, width)
    boxes = pieces(motion.moving(picture.time_us) & ~covered)
    boxes = [part for part in boxes if part.side > _SECOND_SIZE * box.side]
    if not boxes:
        return None
    painted = torch.where(torch.from_numpy(covered)[..., None], motion.background, picture.image)
    starts = [Region(part.centre, 1.25 * part.side) for part in boxes[:3]]
    person = search(painted, starts)
    tall = person_bounds(person.places).side > _SECOND_SIZE * box.side
    beside = not np.all(
        (person.region.centre > [box.x0, box.y0]) & (person.region.centre < [box.x1, box.y1])
    )
    sure = person.flag >= _SECOND_FLAG and person.doubt <= _SECOND_DOUBT
    return person if sure and tall and beside else None


def person_bounds(places: Float[np.ndarray, "33 2"]) -> Bounds:
    """Box of all landmarks with room for flesh and clothes."""
    low, high = places.min(0), places.max(0)
    return Bounds(low[0], low[1], high[0], high[1]).grown(0.15)


def _covered(box: Bounds, height: int, width: int) -> Bool[np.ndarray, "H W"]:
    rows, columns = np.ogrid[:height, :width]
    covered: np.ndarray = (
        (columns >= box.x0) & (columns < box.x1) & (rows >= box.y0) & (rows < box.y1)
    )
    return covered


def _nearest(
    pictures: Sequence[SharpPicture], places: Float[np.ndarray, "N 33 2"], time_us: int
) -> Float[np.ndarray, "33 2"]:
    times = np.array([picture.time_us for picture in pictures])
    nearest: np.ndarray = places[int(np.abs(times - time_us).argmin())]
    return nearest
