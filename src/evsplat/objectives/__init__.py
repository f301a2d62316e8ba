"""Losses, each a small object: which times it needs, what it compares."""

from evsplat.objectives.alpha import Alpha
from evsplat.objectives.base import Objective, Step
from evsplat.objectives.event import EventChange, event_loss
from evsplat.objectives.event_noise import EventNoise
from evsplat.objectives.event_sensor import EventSensor
from evsplat.objectives.event_windows import EventWindows
from evsplat.objectives.exposure import Exposure, motion_px, renders_for
from evsplat.objectives.held_out_windows import HeldOutWindows
from evsplat.objectives.isometry import Isometry
from evsplat.objectives.photometric import Photometric
from evsplat.objectives.pose_prior import PosePrior
from evsplat.objectives.semantic import PackedBounds, RenderedSemantics, silhouette_bounds
from evsplat.objectives.skinning import SkinningPrior

__all__ = [
    "Alpha",
    "EventChange",
    "EventNoise",
    "EventSensor",
    "EventWindows",
    "Exposure",
    "HeldOutWindows",
    "Isometry",
    "Objective",
    "PackedBounds",
    "Photometric",
    "PosePrior",
    "RenderedSemantics",
    "SkinningPrior",
    "Step",
    "event_loss",
    "motion_px",
    "renders_for",
    "silhouette_bounds",
]
