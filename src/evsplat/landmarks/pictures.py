"""Sharp pictures of a capture: at several instants of each exposure, and between exposures.

The event double integral (`evsplat.events.edi`) gives the picture at any instant of an exposure.
With the events between, it is carried on to times of which there is no picture; from the exposure
before and from the one after, which are blended by how many events each has passed through.
"""

import logging
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy.ndimage import gaussian_filter
from torch import Tensor

from evsplat.capture import Frame, TrainingCapture, estimate_sensor
from evsplat.errors import HeldOutError
from evsplat.events import EventStream, deblur, polarity_counts
from evsplat.pictures import shown
from evsplat.pictures.light import Transfer, decode, encode, luminance, transfer_shown

logger = logging.getLogger(__name__)

FRACTIONS = (0.05, 0.5, 0.95)
"""Instants of an exposure whose sharp pictures are taken."""
CARRIED_SIGMA, BLURRY_SIGMA = 1.6, 2.0
_SMOOTHING_PX = 1.0
"""Counts of events are smoothed before they become weights: single ones are noise."""


@dataclass(frozen=True, eq=False)
class SharpPicture:
    """What the camera would have seen at an instant."""

    time_us: int
    image: Float[Tensor, "H W 3"]
    """sRGB-coded, float32 in [0, 1]."""
    frame: Frame
    """The frame in whose exposure the instant lies; held out where the picture was carried."""
    sigma: float
    """Factor on the expected error of landmarks: 1 within an exposure, `CARRIED_SIGMA` where there
    is no picture of that time, `BLURRY_SIGMA` where the picture is as blurry as it was recorded."""
    doubt: Float[Tensor, "H W"] | None = None
    """Expected squared error of coded luminance where two exposures were carried there: what they
    differ by, weighted as in their blend."""


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
    thresholds = _thresholds(capture)
    if thresholds is None:
        blurry = [frame for frame in frames if frame.split == "train"]
        return [
            SharpPicture(
                frame.mid_us,
                shown(capture.image(frame), capture.transfer(frame)),
                frame,
                BLURRY_SIGMA,
            )
            for frame in sorted(blurry, key=lambda frame: frame.mid_us)
        ]
    pictures = [
        picture
        for frame in frames
        for picture in (
            _in_exposure(capture, frame, fractions, thresholds)
            if frame.split == "train"
            else _carried(capture, frame, fractions, thresholds)
        )
    ]
    return sorted(pictures, key=lambda picture: picture.time_us)


def _thresholds(capture: TrainingCapture) -> tuple[float, float] | None:
    """C+ and C-, given or estimated; None where nothing can be sharpened, which is logged."""
    if capture.events is None or len(capture.events) == 0:
        reason = "it has no events"
    elif not capture.events.has_polarity:
        reason = "its events have no polarity"
    elif capture.contrast_threshold is not None:
        return capture.contrast_threshold
    else:
        estimate = estimate_sensor(capture)
        if estimate is not None and estimate.thresholds is not None:
            return estimate.thresholds.plus, estimate.thresholds.minus
        reason = "its contrast thresholds are unknown and cannot be estimated"
    logger.warning("%s: %s, so landmarks are found in its blurry pictures.", capture.path, reason)
    return None


def _instants(frame: Frame, fractions: Sequence[float]) -> list[int]:
    start, end = frame.exposure_us
    return [start + int(fraction * (end - start)) for fraction in fractions]


def _in_exposure(
    capture: TrainingCapture,
    frame: Frame,
    fractions: Sequence[float],
    thresholds: tuple[float, float],
) -> Iterator[SharpPicture]:
    """The pictures of a training frame's own exposure."""
    assert capture.events is not None
    times = _instants(frame, fractions)
    events = capture.events.between(*frame.exposure_us)
    images = deblur(
        capture.image(frame),
        events,
        frame.exposure_us,
        times,
        thresholds,
        transfer=capture.transfer(frame),
    )
    for time, image in zip(times, images, strict=True):
        yield SharpPicture(time, shown(image, capture.transfer(frame)), frame, 1.0)


def _carried(
    capture: TrainingCapture,
    frame: Frame,
    fractions: Sequence[float],
    thresholds: tuple[float, float],
) -> Iterator[SharpPicture]:
    """Pictures within the exposure of a held-out frame, from training exposures beside it."""
    for time in _instants(frame, fractions):
        sources = [
            source
            for side in _beside(capture, frame, time)
            if (source := _carry(capture, side, time, thresholds)) is not None
        ]
        if sources:
            image, doubt = _blend(sources, capture.transfer(frame))
            yield SharpPicture(time, image, frame, CARRIED_SIGMA, doubt)


def _beside(capture: TrainingCapture, frame: Frame, time_us: int) -> list[Frame]:
    """The last training frame of the same camera before an instant and the first one after it."""
    own = [other for other in capture.train_frames if other.camera == frame.camera]
    own.sort(key=lambda other: other.mid_us)
    after = bisect_right([other.mid_us for other in own], time_us)
    return own[max(0, after - 1) : after + 1]


_Source = tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"]]


def _carry(
    capture: TrainingCapture, frame: Frame, time_us: int, thresholds: tuple[float, float]
) -> _Source | None:
    """A training picture carried to an instant, and events per pixel that it passed through.

    None where the policy hides some of these events.
    """
    assert capture.events is not None
    start, end = frame.exposure_us
    try:
        events: EventStream = capture.events.between(min(start, time_us), max(end, time_us))
    except HeldOutError:
        return None
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
