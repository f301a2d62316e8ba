"""The brightness change that events report, computed from two pictures."""

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.imaging.srgb import Transfer, decode, luminance

DARKEST = 1.0 / 255.0
"""Coded values are clamped here first: below one 8-bit level the logarithm only sees rounding."""


def log_brightness(
    rgb_srgb: Float[Tensor, "*shape 3"], *, eps: float = 1e-5, transfer: Transfer = "power"
) -> Float[Tensor, "*shape"]:
    """Natural logarithm of the luminance of sRGB-coded pictures in [0, 1] (A11)."""
    return torch.log(luminance(decode(rgb_srgb.clamp_min(DARKEST), transfer)) + eps)


def log_brightness_change(
    before_srgb: Float[Tensor, "*shape 3"],
    after_srgb: Float[Tensor, "*shape 3"],
    *,
    eps: float = 1e-5,
    transfer: Transfer = "power",
) -> Float[Tensor, "*shape"]:
    """``log Y(after) - log Y(before)``, the left side of the event model (paper eq. 8)."""
    after = log_brightness(after_srgb, eps=eps, transfer=transfer)
    return after - log_brightness(before_srgb, eps=eps, transfer=transfer)
