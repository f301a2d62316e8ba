"""From sharp footage to captures: blur by averaging in linear light, events by simulation."""

from evsplat.options import SynthesisSettings
from evsplat.synthesis.pipeline import synthesize

__all__ = ["SynthesisSettings", "synthesize"]
