"""Body poses from the pictures and events of one camera."""

from evsplat.posing.fit import PoseFit, fit_landmarks
from evsplat.posing.problem import FitSettings
from evsplat.posing.rig import Rig, default_rig

__all__ = ["FitSettings", "PoseFit", "Rig", "default_rig", "fit_landmarks"]
