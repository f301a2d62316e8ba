"""Synthetic captures: a clothed character moves in a furnished room; everything is known."""

from evsplat.staging.assets import characters, motions
from evsplat.staging.maker import stage
from evsplat.staging.settings import StageSettings

__all__ = ["StageSettings", "characters", "motions", "stage"]
