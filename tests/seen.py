"""A capture as methods see it."""

from pathlib import Path
from typing import Any

from evsplat.capture import Capture, Policy, TrainingCapture, load_capture


def seen(capture: Capture | Path, **policy: Any) -> TrainingCapture:
    """What a training sees of a capture under the strict terms, changed by ``policy``."""
    if not isinstance(capture, Capture):
        capture = load_capture(capture)
    return capture.for_training(Policy(**policy))
