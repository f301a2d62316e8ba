"""Pictures: light and coded values, 8-bit colours, files and videos."""

from evsplat.pictures.colours import error_map, signed_map, to_bytes
from evsplat.pictures.light import (
    CodedPictures,
    Transfer,
    chroma,
    decode,
    encode,
    log_brightness,
    log_brightness_change,
    luminance,
    shown,
    stored,
)

__all__ = [
    "CodedPictures",
    "Transfer",
    "chroma",
    "decode",
    "encode",
    "error_map",
    "log_brightness",
    "log_brightness_change",
    "luminance",
    "shown",
    "signed_map",
    "stored",
    "to_bytes",
]
