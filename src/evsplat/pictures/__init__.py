"""Pictures: light and coded values, 8-bit colours, files and videos."""

from evsplat.pictures.colours import error_map, signed_map, to_bytes
from evsplat.pictures.light import (
    BT601,
    CodedPictures,
    Transfer,
    chroma,
    decode,
    encode,
    log_brightness,
    log_brightness_change,
    log_luminance,
    luminance,
    mean_light,
    shown,
    stored,
)

__all__ = [
    "BT601",
    "CodedPictures",
    "Transfer",
    "chroma",
    "decode",
    "encode",
    "error_map",
    "log_brightness",
    "log_brightness_change",
    "log_luminance",
    "luminance",
    "mean_light",
    "shown",
    "signed_map",
    "stored",
    "to_bytes",
]
