"""Coded values of pictures, linear light, luminance and its logarithm, which events report."""

from typing import Any, Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from evsplat.compiled import native, runs_native

Transfer = Literal["power", "srgb", "linear"]
"""``power``: exponent 2.2 (paper eq. 8); ``srgb``: the exact piecewise curve of IEC 61966-2-1;
``linear``: the values are light as they stand."""

TRANSFERS: tuple[Transfer, ...] = get_args(Transfer)
GAMMA = 2.2
REC709 = (0.2126, 0.7152, 0.0722)
DARKEST = 1.0 / 255.0
"""Coded values are clamped here first: below one 8-bit level the logarithm only sees rounding."""


def decode(coded: Float[Tensor, "*shape"], transfer: Transfer = "power") -> Float[Tensor, "*shape"]:
    """Linear light in [0, 1] of coded values in [0, 1]; values below 0 count as 0."""
    if transfer == "power":
        if coded.requires_grad and runs_native(coded):
            linear: Tensor = _NativePower.apply(coded)
            return linear
        return coded.clamp_min(0.0) ** GAMMA
    coded = coded.clamp_min(0.0)
    if transfer == "linear":
        return coded
    return torch.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)


def encode(
    linear: Float[Tensor, "*shape"], transfer: Transfer = "power"
) -> Float[Tensor, "*shape"]:
    """Coded values in [0, 1] of linear light in [0, 1]; values below 0 count as 0."""
    linear = linear.clamp_min(0.0)
    if transfer == "power":
        return linear ** (1 / GAMMA)
    if transfer == "linear":
        return linear
    return torch.where(
        linear <= 0.0031308, linear * 12.92, 1.055 * linear.clamp_min(1e-8) ** (1 / 2.4) - 0.055
    )


def luminance(linear_rgb: Float[Tensor, "*shape 3"]) -> Float[Tensor, "*shape"]:
    """Rec. 709 luminance of linear RGB, the quantity that an event pixel sees."""
    red, green, blue = linear_rgb.unbind(-1)
    return REC709[0] * red + REC709[1] * green + REC709[2] * blue


def log_luminance(linear_rgb: Float[Tensor, "T H W 3"], eps: float) -> Float[Tensor, "T H W"]:
    """Natural logarithm of the luminance of linear pictures, none below 0, and ``eps``."""
    if runs_native(linear_rgb):
        result: Tensor = _NativeLogLuminance.apply(linear_rgb, eps)
        return result
    return torch.log(luminance(linear_rgb) + eps)


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


class _NativePower(torch.autograd.Function):
    """The power curve in the compiled module; the slope is found on the way forward."""

    @staticmethod
    def forward(ctx: Any, coded: Tensor) -> Tensor:
        given = coded.detach().contiguous()
        value = torch.empty_like(given)
        slope = torch.empty_like(given) if ctx.needs_input_grad[0] else None
        native.power(given, GAMMA, value, slope, torch.get_num_threads())
        if slope is not None:
            ctx.save_for_backward(slope)
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> Tensor:
        (slope,) = ctx.saved_tensors
        return slope * upstream[0]


class _NativeLogLuminance(torch.autograd.Function):
    """`log_luminance` in the compiled module, picture by picture; the slopes are found at once."""

    @staticmethod
    def forward(ctx: Any, linear: Tensor, eps: float) -> Float[Tensor, "T H W"]:
        planes = linear.detach().movedim(-1, 1).contiguous()
        slopes = torch.empty_like(planes) if ctx.needs_input_grad[0] else None
        value = torch.empty_like(planes[:, 0])
        for t, picture in enumerate(planes):
            slope = None if slopes is None else slopes[t]
            native.log_brightness(
                picture, REC709, 1.0, 0.0, eps, value[t], slope, torch.get_num_threads()
            )
        if slopes is not None:
            ctx.save_for_backward(slopes)
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None]:
        (slopes,) = ctx.saved_tensors
        return (slopes * upstream[0][:, None]).movedim(1, -1), None


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
