"""`evsplat inspect`: a capture or an event recording checked, in words and in pictures."""

from evsplat.inspection.capture import InspectReport, body_mask_overlap, inspect_capture
from evsplat.inspection.recording import inspect, inspect_recording

__all__ = [
    "InspectReport",
    "body_mask_overlap",
    "inspect",
    "inspect_capture",
    "inspect_recording",
]
