"""Pictures as data URIs, so that the page is one file."""

import base64
import io
from dataclasses import dataclass
from html import escape

import numpy as np
from jaxtyping import UInt8
from PIL import Image

_LOSSLESS_PIXELS = 6_000_000
"""Up to this many pixels in all, pictures are embedded without loss; beyond, at quality 92."""


@dataclass(frozen=True)
class Embedder:
    """Turns pictures into image elements."""

    lossless: bool

    @classmethod
    def for_pixels(cls, count: int) -> "Embedder":
        """Without loss where ``count`` pixels in all leave the page small enough."""
        return cls(lossless=count <= _LOSSLESS_PIXELS)

    def image(self, picture: UInt8[np.ndarray, "H W 3"], alt: str) -> str:
        """An image element with the picture inside."""
        buffer = io.BytesIO()
        if self.lossless:
            Image.fromarray(picture).save(buffer, "WEBP", lossless=True, quality=60, method=4)
        else:
            Image.fromarray(picture).save(buffer, "WEBP", quality=92, method=4)
        height, width = picture.shape[:2]
        return (
            f'<img src="{data_uri(buffer.getvalue(), "image/webp")}" width="{width}" '
            f'height="{height}" alt="{escape(alt)}" decoding="async">'
        )


def data_uri(content: bytes, media_type: str) -> str:
    """``content`` as a data URI."""
    return f"data:{media_type};base64,{base64.b64encode(content).decode('ascii')}"
