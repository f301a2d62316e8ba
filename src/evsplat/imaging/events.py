"""The brightness change that events report, computed from two pictures."""

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.imaging.srgb import Transfer, decode, luminance

DARKEST = 1.0 / 255.0
"""Coded values are clamped here first: below one 8-bit level the logarithm only sees rounding."""


def log_brightness(
    rgb_srgb: Float[Tensor, "*shape 3"],
    *,
    eps: float = 1e-5,
    transfer: Transfer = "power",
    keep_chroma: bool = False,
) -> Float[Tensor, "*shape"]:
    """Natural logarithm of the luminance of sRGB-coded pictures in [0, 1] (A11).

    ``keep_chroma`` leaves the value as it is and lets the gradient only make a pixel brighter or
    darker, never change its colour. Luminance is mostly green: where events and a blurry picture
    disagree, the plain gradient settles the conflict by tinting (yellow where events ask for
    brighter, purple where for darker).
    """
    linear = decode(rgb_srgb.clamp_min(DARKEST), transfer)
    if keep_chroma:
        colour = linear.detach()
        gain = (linear * colour).sum(-1, keepdim=True) / colour.square().sum(-1, keepdim=True)
        linear = gain * colour
    return torch.log(luminance(linear) + eps)


def log_brightness_change(
    before_srgb: Float[Tensor, "*shape 3"],
    after_srgb: Float[Tensor, "*shape 3"],
    *,
    eps: float = 1e-5,
    transfer: Transfer = "power",
    keep_chroma: bool = False,
) -> Float[Tensor, "*shape"]:
    """``log Y(after) - log Y(before)``, the left side of the event model (paper eq. 8)."""
    before, after = (
        log_brightness(picture, eps=eps, transfer=transfer, keep_chroma=keep_chroma)
        for picture in (before_srgb, after_srgb)
    )
    return after - before
