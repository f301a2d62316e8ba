"""When the shutter is open, and at which instants the scene is drawn."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64

_FEWEST = 16
"""Sub-frames of an exposure, however short."""


@dataclass(frozen=True, eq=False)
class FrameTimes:
    """The instants of one frame period; microseconds."""

    start_us: int
    end_us: int
    """Of the exposure."""
    exposure: Int64[np.ndarray, "N"]
    """Middles of equal parts of the exposure: the mean of these pictures is the blurry one."""
    after: Int64[np.ndarray, "M"]
    """Middles of equal parts of the time until the next exposure; they only make events."""

    @property
    def mid_us(self) -> int:
        """The middle of the exposure."""
        return (self.start_us + self.end_us) // 2


def frame_times(
    frames: int, fps: float, exposure_ms: float, subframe_hz: float
) -> list[FrameTimes]:
    """All instants of a recording that starts at 0."""
    starts = np.round(np.arange(frames + 1) * 1e6 / fps).astype(np.int64)
    exposure_us = min(round(exposure_ms * 1000), int(np.diff(starts).min()))
    result = []
    for start, following in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True):
        end = start + exposure_us
        step_us = 1e6 / subframe_hz
        parts = max(int(np.ceil(exposure_us / step_us - 1e-6)), min(_FEWEST, exposure_us))
        rest = int(np.ceil((following - end) / step_us - 1e-6))
        result.append(
            FrameTimes(start, end, _middles(start, end, parts), _middles(end, following, rest))
        )
    return result


def _middles(start: int, end: int, parts: int) -> Int64[np.ndarray, "N"]:
    steps = (np.arange(parts) + 0.5) * ((end - start) / max(parts, 1))
    return start + np.floor(steps).astype(np.int64)
