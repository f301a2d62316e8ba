"""`evsplat poses`: body poses from the pictures and events of one camera."""

from evsplat.posing.find import FoundPoses, find_poses
from evsplat.posing.fit import PoseFit, fit_landmarks
from evsplat.posing.problem import FitSettings
from evsplat.posing.rig import Rig, default_rig

__all__ = [
    "FitSettings",
    "FoundPoses",
    "PoseFit",
    "Rig",
    "default_rig",
    "find_poses",
    "fit_landmarks",
]
