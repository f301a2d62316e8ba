"""Where the person is in a picture."""

from jaxtyping import Bool
from torch import Tensor

from evsplat.body import BodyTrack
from evsplat.capture import Camera, Capture, Frame, load_body_track
from evsplat.evaluation.protocols import Absent
from evsplat.evaluation.regions import Box, body_box, mask_box


class People:
    """Where the person is: in the mask, or in the posed body's outline where there is no mask."""

    def __init__(self, capture: Capture) -> None:
        self._capture = capture
        self._track: BodyTrack | None = None

    def in_mask(self, frame: Frame) -> tuple[Bool[Tensor, "H W"] | None, Box | Absent]:
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
