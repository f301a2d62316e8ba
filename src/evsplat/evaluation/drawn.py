"""Pictures as a reconstruction draws them, for whoever measures them."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from evsplat.capture import Camera, Capture, Frame
from evsplat.methods.reconstruction import Reconstruction
from evsplat.pictures.files import ImageCache

_KEPT_BYTES = 64 << 20
"""Of drawn frames: a frame is measured, and drawn in up to two pairs of event maps."""

KeepPicture = Callable[[str, UInt8[np.ndarray, "H W 3"]], None]
"""Writes a picture of the evaluation, by its path inside the run folder."""


class DrawnFrames:
    """Frames as a reconstruction draws their mid-exposures, sRGB; the last ones are kept."""

    def __init__(self, capture: Capture, reconstruction: Reconstruction) -> None:
        self._capture, self._reconstruction = capture, reconstruction
        self._kept = ImageCache(_KEPT_BYTES)

    def __call__(self, frame: Frame) -> Float[Tensor, "H W 3"]:
        """One frame; not to be written to."""
        return torch.from_numpy(
            self._kept.get(
                frame.name,
                lambda: drawn_frame(self._capture, self._reconstruction, frame).numpy(),
            )
        )


@torch.no_grad()
def drawn(source: Reconstruction, camera: Camera, time_us: int) -> Float[Tensor, "H W 3"]:
    """One instant as a camera sees it, sRGB."""
    return source.render(camera, [time_us]).rgb[0].cpu()


def drawn_frame(capture: Capture, source: Reconstruction, frame: Frame) -> Float[Tensor, "H W 3"]:
    """A frame's mid-exposure, sRGB."""
    return drawn(source, capture.camera(frame), frame.mid_us)
