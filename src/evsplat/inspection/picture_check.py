"""Warnings about pictures of which little can be learned: nearly black, burnt out, all the same."""

import logging

import numpy as np

from evsplat.capture import TrainingCapture
from evsplat.capture.finding import Finding, Findings
from evsplat.pictures.files import to_grey

logger = logging.getLogger(__name__)

_LOOKED_AT = 12
"""Frames, spread over the recording."""
_BRIGHT = 0.99
"""Quantile that stands for the brightest of a picture, single lamps and glints left out."""
_DARK = 1 / 12
"""Values of 12 bits in a file of 16 reach a sixteenth, in 8 bits that many are 21 levels."""
_BURNT, _MOST_BURNT = 0.98, 0.6
"""Value from which a pixel is clipped, and share of such pixels."""


def picture_findings(capture: TrainingCapture) -> list[Finding]:
    """What is wrong with the training pictures, by those of some frames."""
    frames = capture.train_frames
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(_LOOKED_AT, len(frames))).astype(int))
    grey = [to_grey(capture.image(frames[i])).numpy() for i in chosen]
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
    elif len(grey) > 1 and all(np.array_equal(grey[0], other) for other in grey[1:]):
        findings.warning(
            folder, "", f"the same in {len(grey)} pictures spread over the recording",
            "pictures of somebody who moves", "Check how they were exported.",
        )  # fmt: skip
    return findings.items


def warn_of_pictures(capture: TrainingCapture) -> None:
    """Log what `picture_findings` finds."""
    for finding in picture_findings(capture):
        logger.warning("%s", finding)
