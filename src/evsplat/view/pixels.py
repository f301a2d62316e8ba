"""Arithmetic on pictures: divided views, what is laid over them.

Pictures are float32 (H, W, 3), sRGB in [0, 1].
"""

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw

from evsplat.inspection.drawing import BRIGHTER, DARKER, font
from evsplat.view.camera import Box

_FULL_STRENGTH = 3
"""Events at one pixel that hide what is below them."""
Picture = Float[np.ndarray, "H W 3"]


def events_on(picture: Picture, counts: Float[np.ndarray, "h w"], box: Box) -> None:
    """Lay signed event counts over the part ``box`` of a picture: red brighter, blue darker."""
    strength = (np.abs(counts) / _FULL_STRENGTH).clip(0, 1) ** 0.5
    brighter, darker = (np.array(colour, np.float32) / 255 for colour in (BRIGHTER, DARKER))
    colour = np.where(counts[..., None] > 0, brighter, darker)
    layer = np.concatenate([colour * strength[..., None], strength[..., None]], -1)
    rows, columns, placed = _placed(layer, box, picture.shape, smooth=False)
    below = picture[rows, columns]
    below *= 1 - placed[..., 3:]
    below += placed[..., :3]


def paste(picture: Picture, other: Picture, box: Box) -> None:
    """Put a picture into the part ``box`` of another."""
    rows, columns, placed = _placed(other, box, picture.shape, smooth=True)
    picture[rows, columns] = placed


def dim_outside(picture: Picture, box: Box, factor: float = 0.45) -> None:
    """Darken what a recording camera did not see."""
    top, bottom = round(box.top), round(box.top + box.height)
    left, right = round(box.left), round(box.left + box.width)
    picture[:top] *= factor
    picture[bottom:] *= factor
    picture[top:bottom, :left] *= factor
    picture[top:bottom, right:] *= factor


def divided(left: Picture, right: Picture, share: float) -> Picture:
    """The left picture up to a share of the width, then the right one, with a line between."""
    column = round(share * left.shape[1])
    joined = right.copy()
    joined[:, :column] = left[:, :column]
    if 0 < column < left.shape[1]:
        joined[:, max(0, column - 1) : column + 1] = 1
    return joined


def to_bytes(picture: Picture) -> UInt8[np.ndarray, "H W 3"]:
    """8-bit values."""
    return (picture.clip(0, 1) * 255 + 0.5).astype(np.uint8)


def with_labels(
    pixels: UInt8[np.ndarray, "H W 3"], labels: list[tuple[float, str]]
) -> UInt8[np.ndarray, "H W 3"]:
    """Short texts at the top of a picture, each with the share of the width where it begins."""
    if not labels:
        return pixels
    image = Image.fromarray(pixels)
    draw = ImageDraw.Draw(image, "RGBA")
    size = max(11, round(image.height / 42))
    for share, text in labels:
        x, y = share * image.width + 0.8 * size, 0.8 * size
        left, top, right, bottom = draw.textbbox((x, y), text, font=font(size))
        pad = 0.45 * size
        corners = (left - pad, top - pad, right + pad, bottom + pad)
        draw.rounded_rectangle(corners, radius=0.4 * size, fill=(16, 20, 26, 170))
        draw.text((x, y), text, font=font(size), fill=(255, 255, 255, 255))
    return np.asarray(image)


def _placed(
    layer: Float[np.ndarray, "h w c"], box: Box, shape: tuple[int, ...], *, smooth: bool
) -> tuple[slice, slice, Float[np.ndarray, "rows columns c"]]:
    """The part of a picture of ``shape`` that the box covers, and the layer at its pixels."""
    top, left = max(0, round(box.top)), max(0, round(box.left))
    bottom = min(shape[0], round(box.top + box.height))
    right = min(shape[1], round(box.left + box.width))
    size = (max(0, right - left), max(0, bottom - top))
    x, y = layer.shape[1] / box.width, layer.shape[0] / box.height
    area = (
        max(0.0, x * (left - box.left)),
        max(0.0, y * (top - box.top)),
        min(float(layer.shape[1]), x * (right - box.left)),
        min(float(layer.shape[0]), y * (bottom - box.top)),
    )
    how = Image.Resampling.BILINEAR if smooth else Image.Resampling.NEAREST
    channels = [
        np.asarray(
            Image.fromarray(np.ascontiguousarray(layer[..., c], dtype=np.float32)).resize(
                size, how, box=area
            )
        )
        for c in range(layer.shape[-1])
    ]
    return slice(top, bottom), slice(left, right), np.stack(channels, -1)
