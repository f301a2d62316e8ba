"""`evsplat inspect`: a capture or an event recording checked, in words and in pictures."""

from evsplat.inspection.belonging import Belonging, judge_body
from evsplat.inspection.body_check import (
    body_mask_overlap,
    check_body,
    fit_sheet,
    save_fit_sheet,
)
from evsplat.inspection.capture import inspect_capture, warn_of_capture
from evsplat.inspection.event_check import warn_of_events
from evsplat.inspection.folder import default_folder
from evsplat.inspection.picture_check import warn_of_pictures
from evsplat.inspection.recording import inspect, inspect_recording

__all__ = [
    "Belonging",
    "body_mask_overlap",
    "check_body",
    "default_folder",
    "fit_sheet",
    "inspect",
    "inspect_capture",
    "inspect_recording",
    "judge_body",
    "save_fit_sheet",
    "warn_of_capture",
    "warn_of_events",
    "warn_of_pictures",
]
