"""Sharp pictures of a capture: at several instants of each exposure, and between exposures.

The event double integral (`evsplat.events.edi`) gives the picture at any instant of an exposure.
With the events between, it is carried on to times of which there is no picture; from the exposure
before and from the one after, which are blended by how many events each has passed through.
"""

import logging
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import torch
from jaxtyping import Float
from scipy.ndimage import gaussian_filter
from torch import Tensor

from evsplat.camera import Camera
from evsplat.capture import Frame, TrainingCapture, estimate_sensor
from evsplat.errors import HeldOutError
from evsplat.events import EventStore, deblur, polarity_counts
from evsplat.pictures import shown
from evsplat.pictures.light import Transfer, decode, encode, luminance, transfer_shown

logger = logging.getLogger(__name__)

FRACTIONS = (0.05, 0.5, 0.95)
"""Instants of an exposure whose sharp pictures are taken."""
CARRIED_SIGMA, BLURRY_SIGMA = 1.6, 2.0
_SMOOTHING_PX = 1.0
"""Counts of events are smoothed before they become weights: single ones are noise."""
_KEPT_FRAMES = 8
"""Frames whose pictures are kept: most are looked at in order of time."""


Made = tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"] | None]
"""A picture and its doubt, see `SharpPicture`."""


def sharp_pixels(camera: Camera) -> int:
    """Pixels of the sharp pictures that are taken of one frame."""
    return len(FRACTIONS) * camera.width * camera.height


@dataclass(frozen=True, eq=False)
class SharpPicture:
    """What the camera would have seen at an instant, made when it is looked at."""

    time_us: int
    frame: Frame
    """The frame in whose exposure the instant lies; held out where the picture was carried."""
    sigma: float
    """Factor on the expected error of landmarks: 1 within an exposure, `CARRIED_SIGMA` where there
    is no picture of that time, `BLURRY_SIGMA` where the picture is as blurry as it was recorded."""
    make: Callable[[], Made]
    """Gives `image` and `doubt`: those of a long recording are too many to be kept."""

    @property
    def image(self) -> Float[Tensor, "H W 3"]:
        """sRGB-coded, float32 in [0, 1]."""
        return self.make()[0]

    @property
    def doubt(self) -> Float[Tensor, "H W"] | None:
        """Expected squared error of coded luminance where two exposures were carried there: what
        they differ by, weighted as in their blend.
        """
        return self.make()[1]


def sharp_pictures(
    capture: TrainingCapture,
    *,
    fractions: Sequence[float] = FRACTIONS,
    frames: Sequence[Frame] | None = None,
) -> list[SharpPicture]:
    """Sharp pictures in order of time, at ``fractions`` (0..1) of every exposure.

    ``frames``: those whose exposures count, None for all.

    Those of held-out frames are carried there by events from training exposures on both sides, and
    left out where the policy hides these events. Where there are no events with polarity, or no
    contrast thresholds and none can be estimated, they are the blurry training pictures at their
    mid-exposures; the log says so.
    """
    frames = capture.frames if frames is None else frames
    sharpener = _Sharpener(capture, fractions, _thresholds(capture))
    pictures = [picture for frame in frames for picture in sharpener.pictures(frame)]
    return sorted(pictures, key=lambda picture: picture.time_us)


def _thresholds(capture: TrainingCapture) -> tuple[float, float] | None:
    """C+ and C-, given or estimated; None where nothing can be sharpened, which is logged."""
    if capture.events is None or len(capture.events) == 0:
        reason = "there are no events"
    elif not capture.events.has_polarity:
        reason = "the events have no polarity"
    elif capture.contrast_threshold is not None:
        return capture.contrast_threshold
    else:
        estimate = estimate_sensor(capture)
        if estimate is not None and estimate.thresholds is not None:
            return estimate.thresholds.plus, estimate.thresholds.minus
        reason = "contrast thresholds are unknown and cannot be estimated"
    logger.warning("images: %s, so poses are looked for in the blurry pictures.", reason)
    return None


def _instants(frame: Frame, fractions: Sequence[float]) -> list[int]:
    start, end = frame.exposure_us
    return [start + int(fraction * (end - start)) for fraction in fractions]


