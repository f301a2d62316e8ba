"""Parts of a picture that are measured by themselves: the person's box, the person's pixels."""

from dataclasses import dataclass

from jaxtyping import Bool
from torch import Tensor

from evsplat.body import BodyTrack, body_box, skin
from evsplat.camera import Camera
from evsplat.capture import Capture, Frame, load_body_track
from evsplat.pictures.box import Box, mask_box

CROP_MARGIN = 0.1


@dataclass(frozen=True)
class Absent:
    """A figure or a region that cannot be had, and why."""

    reason: str


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
        body = self._track.body
        bones = body.bone_transforms(*self._track.at([time_us]))
        vertices = skin(body.rest_vertices, body.weights, bones)[0][0]
        return body_box(vertices, camera, margin=0.0) or Absent("the body is out of view")

    def crop(self, frame: Frame) -> Box | None:
        """The box that ``person_crop`` measures under protocol standard; None where nobody is."""
        _, box = self.in_frame(frame)
        if isinstance(box, Absent):
            return None
        camera = self._capture.camera(frame)
        return box.enlarged(CROP_MARGIN, camera.height, camera.width)
