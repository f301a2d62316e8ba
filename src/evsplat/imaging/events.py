"""The brightness change that events report, computed from two pictures."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from evsplat.compiled import native, runs_native
from evsplat.imaging.srgb import GAMMA, REC709, Transfer, decode, luminance

DARKEST = 1.0 / 255.0
"""Coded values are clamped here first: below one 8-bit level the logarithm only sees rounding."""


def log_brightness(
    rgb_srgb: Float[Tensor, "*shape 3"], *, eps: float = 1e-5, transfer: Transfer = "power"
) -> Float[Tensor, "*shape"]:
    """Natural logarithm of the luminance of sRGB-coded pictures in [0, 1] (A11)."""
    if transfer == "power":
        result: Tensor = _PowerLogBrightness.apply(rgb_srgb, eps)
        return result
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


class _PowerLogBrightness(torch.autograd.Function):
    """The power curve's case with its gradient in closed form: one power instead of two."""

    @staticmethod
    def forward(ctx: Any, rgb: Tensor, eps: float) -> Float[Tensor, "*shape"]:
        if runs_native(rgb) and rgb.shape[-1] == len(REC709):
            planes = rgb.detach().movedim(-1, 0).contiguous()
            slopes = torch.empty_like(planes) if ctx.needs_input_grad[0] else None
            value = torch.empty_like(planes[0])
            native.log_brightness(
                planes, REC709, GAMMA, DARKEST, eps, value, slopes, torch.get_num_threads()
            )
            if slopes is not None:
                ctx.save_for_backward(slopes.movedim(0, -1))
            return value
        coded = rgb.clamp_min(DARKEST)
        slope = coded ** (GAMMA - 1)
        light = luminance(slope * coded) + eps
        if ctx.needs_input_grad[0]:
            slope *= rgb >= DARKEST
            for channel, weight in zip(slope.unbind(-1), REC709, strict=True):
                channel *= weight * GAMMA / light
            ctx.save_for_backward(slope)
        return torch.log(light)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None]:
        (slope,) = ctx.saved_tensors
        return slope * upstream[0][..., None], None
