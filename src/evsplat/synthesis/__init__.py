"""From sharp footage to captures: blur by averaging in linear light, events by simulation."""

from evsplat.synthesis.pipeline import synthesize
from evsplat.synthesis.settings import RECIPES, SynthesisSettings, synthesis_settings

__all__ = ["RECIPES", "SynthesisSettings", "synthesis_settings", "synthesize"]
