"""Warnings about pictures of which little can be learned: nearly black, burnt out, all the same,
repeated, or of a brightness that changes from one to the next.
"""

import filecmp
import logging
import math
from collections.abc import Sequence
from itertools import groupby, pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from tqdm import tqdm

from evsplat.calibration import Exposure, exposure
from evsplat.calibration.gain import LOOKED_AT_PX, QUARTERS, common_change
from evsplat.calibration.moving_gain import MovingGainMeter
from evsplat.capture import Frame, TrainingCapture
from evsplat.capture.finding import Finding, Findings
from evsplat.pictures.files import to_grey
from evsplat.spread import evenly_spread

logger = logging.getLogger(__name__)

_LOOKED_AT = 12
"""Frames, spread over the recording."""
_LOOKED_AT_ON_THE_WAY = 60
"""Frames of a camera that moves, which have to show much of what the next ones do."""
_BRIGHT = 0.99
"""Quantile that stands for the brightest of a picture, single lamps and glints left out."""
_DARK = 1 / 12
"""Values of 12 bits in a file of 16 reach a sixteenth, in 8 bits that many are 21 levels."""
_BURNT, _MOST_BURNT = 0.98, 0.6
"""Value from which a pixel is clipped, and share of such pixels."""
_STEADY = 1.15
"""Factor of light between two pictures up to which a camera counts as one of fixed exposure: the
flicker of lamps is near it; people who move and their shadows make none, however large."""
_MOST_REPEATS, _FEWEST_REPEATED = 3, 0.1
"""Times that a picture is repeated at most, 30 frames of a second as 120, and share of repeats from
which it is the export that made them."""
_FEW_EVENTS = 0.25
"""Share of the events between other pictures below which nothing moved between two: of an export's
repeats there are as many as ever."""
_FEWEST_USABLE = 0.1
"""Share of pixels, neither dark nor clipped, of which the brightness of a picture is told."""


def picture_findings(capture: TrainingCapture) -> list[Finding]:
    """What is wrong with the training pictures, by those of some frames."""
    frames = capture.train_frames
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(_LOOKED_AT, len(frames))).astype(int))
    looked_at = [frames[i] for i in chosen]
    bar = tqdm(looked_at, "pictures", unit="picture", leave=False, disable=None)
    pictures = [_thinned(capture.image(frame)) for frame in bar]
    grey = [to_grey(picture).numpy() for picture in pictures]
    brightest = max(float(np.quantile(picture, _BRIGHT)) for picture in grey)
    burnt = float(np.median([(picture > _BURNT).mean() for picture in grey]))
    folder = frames[0].image.parent
    findings = Findings()
    if brightest < _DARK:
        findings.warning(
            folder, "", f"pictures whose brightest values are {brightest:.1%} of the range",
            "pictures that fill their range",
            "Multiply values of 12 bits in files of 16 by 16, of 10 bits by 64; else film with "
            "more light. Figures of dark pictures look good whatever is in them.",
        )  # fmt: skip
    elif burnt > _MOST_BURNT:
        findings.warning(
            folder, "", f"{burnt:.0%} of the pixels clipped in half of the pictures",
            "pictures that are not burnt out",
            "Film with less light: no blur is known of what is clipped.",
        )  # fmt: skip
    elif len(grey) > 1 and _are_one(capture, looked_at):
        findings.warning(
            folder, "", f"the same in {len(grey)} pictures spread over the recording",
            "pictures of somebody who moves", "Check how they were exported.",
        )  # fmt: skip
    elif repeated := _repeated(capture):
        findings.warning(
            folder, "", f"{repeated} of {len(frames)} pictures that are the one before once more",
            "a picture of its own of each exposure",
            "Leave repeats out, as in a video that was exported with more frames a second than "
            "the camera took: of a repeat the person is where they were, and events say that they "
            "moved. Whatever is told of clock and thresholds is wrong until then.",
        )  # fmt: skip
    else:
        if capture.is_static_camera:
            light = [
                exposure(picture, frame.exposure_us, transfer=capture.transfer(frame))
                for picture, frame in zip(pictures, looked_at, strict=True)
            ]
            part, (factor, follows_exposure) = "three quarters of ", _brightness_changes(light)
        else:
            part, (factor, follows_exposure) = "", _changes_on_the_way(capture)
        if factor > _STEADY:
            findings.warning(
                folder, "",
                f"pictures of which some show {part}the scene {factor:.2g} times as "
                f"bright as others{', longer exposures brighter' if follows_exposure else ''}",
                "one brightness of what stands still",
                "Import the recording again, which gives each picture its gain, or give it in "
                "capture.json (docs/capture-format.md): training takes the scene to be as bright "
                "in all, and shows what changes as a mean.",
            )  # fmt: skip
    return findings.items


