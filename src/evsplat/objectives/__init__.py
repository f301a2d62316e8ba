"""Losses, each a small object: which times it needs, what it compares."""

from evsplat.objectives.base import Objective, Step
from evsplat.objectives.event import EventChange
from evsplat.objectives.event_sensor import EventNoise, EventSensor
from evsplat.objectives.event_windows import EventWindows
from evsplat.objectives.exposure import Exposure, motion_px, renders_for, sweep_px
from evsplat.objectives.held_out_windows import HeldOutWindows
from evsplat.objectives.isometry import Isometry
from evsplat.objectives.photometric import Alpha, Photometric
from evsplat.objectives.priors import DeformationPrior, PosePrior, ReliefPrior, SkinningPrior
from evsplat.objectives.semantic import PackedBounds, RenderedSemantics

__all__ = [
    "Alpha",
    "DeformationPrior",
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
    "ReliefPrior",
    "RenderedSemantics",
    "SkinningPrior",
    "Step",
    "motion_px",
    "sweep_px",
    "renders_for",
]
