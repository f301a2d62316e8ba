"""Landmarks of a capture's person at all times: searched for, tracked, searched for again."""

import logging
from collections.abc import Iterator, Sequence
from itertools import groupby

import numpy as np
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from evsplat.capture import Frame, TrainingCapture, coded
from evsplat.errors import DataError
from evsplat.landmarks.detect import COPIES, LEAST_FLAG, Found, Region, find_in
from evsplat.landmarks.landmarks import BLAZEPOSE_33, Landmarks
from evsplat.landmarks.motion import Motion
from evsplat.landmarks.network import LandmarkNetwork
from evsplat.landmarks.pictures import CARRIED_SIGMA, SharpPicture
from evsplat.landmarks.refusals import (
    refuse_empty,
    refuse_half_out_of_view,
    refuse_moving_camera,
    refuse_nobody,
    refuse_two_people,
)
from evsplat.spread import evenly_spread

logger = logging.getLogger(__name__)

SURE = 0.9
"""Below this flag the person is searched for; from it on, pictures before may follow."""
HARDLY, _HARDLY_SIGMA = 0.5, 2.0
"""Belief in all points of somebody who is hardly recognised, and factor of their expected error: in
kicks and flips most of them are near where they belong."""
_CARRIED, _CARRIED_SIGMA = 0.1, 4.0
"""The same where events carried the picture there from others, which may show ghosts."""
_TURNS = (0.0, np.pi / 2, -np.pi / 2, np.pi)
"""Uprights of a search: cartwheels and handstands are found by the last three."""
_CLEAR = 0.008
"""Up to this doubt no other upright is tried."""
_LOOKS = 2
_FIRST_LOOKS = 6
"""Pictures in which somebody is searched for before all are read."""
_LEAST_FOLLOWED = 0.3
_BOX_MARGIN = 1.25
_SETTLED = 0.08
"""A region is read again where the next one is off by more than this share of its side."""
_BASE_SIGMA = 0.008
"""Error of a clearly seen point over the side of its region."""


def find_landmarks(
    capture: TrainingCapture,
    pictures: Sequence[SharpPicture],
    *,
    network: LandmarkNetwork,
    progress: bool = True,
) -> Landmarks:
    """The person's 33 landmarks in pictures (of `sharp_pictures`), in order of time.

    In all but stretches in which nothing moves and hardly anybody is recognised: somebody may
    enter late, or leave.

    Raises:
        DataError: nobody is found in most pictures, there are two people, most of the person is
            out of view, or the camera moves.
    """
    refuse_moving_camera(capture, None)
    if not pictures:
        raise DataError(f"{capture.path}: has no picture in which to look for the person.")
    pictures = sorted(pictures, key=lambda picture: picture.time_us)
    capture = coded(capture)
    motion = Motion(capture)
    tracker = _Tracker(network, motion)
    busy = [picture for picture in pictures if not motion.moves_little(picture.time_us)]
    first = _spread(busy or pictures)
    refuse_empty(capture, first, lambda picture: tracker.search_anew(picture).is_person)
    found = [
        tracker.find(picture)
        for picture in tqdm(
            pictures, "landmarks", unit="picture", leave=False, disable=not progress
        )
    ]
    tracker.look_back(pictures, found)
    pictures, found = _of_somebody(motion, pictures, found)
    refuse_nobody(capture, pictures, found)
    places = np.stack([person.places for person in found])
    refuse_moving_camera(capture, (pictures, places))
    refuse_half_out_of_view(capture, pictures, places)
    refuse_two_people(capture, motion, pictures, found, tracker.search)
    doubtful = sum(not person.is_person for person in found)
    if doubtful:
        logger.warning(
            "images: the person is hardly recognised in %d of %d pictures.", doubtful, len(found)
        )
    return Landmarks(
        np.array([picture.time_us for picture in pictures], dtype=np.int64),
        places,
        np.stack([_sigma(*both) for both in zip(pictures, found, strict=True)]),
        np.stack([_seen(*both) for both in zip(pictures, found, strict=True)]),
        np.stack([person.world for person in found]),
        BLAZEPOSE_33,
    )


def _of_somebody(
    motion: Motion, pictures: Sequence[SharpPicture], found: Sequence[Found]
) -> tuple[list[SharpPicture], list[Found]]:
    """Without stretches in which nothing moves and most pictures show nobody; all if none is left.

    Most, since furniture may once be taken for somebody.
    """
    shown: list[tuple[SharpPicture, Found]] = []
    both = list(zip(pictures, found, strict=True))
    for still, stretch in groupby(both, lambda one: motion.moves_little(one[0].time_us)):
        part = list(stretch)
        if not still or 2 * sum(person.is_person for _, person in part) >= len(part):
            shown += part
    kept = shown or both
    return [picture for picture, _ in kept], [person for _, person in kept]


def _spread(pictures: Sequence[SharpPicture]) -> list[SharpPicture]:
    """A few of the pictures that are the sharpest, over all of their time."""
    sharpest = min(picture.sigma for picture in pictures)
    clear = [picture for picture in pictures if picture.sigma == sharpest]
    return evenly_spread(clear, _FIRST_LOOKS)


