"""Up-sampling along optical flow in both directions, with reasoning about what hides what.

Flow by dense inverse search (Kroeger et al. 2016, OpenCV's DIS). For a time in between, the flows
of both pictures are carried along themselves to that time (Baker et al. 2011, "A database and
evaluation methodology for optical flow", section 3.3.2). Where several arrive, each counts by how
well it explains the other picture (softmax splatting, Niklaus and Liu 2020) and by how much it
moves against the background. Both pictures are then warped backward by the result; a place that
only one of them shows receives pixels from that one alone, and is taken from it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from evsplat.errors import BackendError
from evsplat.synthesis.interpolate import Picture

try:
    import cv2
except ImportError as missing:
    raise BackendError(
        "Interpolation along optical flow needs OpenCV: pip install 'evsplat[synthesize]'."
    ) from missing

# Difference of coded values that lowers the weight of a match to 1/e.
_MATCH_SCALE = 0.04
# What moves against the background lies before it: log weight per pixel of motion, and its limit.
_FRONT_PER_PX, _FRONT_LIMIT = 1.0, 6.0
# Pixels along the longer side of the smallest pictures that OpenCV's DIS takes.
_SMALLEST_PX = 12
# Of weights between exp(-25) and exp(6), this is what no pixel has arrived with.
_NOTHING = 1e-12


@dataclass(frozen=True, eq=False)
class _Motion:
    """Way of each pixel of a picture to the other picture, and its weight."""

    flow: Float[np.ndarray, "H W 2"]
    """Pixels, x and y."""
    weight: Float[np.ndarray, "H W"]
    background: Float[np.ndarray, "2"]
    """Median motion, pixels, x and y."""


class FlowInterpolator:
    """Interpolates along optical flow (`Interpolator`)."""

    def __init__(self) -> None:
        self._dis: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        # full resolution: half a decibel on limbs a few pixels wide
        self._dis.setFinestScale(0)

    def between(
        self, before: Picture, after: Picture, fractions: Sequence[float]
    ) -> Iterator[Float[np.ndarray, "H W C"]]:
        """Linear light at each fraction of the way from ``before`` to ``after``."""
        first, second = _grey_bytes(before.coded), _grey_bytes(after.coded)
        there = _motion(before.coded, after.coded, self._flow(first, second))
        back = _motion(after.coded, before.coded, self._flow(second, first))
        for fraction in fractions:
            yield _at(before.linear, after.linear, there, back, fraction)

    def _flow(
        self, first: UInt8[np.ndarray, "H W"], second: UInt8[np.ndarray, "H W"]
    ) -> Float[np.ndarray, "H W 2"]:
        height, width = first.shape
        missing = max(0, _SMALLEST_PX - max(height, width))
        wide = (np.pad(grey, ((0, 0), (0, missing)), mode="edge") for grey in (first, second))
        flow: np.ndarray = self._dis.calc(*wide, None)
        return flow[:, :width]


def _grey_bytes(coded: Float[np.ndarray, "H W C"]) -> UInt8[np.ndarray, "H W"]:
    return (coded.mean(axis=-1).clip(0, 1) * 255 + 0.5).astype(np.uint8)


def _motion(
    here: Float[np.ndarray, "H W C"],
    there: Float[np.ndarray, "H W C"],
    flow: Float[np.ndarray, "H W 2"],
) -> _Motion:
    background = np.median(flow.reshape(-1, 2), axis=0)
    front = np.hypot(*np.moveaxis(flow - background, -1, 0)) * _FRONT_PER_PX
    mismatch = cv2.blur(np.abs(here - _warp(there, flow)).mean(axis=-1), (3, 3))
    weight = np.exp(np.minimum(front, _FRONT_LIMIT) - mismatch / _MATCH_SCALE)
    return _Motion(flow, weight, background)


def _warp(
    image: Float[np.ndarray, "H W C"], shift: Float[np.ndarray, "H W 2"]
) -> Float[np.ndarray, "H W C"]:
    """``image`` read at each pixel plus ``shift``, bilinear, the border repeated."""
    height, width = shift.shape[:2]
    x = np.arange(width, dtype=np.float32) + shift[..., 0]
    y = np.arange(height, dtype=np.float32)[:, None] + shift[..., 1]
    read = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return read.reshape(image.shape)


def _carried(motion: _Motion, part: float) -> Float[np.ndarray, "3 H W"]:
    """Weight and weighted flow of what arrives at each pixel after ``part`` of the way."""
    height, width = motion.weight.shape
    x = np.arange(width, dtype=np.float32) + part * motion.flow[..., 0]
    y = np.arange(height, dtype=np.float32)[:, None] + part * motion.flow[..., 1]
    left, top = np.floor(x), np.floor(y)
    to_right, to_bottom = x - left, y - top
    column, row = left.astype(np.int64), top.astype(np.int64)
    planes = motion.weight, motion.weight * motion.flow[..., 0], motion.weight * motion.flow[..., 1]
    sums = np.zeros((3, height * width))
    for down, down_share in ((0, 1 - to_bottom), (1, to_bottom)):
        for right, right_share in ((0, 1 - to_right), (1, to_right)):
            inside = (column >= -right) & (column < width - right)
            inside &= (row >= -down) & (row < height - down)
            place = ((row + down) * width + column + right)[inside]
            share = (down_share * right_share)[inside]
            for total, plane in zip(sums, planes, strict=True):
                total += np.bincount(place, share * plane[inside], height * width)
    return sums.reshape(3, height, width).astype(np.float32)


def _at(
    before: Float[np.ndarray, "H W C"],
    after: Float[np.ndarray, "H W C"],
    there: _Motion,
    back: _Motion,
    fraction: float,
) -> Float[np.ndarray, "H W C"]:
    first, second = _carried(there, fraction), _carried(back, 1 - fraction)
    arrived = first[0] + second[0]
    known = arrived > _NOTHING
    flow = np.stack(
        [
            np.where(
                known, (first[axis] - second[axis]) / np.maximum(arrived, _NOTHING), background
            )
            for axis, background in ((1, there.background[0]), (2, there.background[1]))
        ],
        axis=-1,
    )
    # where nothing arrives, both pictures are as good
    seen_before = np.where(known, first[0], 1) * (1 - fraction)
    seen_after = np.where(known, second[0], 1) * fraction
    share = (seen_before / (seen_before + seen_after))[..., None]
    from_before = _warp(before, -fraction * flow)
    from_after = _warp(after, (1 - fraction) * flow)
    return share * from_before + (1 - share) * from_after
