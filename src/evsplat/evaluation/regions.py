"""Parts of a picture that are measured by themselves: the person's box, the person's pixels."""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from evsplat.body import BodyTrack, skin
from evsplat.body import body_box as projected_box
from evsplat.camera import Camera
from evsplat.capture import Capture, Frame, load_body_track

CROP_MARGIN = 0.1

Picture = TypeVar("Picture", Tensor, np.ndarray)


@dataclass(frozen=True)
class Absent:
    """A figure or a region that cannot be had, and why."""

    reason: str


@dataclass(frozen=True)
class Box:
    """Pixels ``[top, bottom) x [left, right)``."""

    top: int
    bottom: int
    left: int
    right: int

    def crop(self, image: Picture) -> Picture:
        """The part of ``image`` (H, W, ...) inside the box."""
        return image[self.top : self.bottom, self.left : self.right]

    def enlarged(self, margin: float, height: int, width: int) -> "Box":
        """Wider by ``margin`` of its extent on each side, whole pixels, clipped to the picture."""
        rows = int(margin * (self.bottom - self.top))
        columns = int(margin * (self.right - self.left))
        return self.wider(rows, columns, height, width)

    def wider(self, rows: int, columns: int, height: int, width: int) -> "Box":
        """Wider by so many rows and columns on each side, clipped to the picture."""
        return Box(
            max(self.top - rows, 0),
            min(self.bottom + rows, height),
            max(self.left - columns, 0),
            min(self.right + columns, width),
        )

    def at_least(self, aspect: float, width: int) -> "Box":
        """Widened to ``aspect`` times its height, about its centre but inside the picture."""
        columns = min(width, max(self.right - self.left, round(aspect * (self.bottom - self.top))))
        left = (self.left + self.right - columns) // 2
        left = min(max(left, 0), width - columns)
        return Box(self.top, self.bottom, left, left + columns)

    def without_last(self) -> "Box":
        """Without its last row and column."""
        return Box(self.top, self.bottom - 1, self.left, self.right - 1)


def mask_box(mask: Bool[Tensor, "H W"]) -> Box | None:
    """Smallest box around the true pixels; None where there are none."""
    if not bool(mask.any()):
        return None
    rows = torch.nonzero(mask.any(dim=1)).flatten()
    columns = torch.nonzero(mask.any(dim=0)).flatten()
    return Box(int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1)


def body_box(track: BodyTrack, camera: Camera, time_us: int) -> Box | None:
    """Smallest box around the posed body as ``camera`` sees it; None where it is out of view."""
    rotations, translation = track.at([time_us])
    bones = track.body.bone_transforms(rotations, translation)
    vertices, _ = skin(track.body.rest_vertices, track.body.weights, bones)
    corners = projected_box(vertices[0], camera, margin=0.0)
    if corners is None:
        return None
    left, top, right, bottom = corners
    return Box(top, bottom, left, right)


class HumanRegions:
    """The person in pictures of a capture: by masks, or by the posed body where there is none."""

    def __init__(self, capture: Capture) -> None:
        self._capture = capture
        self._track: BodyTrack | None = None

    def in_frame(self, frame: Frame) -> tuple[Bool[Tensor, "H W"] | None, Box | Absent]:
        """The person's pixels, if the frame has a mask, and the tight box."""
        mask = self._capture.mask(frame)
        if mask is None:
            return None, self.in_view(self._capture.camera(frame), frame.mid_us)
        pixels = mask > 0.5
        return pixels, mask_box(pixels) or Absent("the person mask is empty")

    def in_view(self, camera: Camera, time_us: int) -> Box | Absent:
        """The tight box of the posed body."""
        if self._track is None:
            self._track = load_body_track(self._capture)
        return body_box(self._track, camera, time_us) or Absent("the body is out of view")

    def crop(self, frame: Frame) -> Box | None:
        """The box that ``person_crop`` measures under protocol standard; None where nobody is."""
        _, box = self.in_frame(frame)
        if isinstance(box, Absent):
            return None
        camera = self._capture.camera(frame)
        return box.enlarged(CROP_MARGIN, camera.height, camera.width)