class _Tracker:
    """Finds the person in one picture after the other."""

    def __init__(self, network: LandmarkNetwork, motion: Motion) -> None:
        self._network, self._motion = network, motion
        self._last: Region | None = None
        self._searched: Frame | None = None

    def find(self, picture: SharpPicture) -> Found:
        """From the last region, or by a search where that is doubtful.

        Of an exposure one picture is searched: the others are near enough to follow from it.
        """
        best = None if self._last is None else self.settle(picture.image, self._last)
        if best is None or best.flag < SURE and picture.frame is not self._searched:
            self._searched = picture.frame
            searched = self.search_anew(picture)
            best = searched if best is None else min(best, searched, key=_badness)
        if self._last is None or best.flag >= LEAST_FLAG:
            self._last = best.region
        return best

    def search_anew(self, picture: SharpPicture) -> Found:
        """The clearest person in a picture, wherever somebody may be."""
        return self.search(picture.image, list(starts_of(self._motion, picture)))

    def look_back(self, pictures: Sequence[SharpPicture], found: list[Found]) -> None:
        """Read doubtful pictures again in the regions of better ones after them."""
        for index in range(len(found) - 2, -1, -1):
            here, following = found[index], found[index + 1]
            if _is_clear(here) or following.flag < SURE:
                continue
            if _badness(following) < _badness(here):
                again = self.settle(pictures[index].image, following.region)
                found[index] = min(here, again, key=_badness)

    def search(self, image: Float[Tensor, "H W 3"], starts: Sequence[Region]) -> Found:
        """The clearest person in the first start that shows one; upright, turned or upside down."""
        best: Found | None = None
        for start in starts:
            for turn in _TURNS:
                region, flag = self._approach(image, start.turned(turn))
                if best is not None and flag < _LEAST_FOLLOWED:
                    continue
                found = find_in(self._network, image, region)
                best = found if best is None else min(best, found, key=_badness)
                if _is_clear(best):
                    return best
            if best is not None and best.is_person:
                return best
        assert best is not None
        return best

    def settle(self, image: Float[Tensor, "H W 3"], region: Region) -> Found:
        """The person in the region that follows from one that is near."""
        return find_in(self._network, image, self._approach(image, region)[0])

    def _approach(self, image: Float[Tensor, "H W 3"], region: Region) -> tuple[Region, float]:
        """The region that follows from a first look, or from a second one where it is far.

        And the belief of the last look that there is a person.
        """
        flag = 0.0
        for _ in range(_LOOKS):
            look = find_in(self._network, image, region, copies=COPIES[:1])
            flag = look.flag
            if flag < _LEAST_FOLLOWED or not 0.4 < look.region.side / region.side < 2.5:
                break
            near = _alike(region, look.region)
            region = look.region
            if near:
                break
        return region, flag


def _is_clear(found: Found) -> bool:
    return found.flag >= SURE and found.doubt <= _CLEAR


def _badness(found: Found) -> float:
    """Lower is better: belief that there is a person counts first, then agreement of the copies."""
    return found.doubt + max(0.0, SURE - found.flag)


def starts_of(motion: Motion, picture: SharpPicture) -> Iterator[Region]:
    """Regions to begin a search in: what moves, then the whole picture, then its centre square."""
    height, width = picture.image.shape[:2]
    for box in motion.boxes(picture.time_us)[:2]:
        yield Region(box.centre, _BOX_MARGIN * box.side)
    centre = np.array([width, height]) / 2
    yield Region(centre, float(max(height, width)))
    if height != width:
        yield Region(centre, float(min(height, width)))


def _alike(one: Region, other: Region) -> bool:
    moved = np.abs(one.centre - other.centre).max() / one.side
    turned = abs((one.angle - other.angle + np.pi) % (2 * np.pi) - np.pi)
    grown = abs(np.log(other.side / one.side))
    return bool(max(moved, turned, grown) < _SETTLED)


def _sigma(picture: SharpPicture, found: Found) -> Float[np.ndarray, "33"]:
    """Expected error per axis, pixels: what clear points have, and the copies' disagreement."""
    base = _BASE_SIGMA * found.region.side
    doubt = 1.0 if found.is_person else _of(picture, _HARDLY_SIGMA, _CARRIED_SIGMA)
    sigma: np.ndarray = picture.sigma * doubt * np.hypot(base, found.spread)
    return sigma


def _seen(picture: SharpPicture, found: Found) -> Float[np.ndarray, "33"]:
    """The network's belief, less where its copies disagree: it believes in hidden arms as well."""
    if not found.is_person:
        return np.full(len(found.spread), _of(picture, HARDLY, _CARRIED))
    disagreement = found.spread / (_BASE_SIGMA * found.region.side)
    seen: np.ndarray = found.flag * found.visible / (1 + (disagreement / 2) ** 2)
    return seen


def _of(picture: SharpPicture, own: float, carried: float) -> float:
    """One of two values, by whether events carried the picture from elsewhere."""
    return carried if picture.sigma == CARRIED_SIGMA else own
