"""The person as what differs from the static background, near the posed body."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import (
    binary_closing,
    binary_erosion,
    binary_fill_holes,
    binary_opening,
    distance_transform_edt,
    gaussian_filter,
    label,
)
from torch import Tensor

from evsplat.body import track_silhouette
from evsplat.capture import Frame, TrainingCapture, load_body_track
from evsplat.capture.masked import masks_command
from evsplat.errors import ConfigError, DataError
from evsplat.pictures import Transfer, decode

THRESHOLD = 0.08
"""Least difference to the background, in coded values: fewer are shading of the scene."""
NOISE_FACTOR = 4.0
"""A noisier camera gets a higher threshold: this many standard deviations of its noise."""
REACH = 0.06
"""Clothes and hair are within this share of the silhouette's height from the posed bare body."""
_NOISE_FRAMES = 16
_SHADOW_DARKEST, _SHADOW_BRIGHTEST, _SHADOW_HUE = 0.35, 1.02, 0.08
_SOFTNESS_PX = 0.6


class BackgroundDifference:
    """Difference to the temporal median of the train frames, without shadows, cleaned up.

    A pixel is the person's where it differs by more than the camera's noise, is no shadow (all
    channels of linear light darker by one factor) and lies near the posed body; the middle of the
    posed body is the person even where it looks like the background. Holes are closed and only the
    piece that covers most of the posed body is kept; of a capture without body poses, the largest
    piece anywhere. A mask of a blurry frame is as wide as the blur; restored frames
    (`evsplat restore`) give tighter ones.
    """

    name = "background"

    def __init__(self, capture: TrainingCapture, *, threshold: float | None = None) -> None:
        """``threshold``: difference in coded values; without it from the noise of the frames.

        Raises:
            DataError: the camera moves.
            ConfigError: the threshold is not in (0, 1).
        """
        if not capture.is_static_camera:
            raise DataError(
                f"{capture.path}: has a moving camera or several, so there is no static background "
                "to compare with; find the person otherwise: "
                f"{masks_command(capture.path, static_camera=False)}, or --with rvm."
            )
        if threshold is not None and not 0 < threshold < 1:
            raise ConfigError(f"threshold {threshold:g}: expected a number between 0 and 1.")
        self._background = capture.median_background()
        self._track = load_body_track(capture) if capture.has_body else None
        self._threshold = threshold or max(
            THRESHOLD, NOISE_FACTOR * _noise(capture, self._background)
        )

    def masks(
        self, capture: TrainingCapture, frames: Sequence[Frame]
    ) -> Iterator[tuple[Frame, Float[Tensor, "H W"]]]:
        """Each frame in order with a mask whose edge is half a pixel soft."""
        for frame in frames:
            differs = difference(
                capture.image(frame),
                self._background,
                self._threshold,
                capture.transfer(frame),
            )
            if self._track is None:
                person = clean(differs, None)
            else:
                camera = capture.camera(frame)
                person = clean(differs, track_silhouette(self._track, frame.mid_us, camera).numpy())
            yield (
                frame,
                torch.from_numpy(gaussian_filter(person.astype(np.float32), _SOFTNESS_PX)).clamp(
                    0, 1
                ),
            )

    def provenance(self) -> dict[str, Any]:
        """Threshold of the difference."""
        return {"threshold": round(self._threshold, 4)}


def difference(
    image: Float[Tensor, "H W 3"],
    background: Float[Tensor, "H W 3"],
    threshold: float,
    transfer: Transfer = "power",
) -> Bool[np.ndarray, "H W"]:
    """Pixels that differ from the background by more than a shadow on it would."""
    differs = (image - background).abs().amax(-1) > threshold
    # A little light keeps the ratio of dark pixels, which is mostly noise, near one.
    ratio = (decode(image, transfer) + 0.002) / (decode(background, transfer) + 0.002)
    mean = ratio.mean(-1)
    hue = (ratio / mean[..., None] - 1).abs().amax(-1)
    shadow = (mean > _SHADOW_DARKEST) & (mean < _SHADOW_BRIGHTEST) & (hue < _SHADOW_HUE)
    return (differs & ~shadow).numpy()


def clean(
    differs: Bool[np.ndarray, "H W"], body: Bool[np.ndarray, "H W"] | None
) -> Bool[np.ndarray, "H W"]:
    """The piece of the differences that is the person whose bare body is ``body``.

    Nothing where the body is out of view, or no piece covers any of it; where no body is given it
    is the largest piece.
    """
    if body is None:
        person, weight = binary_opening(differs), np.ones_like(differs)
    elif not body.any():
        return np.zeros_like(body)
    else:
        rows = np.flatnonzero(body.any(axis=1))
        near = distance_transform_edt(~body) <= REACH * (rows[-1] - rows[0] + 1)
        person = binary_opening(differs & near) | binary_erosion(body, iterations=2)
        weight = body
    closed = binary_closing(np.pad(person, 2), iterations=2)[2:-2, 2:-2]
    pieces, count = label(closed)
    if count == 0:
        return np.zeros_like(differs)
    covered = np.bincount(pieces[weight], minlength=count + 1)
    covered[0] = 0
    if not covered.any():  # what differs lies beside a body too thin for a middle of its own
        return np.zeros_like(differs)
    return binary_fill_holes(pieces == int(covered.argmax()))


def _noise(capture: TrainingCapture, background: Float[Tensor, "H W 3"]) -> float:
    """Standard deviation of a pixel that nothing happens to, from the median of differences."""
    frames = capture.train_frames
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(_NOISE_FRAMES, len(frames))).astype(int))
    differences = [(capture.image(frames[k]) - background).abs().amax(-1) for k in chosen]
    return 1.4826 * float(torch.stack(differences).median())
