"""Person masks of a capture: for baselines that need them and for regions of the evaluation."""

from evsplat.masks.base import MASKERS, Masker
from evsplat.masks.capture import mask_capture

__all__ = ["MASKERS", "Masker", "mask_capture"]