def _thinned(picture: Float[Tensor, "H W 3"]) -> Float[Tensor, "h w 3"]:
    """Every n-th row and column of a large picture: quantiles need no more."""
    step = math.ceil(max(picture.shape[:2]) / LOOKED_AT_PX)
    return picture[::step, ::step]


def _are_one(capture: TrainingCapture, frames: Sequence[Frame]) -> bool:
    """Whether pictures are the same in every pixel."""
    first = capture.image(frames[0])
    return all(torch.equal(first, capture.image(frame)) for frame in frames[1:])


def _repeated(capture: TrainingCapture) -> int:
    """Pictures whose file is that of the one before, byte for byte, again and again.

    Whoever stands still before a camera without noise makes long runs of equal pictures, and
    exports with too many frames a second short ones throughout. 0 where they are no such pattern,
    as where somebody left shortly before the end, or where events say that nothing moved.
    """
    pairs = list(pairwise(capture.train_frames))
    same = [filecmp.cmp(one.image, other.image, shallow=False) for one, other in pairs]
    runs = [len(list(run)) for equal, run in groupby(same) if equal]
    short = [run for run in runs if run <= _MOST_REPEATS]
    if len(short) < 2 or sum(short) < max(3, _FEWEST_REPEATED * (len(pairs) + 1)):
        return 0
    return 0 if _events_pause(capture, pairs, np.array(same)) else sum(short)


def _events_pause(
    capture: TrainingCapture, pairs: Sequence[tuple[Frame, Frame]], same: Bool[np.ndarray, "P"]
) -> bool:
    """Whether hardly an event came between pictures that are equal, beside others."""
    events = capture.events
    if events is None or not len(events):
        return False
    counts = np.full(len(pairs), np.nan)
    for index, (one, other) in enumerate(pairs):
        stretch = events.readable_around(one.mid_us)
        if stretch == events.readable_around(other.mid_us):
            counts[index] = len(events.between(one.mid_us, other.mid_us))
    between_equal, between_others = (counts[part & ~np.isnan(counts)] for part in (same, ~same))
    if not len(between_equal) or not len(between_others):
        return False
    return bool(np.median(between_equal) < _FEW_EVENTS * np.median(between_others))


def _brightness_changes(pictures: Sequence[Exposure]) -> tuple[float, bool]:
    """Factor from the darkest to the brightest picture by what three quarters of the pixels change
    by at least (`common_change`), and whether longer exposures are the brighter ones.
    """
    light = np.stack([picture.log_luminance for picture in pictures])
    usable = np.stack([picture.usable for picture in pictures])
    usual = np.median(light, axis=0)
    levels, exposures_us = [], []
    for values, of_use, picture in zip(light, usable, pictures, strict=True):
        if of_use.mean() < _FEWEST_USABLE:
            continue
        levels.append(float(common_change(*np.quantile((values - usual)[of_use], QUARTERS))))
        exposures_us.append(picture.span_us[1] - picture.span_us[0])
    return _factor(levels, exposures_us)


def _changes_on_the_way(capture: TrainingCapture) -> tuple[float, bool]:
    """The same of a camera that moves, by pictures laid over those next to them."""
    frames = evenly_spread(capture.train_frames, _LOOKED_AT_ON_THE_WAY)
    meter = MovingGainMeter()
    for frame in tqdm(frames, "pictures", unit="picture", leave=False, disable=None):
        meter.add(capture.image(frame).numpy(), capture.transfer(frame))
    gains = meter.gains()
    levels = [0.0] if gains is None else np.log(gains).mean(1).tolist()
    return _factor(levels, [frame.exposure_us[1] - frame.exposure_us[0] for frame in frames])


def _factor(levels: Sequence[float], exposures_us: Sequence[int]) -> tuple[float, bool]:
    """From the least to the largest of levels, logarithms; whether they grow with exposures."""
    if len(levels) < 2:
        return 1.0, False
    factor = float(np.exp(max(levels) - min(levels)))
    if np.ptp(levels) == 0 or np.ptp(exposures_us) == 0:
        return factor, False
    return factor, bool(np.corrcoef(levels, np.log(exposures_us))[0, 1] > 0.7)


def warn_of_pictures(capture: TrainingCapture) -> None:
    """Log what `picture_findings` finds."""
    for finding in picture_findings(capture):
        logger.warning("%s", finding)
