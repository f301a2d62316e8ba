"""From sharp footage to captures: blur by averaging in linear light, events by simulation."""

from evsplat.options import RECIPES, SynthesisSettings
from evsplat.synthesis.pipeline import synthesize

__all__ = ["RECIPES", "SynthesisSettings", "synthesize"]
