"""From light to what the camera stores: transfer curve, luminance, brightness change, EDI."""

from evsplat.imaging.edi import deblur
from evsplat.imaging.events import log_brightness, log_brightness_change
from evsplat.imaging.srgb import Transfer, decode, encode, luminance

__all__ = [
    "Transfer",
    "deblur",
    "decode",
    "encode",
    "log_brightness",
    "log_brightness_change",
    "luminance",
]
