"""Synthetic captures: a clothed character moves in a furnished room; everything is known."""

from evsplat.options import StageSettings
from evsplat.staging.assets import characters, motions
from evsplat.staging.maker import stage

__all__ = ["StageSettings", "characters", "motions", "stage"]
