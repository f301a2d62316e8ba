"""Whether nothing moves in some frames' pictures, of which a sensor without noise tells nothing."""

import math
from collections.abc import Sequence

import numpy as np

from evsplat.calibration.brightness import exposure
from evsplat.calibration.offset import block_means
from evsplat.capture.metadata import Frame, Metadata
from evsplat.errors import DataError
from evsplat.pictures.files import read_image, to_unit_range
from evsplat.spread import evenly_spread

_MOST = 16
"""Pictures that are looked at, spread over the frames."""
_DARK = math.log(1e-3)
"""Noise decides how much darker than this a pixel seems."""
_CHANGED = 0.03
"""Change of a block's mean log luminance: a person 20 px high who moves makes more in pictures of
256 px, and noise much less."""


def nothing_moves(metadata: Metadata, frames: Sequence[Frame]) -> bool:
    """True where the pictures of at least two training frames show the same.

    What all of a picture changes by, a camera's gain, does not count. False where a picture cannot
    be read, or has another size.
    """
    frames = [frame for frame in frames if frame.split == "train"]
    if len(frames) < 2:
        return False
    camera = metadata.cameras[frames[0].camera]
    transfer, found = metadata.transfers.get(frames[0].camera, "power"), []
    for frame in evenly_spread(frames, _MOST):
        try:
            pixels = read_image(frame.image)
        except DataError:  # a check of its own speaks of the picture
            return False
        if pixels.shape[:2] != (camera.height, camera.width):
            return False
        seen = exposure(to_unit_range(pixels), frame.exposure_us, transfer=transfer)
        found.append(block_means(np.maximum(seen.log_luminance, _DARK)))
    levels = np.array(found)
    change = levels - levels[0]
    return bool(np.abs(change - np.median(change, axis=1, keepdims=True)).max() < _CHANGED)
