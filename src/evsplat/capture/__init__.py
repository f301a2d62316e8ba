"""Captures: recordings on disk, read, checked and written; what of them a training may see."""

from evsplat.camera import Camera
from evsplat.capture.body_file import BodyFile
from evsplat.capture.body_track import load_body_track
from evsplat.capture.capture import Capture, load_capture
from evsplat.capture.coded import coded
from evsplat.capture.finding import Finding
from evsplat.capture.metadata import Frame
from evsplat.capture.policy import Policy
from evsplat.capture.sensor_estimate import (
    estimate_sensor,
    lost_events,
    shared_pairs,
    warn_of_contrast,
)
from evsplat.capture.training_capture import TrainingCapture
from evsplat.capture.validate import validate_capture
from evsplat.capture.write import CaptureWriter

__all__ = [
    "BodyFile",
    "Camera",
    "Capture",
    "CaptureWriter",
    "Finding",
    "Frame",
    "Policy",
    "TrainingCapture",
    "coded",
    "estimate_sensor",
    "warn_of_contrast",
    "load_body_track",
    "load_capture",
    "lost_events",
    "shared_pairs",
    "validate_capture",
]
