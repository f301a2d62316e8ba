"""A capture as methods see it."""

from pathlib import Path
from typing import Any

import numpy as np

from evsplat.capture import Capture, Policy, TrainingCapture, load_capture


def seen(capture: Capture | Path, **policy: Any) -> TrainingCapture:
    """What a training sees of a capture under the strict terms, changed by ``policy``."""
    if not isinstance(capture, Capture):
        capture = load_capture(capture)
    return capture.for_training(Policy(**policy))


def changes_much(path: Path, first: int, last: int) -> bool:
    """Whether light doubles and more, or halves, at 45 pixels from one frame to another.

    Of a tiny capture it depends on what its random background is like behind the arm.
    """
    capture = load_capture(path)
    light = [
        capture.image(capture.frames[index]).numpy().astype(np.float64) ** 2.2
        @ (0.2126, 0.7152, 0.0722)
        for index in (first, last)
    ]
    return int((np.abs(np.log(light[1] / light[0])) > 0.8).sum()) >= 45
