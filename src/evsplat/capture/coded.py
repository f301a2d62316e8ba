"""A recording as pretrained networks take it: all pictures coded."""

from jaxtyping import Float
from torch import Tensor

from evsplat.capture.metadata import Frame
from evsplat.capture.training_capture import TrainingCapture
from evsplat.pictures.light import Transfer, shown


def coded(capture: TrainingCapture) -> TrainingCapture:
    """The capture with sRGB-coded pictures where they are recorded as light; else itself."""
    light = any(capture.transfer(frame) == "linear" for frame in capture.frames)
    return _Coded(capture) if light else capture


class _Coded(TrainingCapture):
    """A capture with pictures recorded as light, given as sRGB."""

    def __init__(self, capture: TrainingCapture) -> None:
        super().__init__(capture._source, capture.policy, capture._masker)

    def transfer(self, frame: Frame | str) -> Transfer:
        """From the values of a frame's pictures, as they are given here, to light."""
        recorded = super().transfer(frame)
        return "srgb" if recorded == "linear" else recorded

    def image(self, frame: Frame | str) -> Float[Tensor, "H W 3"]:
        """The blurry picture of a training frame."""
        return shown(super().image(frame), super().transfer(frame))

    def median_background(self) -> Float[Tensor, "H W 3"]:
        """Per-pixel temporal median of the training frames."""
        return shown(super().median_background(), super().transfer(self.frames[0]))
