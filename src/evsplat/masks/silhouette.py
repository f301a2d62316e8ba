"""The posed body's silhouette as a person mask."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from evsplat.body import BodyTrack, track_silhouette
from evsplat.capture import Camera, Frame, TrainingCapture, load_body_track
from evsplat.errors import ConfigError

OVERSAMPLING = 4
"""Pixels are tested on a grid that is finer by this, so that the edge of a mask is soft."""


class PosedBody:
    """The posed body at mid-exposure, widened by a margin for clothes and hair."""

    name = "silhouette"

    def __init__(self, capture: TrainingCapture, *, margin_px: float = 0.0) -> None:
        """``margin_px``: widen the silhouette by this many pixels on all sides.

        Raises:
            ConfigError: the margin is below 0 or not finite.
            DataError: the capture has no body poses.
        """
        if not 0 <= margin_px < math.inf:
            raise ConfigError(f"margin {margin_px:g}: expected pixels, 0 or more.")
        self._track = load_body_track(capture)
        self._margin_px = margin_px

    def masks(
        self, capture: TrainingCapture, frames: Sequence[Frame]
    ) -> Iterator[tuple[Frame, Float[Tensor, "H W"]]]:
        """Each frame in order with the body's share of each pixel."""
        for frame in frames:
            yield (
                frame,
                soft_silhouette(
                    self._track, frame.mid_us, capture.camera(frame), margin_px=self._margin_px
                ),
            )

    def provenance(self) -> dict[str, Any]:
        """Margin in pixels."""
        return {"margin_px": self._margin_px}


def soft_silhouette(
    track: BodyTrack, time_us: int, camera: Camera, *, margin_px: float
) -> Float[Tensor, "H W"]:
    """Share of each pixel that the posed body covers, wider by ``margin_px``, in [0, 1]."""
    large = camera.resized(camera.width * OVERSAMPLING, camera.height * OVERSAMPLING)
    fine = track_silhouette(track, time_us, large)
    if margin_px > 0 and bool(fine.any()):
        outside = torch.from_numpy(distance_transform_edt(~fine.numpy()))
        fine = outside <= margin_px * OVERSAMPLING
    pooled = torch.nn.functional.avg_pool2d(fine.float()[None, None], OVERSAMPLING)
    return pooled[0, 0]