class _Sharpener:
    """Pictures of a capture's exposures, of which those looked at last are kept."""

    def __init__(
        self,
        capture: TrainingCapture,
        fractions: Sequence[float],
        thresholds: tuple[float, float] | None,
    ) -> None:
        """``thresholds``: C+ and C-; without them nothing is sharpened."""
        self._capture, self._fractions, self._thresholds = capture, fractions, thresholds
        self._made = lru_cache(_KEPT_FRAMES)(self._make)
        self._trained: dict[str, list[Frame]] = {}
        for frame in sorted(capture.train_frames, key=lambda frame: frame.mid_us):
            self._trained.setdefault(frame.camera, []).append(frame)

    def pictures(self, frame: Frame) -> list[SharpPicture]:
        """Of one frame, those that can be made of what the policy shows."""
        if self._thresholds is None:
            times, sigma = [frame.mid_us] if frame.split == "train" else [], BLURRY_SIGMA
        elif frame.split == "train":
            times, sigma = _instants(frame, self._fractions), 1.0
        else:
            times, sigma = _instants(frame, self._fractions), CARRIED_SIGMA
            times = [time for time in times if self._sources(frame, time)]
        return [
            SharpPicture(time, frame, sigma, partial(self._one, frame, tuple(times), number))
            for number, time in enumerate(times)
        ]

    def _one(self, frame: Frame, times: tuple[int, ...], number: int) -> Made:
        return self._made(frame, times)[number]

    def _make(self, frame: Frame, times: tuple[int, ...]) -> list[Made]:
        make = self._in_exposure if frame.split == "train" else self._carried
        return make(frame, times)

    def _in_exposure(self, frame: Frame, times: Sequence[int]) -> list[Made]:
        """The pictures of a training frame's own exposure."""
        capture = self._capture
        image, transfer = capture.image(frame), capture.transfer(frame)
        if self._thresholds is None:
            return [(shown(image, transfer), None)]
        assert capture.events is not None
        images = deblur(
            image,
            capture.events.between(*frame.exposure_us),
            frame.exposure_us,
            times,
            self._thresholds,
            transfer=transfer,
        )
        return [(shown(image, transfer), None) for image in images]

    def _carried(self, frame: Frame, times: Sequence[int]) -> list[Made]:
        """Pictures within the exposure of a held-out frame, from training exposures beside it."""
        capture, thresholds = self._capture, self._thresholds
        assert thresholds is not None
        return [
            _blend(
                [_carry(capture, side, time, thresholds) for side in self._sources(frame, time)],
                capture.transfer(frame),
            )
            for time in times
        ]

    def _sources(self, frame: Frame, time_us: int) -> list[Frame]:
        """The frames of `_beside` from which the policy shows all events to an instant."""
        events = self._capture.events
        assert events is not None
        beside = _beside(self._trained.get(frame.camera, []), time_us)
        return [side for side in beside if _reads(events, *_passed(side, time_us))]


def _passed(frame: Frame, time_us: int) -> tuple[int, int]:
    """The stretch from a frame's exposure to an instant, with both."""
    start, end = frame.exposure_us
    return min(start, time_us), max(end, time_us)


def _reads(events: EventStore, start_us: int, end_us: int) -> bool:
    """Whether the policy shows all events of a stretch."""
    try:
        return end_us <= events.readable_around(start_us)[1]
    except HeldOutError:
        return False


def _beside(frames: Sequence[Frame], time_us: int) -> Sequence[Frame]:
    """The last of frames in order of time before an instant and the first one after it."""
    after = bisect_right(frames, time_us, key=lambda frame: frame.mid_us)
    return frames[max(0, after - 1) : after + 1]


_Source = tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"]]


def _carry(
    capture: TrainingCapture, frame: Frame, time_us: int, thresholds: tuple[float, float]
) -> _Source:
    """A training picture carried to an instant, and events per pixel that it passed through."""
    assert capture.events is not None
    events = capture.events.between(*_passed(frame, time_us))
    image = capture.image(frame)
    (carried,) = deblur(
        image,
        events,
        frame.exposure_us,
        [time_us],
        thresholds,
        transfer=capture.transfer(frame),
    )
    counts = polarity_counts(events, *image.shape[:2]).sum(0)
    carried = shown(carried, capture.transfer(frame))
    return carried, torch.from_numpy(gaussian_filter(counts.numpy(), _SMOOTHING_PX))


def _blend(sources: Sequence[_Source], transfer: Transfer) -> _Source:
    """The mean weighted per pixel by the inverse square of one and the events passed through.

    Each event adds the error of its threshold, and events change brightness but not hue, so that
    the side on which less happened is the better one by far. The second is the variance of coded
    luminance.
    """
    weights = torch.stack([(1 + passed) ** -2 for _, passed in sources])
    weights /= weights.sum(0)
    images = torch.stack([image for image, _ in sources])
    mean = (images * weights[..., None]).sum(0)
    coded = transfer_shown(transfer)
    grey = encode(luminance(decode(images, coded)), coded)
    off = (grey - (grey * weights).sum(0)).square()
    return mean, (off * weights).sum(0)
