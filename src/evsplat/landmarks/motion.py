"""Where something moves before a static background: start boxes for the search of the person."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import (
    binary_closing,
    binary_opening,
    find_objects,
    gaussian_filter,
    label,
)
from torch import Tensor
from tqdm import tqdm

from evsplat.capture import Frame, TrainingCapture
from evsplat.events import EventStream, polarity_counts
from evsplat.masks.background import THRESHOLD, difference

JOINED = 3
"""Frames before and after whose motion is joined: the median background holds limbs that stay."""
_EVENT_SHARE = 0.25
"""A pixel moves where it has this share of the events of the busiest percent of pixels."""
_SMOOTHING_PX = 1.5
_STILL, _USUAL = 0.2, 75
"""Less than this share of the pixels that move in a frame of this percentile is next to nothing."""
_LEAST_AREA = 0.002
"""Pieces smaller than this share of the picture are noise."""


@dataclass(frozen=True)
class Bounds:
    """From (x0, y0) to before (x1, y1), pixels and parts of them; may reach beyond the picture."""

    x0: float
    y0: float
    x1: float
    y1: float

    @property
    def centre(self) -> Float[np.ndarray, "2"]:
        """Its middle."""
        return np.array([self.x0 + self.x1, self.y0 + self.y1]) / 2

    @property
    def side(self) -> float:
        """Its longer side."""
        return max(self.x1 - self.x0, self.y1 - self.y0)

    def grown(self, share: float) -> "Bounds":
        """Enlarged on each side by a share of its own extent."""
        dx, dy = share * (self.x1 - self.x0), share * (self.y1 - self.y0)
        return Bounds(self.x0 - dx, self.y0 - dy, self.x1 + dx, self.y1 + dy)


class Motion:
    """What moves at each training frame of a capture."""

    def __init__(self, capture: TrainingCapture) -> None:
        self.frames: list[Frame] = sorted(capture.train_frames, key=lambda frame: frame.mid_us)
        self.background: Float[Tensor, "H W 3"] = capture.median_background()
        self._mids = np.array([frame.mid_us for frame in self.frames])
        self._shape = self.background.shape[0], self.background.shape[1]
        shares, own = np.empty(len(self.frames)), []
        bar = tqdm(self.frames, "motion", unit="picture", leave=False, disable=None)
        for index, frame in enumerate(bar):
            moving = self._moving(capture, frame)
            shares[index] = moving.mean()
            own.append(np.packbits(moving))
        # A bit a pixel: of long recordings of large pictures bytes would be gigabytes.
        self._maps = [
            np.bitwise_or.reduce(own[max(0, k - JOINED) : k + JOINED + 1]) for k in range(len(own))
        ]
        self._still = shares < _STILL * np.percentile(shares, _USUAL)
        self._pieces: dict[int, list[Bounds]] = {}

    def nearest(self, time_us: int) -> int:
        """Index of the training frame nearest in time."""
        return int(np.abs(self._mids - time_us).argmin())

    def moving(self, time_us: int) -> Bool[np.ndarray, "H W"]:
        """Pixels that move about a time."""
        return self._map(self.nearest(time_us))

    def boxes(self, time_us: int) -> list[Bounds]:
        """Boxes of the pieces that move about a time, the largest area first; may be none."""
        index = self.nearest(time_us)
        if index not in self._pieces:
            self._pieces[index] = pieces(self._map(index))
        return self._pieces[index]

    def moves_little(self, time_us: int) -> bool:
        """Whether next to nothing moves in the training frame nearest in time, beside others.

        The median of a recording in which the person is half of the time holds some of them.
        """
        return bool(self._still[self.nearest(time_us)])

    def _map(self, index: int) -> Bool[np.ndarray, "H W"]:
        """Pixels that move in a training frame or one of those about it."""
        height, width = self._shape
        bits = np.unpackbits(self._maps[index], count=height * width)
        return bits.view(np.bool_).reshape(height, width)

    def _moving(self, capture: TrainingCapture, frame: Frame) -> Bool[np.ndarray, "H W"]:
        """Differences to the background, and pixels with many events during the exposure."""
        moving = binary_opening(difference(capture.image(frame), self.background, THRESHOLD))
        if capture.events is None:
            return moving
        return moving | _busy(capture.events.between(*frame.exposure_us), *moving.shape)


def _busy(events: EventStream, height: int, width: int) -> Bool[np.ndarray, "H W"]:
    counts = gaussian_filter(polarity_counts(events, height, width).sum(0).numpy(), _SMOOTHING_PX)
    many = np.percentile(counts, 99)
    busy: np.ndarray = counts > max(_EVENT_SHARE * many, 0.5)
    return busy


def pieces(moving: Bool[np.ndarray, "H W"]) -> list[Bounds]:
    """Boxes of connected pieces, largest area first; gaps of a few pixels are bridged."""
    height, width = moving.shape
    bridge = max(1, round(0.012 * max(height, width)))
    closed = binary_closing(np.pad(moving, 2 * bridge), iterations=bridge)
    labels, count = label(closed[2 * bridge : -2 * bridge, 2 * bridge : -2 * bridge])
    areas = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    spans = find_objects(labels)
    found = []
    for index in np.argsort(-areas):
        if areas[index] >= _LEAST_AREA * height * width:
            rows, columns = spans[index]
            found.append(Bounds(columns.start, rows.start, columns.stop, rows.stop))
    return found


def global_shift(
    before: Float[Tensor, "H W 3"], after: Float[Tensor, "H W 3"], still: Bool[np.ndarray, "H W"]
) -> tuple[float, float]:
    """Pixels (x, y) by which the ``still`` part of a picture moved, to whole pixels.

    By phase correlation (Kuglin and Hines, 1975) of what is finer than 4 pixels, so that the rim
    of the part says nothing.
    """
    spectra = [np.fft.fft2(_detail(picture, still)) for picture in (before, after)]
    cross = spectra[1] * spectra[0].conj()
    peak = np.fft.ifft2(cross / np.maximum(np.abs(cross), 1e-9)).real
    row, column = np.unravel_index(int(peak.argmax()), peak.shape)
    height, width = peak.shape
    return float((column + width // 2) % width - width // 2), float(
        (row + height // 2) % height - height // 2
    )


def _detail(picture: Float[Tensor, "H W 3"], still: Bool[np.ndarray, "H W"]) -> np.ndarray:
    """Fine structure of the luminance where ``still``, fading out at its rim and the border's."""
    grey = picture.mean(-1).numpy().astype(np.float64)
    weight = gaussian_filter(still.astype(np.float64), 4)
    smooth = gaussian_filter(grey * still, 4) / np.maximum(weight, 1e-3)
    window = np.outer(np.hanning(len(grey)), np.hanning(grey.shape[1]))
    detail: np.ndarray = (grey - smooth) * still * weight * window
    return detail
