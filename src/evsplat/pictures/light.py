"""Coded values of pictures, linear light, luminance and its logarithm, which events report."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from evsplat.compiled import native, runs_native
from evsplat.devices import constant

Transfer = Literal["power", "srgb", "linear"]
"""``power``: exponent 2.2 (paper eq. 8); ``srgb``: the exact piecewise curve of IEC 61966-2-1;
``linear``: the values are light as they stand."""

TRANSFERS: tuple[Transfer, ...] = get_args(Transfer)
GAMMA = 2.2
REC709 = (0.2126, 0.7152, 0.0722)
BT601 = (0.299, 0.587, 0.114)
"""Weights of coded channels in luma, from which colour differences are taken."""
_CHROMA = tuple(
    tuple(((channel == own) - weight) / (2 * (1 - BT601[own])) for own in (2, 0))
    for channel, weight in enumerate(BT601)
)
"""Cb and Cr of red, green and blue."""
DARKEST = 1.0 / 255.0
"""Coded values are clamped here first: below one 8-bit level the logarithm only sees rounding."""
_BLACK = 1e-6
"""Coded values below are no light, and have no slope."""
_MOST_PICTURES = 256
"""That the compiled module takes together."""
_ALL = slice(None)


def decode(coded: Float[Tensor, "*shape"], transfer: Transfer = "power") -> Float[Tensor, "*shape"]:
    """Linear light in [0, 1] of coded values in [0, 1]; values below 0 count as 0."""
    if transfer == "power":
        if not coded.requires_grad:
            return coded.clamp_min(0.0) ** GAMMA
        power = _NativePower if runs_native(coded) else _Power
        linear: Tensor = power.apply(coded)
        return linear
    coded = coded.clamp_min(0.0)
    if transfer == "linear":
        return coded
    return torch.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)


def encode(
    linear: Float[Tensor, "*shape"], transfer: Transfer = "power", *, least: float = 0.0
) -> Float[Tensor, "*shape"]:
    """Coded values in [0, 1] of linear light in [0, 1]; values below ``least`` count as that."""
    if transfer == "power":
        coded: Tensor = _PowerEncode.apply(linear, least)
        return coded
    linear = linear.clamp_min(least)
    if transfer == "linear":
        return linear
    return torch.where(
        linear <= 0.0031308, linear * 12.92, 1.055 * linear.clamp_min(1e-8) ** (1 / 2.4) - 0.055
    )


def shown(values: Float[Tensor, "*shape"], transfer: Transfer) -> Float[Tensor, "*shape"]:
    """Values of pictures as screens, people and pretrained networks take them.

    Light as it stands (``linear``) is coded as sRGB, values that are coded stay as they are.
    """
    return encode(values, "srgb") if transfer == "linear" else values


def transfer_shown(transfer: Transfer) -> Transfer:
    """Transfer of pictures that are `shown`."""
    return "srgb" if transfer == "linear" else transfer


def stored(coded: Float[Tensor, "*shape"], transfer: Transfer) -> Float[Tensor, "*shape"]:
    """The opposite of `shown`: values of a picture with that ``transfer``."""
    return decode(coded, "srgb") if transfer == "linear" else coded


def evened(
    coded: Float[Tensor, "*shape"], gain: Float[Tensor, "..."], transfer: Transfer
) -> Float[Tensor, "*shape"]:
    """Values in [0, 1] of a picture had its camera not made all light ``gain`` times as much."""
    return encode(decode(coded, transfer) / gain, transfer).clamp_max(1.0)


def luminance(linear_rgb: Float[Tensor, "*shape 3"]) -> Float[Tensor, "*shape"]:
    """Rec. 709 luminance of linear RGB, the quantity that an event pixel sees."""
    red, green, blue = linear_rgb.unbind(-1)
    return REC709[0] * red + REC709[1] * green + REC709[2] * blue


def chroma(coded: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 2"]:
    """Cb and Cr (ITU-R BT.601) of coded RGB, each of range 1."""
    return coded @ constant(_CHROMA, coded)


@dataclass(frozen=True, eq=False)
class CodedPictures:
    """Pictures of one size and one curve, whose light several losses look at.

    The compiled module decodes what each of them asks for; in plain torch all are decoded once.
    """

    coded: tuple[Float[Tensor, "H W 3"], ...]
    transfer: Transfer = "power"

    def mean_light(self, which: slice = _ALL) -> Float[Tensor, "H W 3"]:
        """Mean of some of the pictures in linear light."""
        coded = self.coded[which]
        if self._native and len(coded) <= _MOST_PICTURES:
            mean: Tensor = _NativeMeanLight.apply(*coded)
            return mean
        return self._light[which].mean(0).movedim(0, -1)

    def log_luminance(
        self, eps: float, which: slice = _ALL, *, keeps_hue: bool = False
    ) -> Float[Tensor, "T H W"]:
        """Natural logarithm of some pictures' luminance in linear light, and ``eps``.

        ``keeps_hue`` leaves the value and changes the gradient: to that of the mean over channels
        of log(light + eps). It pulls at the logarithms of all channels alike, that of luminance at
        green ten times as hard as at blue.
        """
        coded = self.coded[which]
        if self._native and len(coded) <= _MOST_PICTURES:
            result: Tensor = _NativeLogLuminance.apply(_BLACK, eps, keeps_hue, False, *coded)
            return result
        plain: Tensor = _LogLuminance.apply(self._light[which], eps, keeps_hue)
        return plain

    @property
    def _native(self) -> bool:
        return self.transfer == "power" and all(map(runs_native, self.coded))

    @cached_property
    def _light(self) -> Float[Tensor, "T 3 H W"]:
        planes = torch.stack([picture.movedim(-1, 0) for picture in self.coded])
        return decode(planes, self.transfer)


def _planar(picture: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """Without gradient, its channels one after the other in memory."""
    return picture.detach().movedim(-1, 0).contiguous().movedim(0, -1)


def log_brightness(
    rgb_srgb: Float[Tensor, "*shape 3"], *, eps: float = 1e-5, transfer: Transfer = "power"
) -> Float[Tensor, "*shape"]:
    """Natural logarithm of the luminance of sRGB-coded pictures in [0, 1] (A11)."""
    if transfer == "power":
        if _takes_picture(rgb_srgb):
            native_result: Tensor = _NativeLogLuminance.apply(DARKEST, eps, False, False, rgb_srgb)
            return native_result[0]
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
    pictures = before_srgb, after_srgb
    if transfer == "power" and all(map(_takes_picture, pictures)):
        change: Tensor = _NativeLogLuminance.apply(DARKEST, eps, False, True, *pictures)
        return change
    after = log_brightness(after_srgb, eps=eps, transfer=transfer)
    return after - log_brightness(before_srgb, eps=eps, transfer=transfer)


def _takes_picture(coded: Tensor) -> bool:
    """Whether the compiled module takes this for a picture."""
    return runs_native(coded) and coded.ndim == 3 and coded.shape[-1] == len(REC709)


class _Power(torch.autograd.Function):
    """The power curve of a GPU, in as few operations as there can be."""

    @staticmethod
    def forward(ctx: Any, coded: Tensor) -> Tensor:
        light = coded.clamp_min(0.0)
        slope = light ** (GAMMA - 1)
        ctx.save_for_backward(slope)
        return slope * light

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> Tensor:
        (slope,) = ctx.saved_tensors
        return torch.mul(slope, upstream[0]).mul_(GAMMA)


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


class _NativeMeanLight(torch.autograd.Function):
    """`CodedPictures.mean_light` for the power curve in the compiled module."""

    @staticmethod
    def forward(ctx: Any, *coded: Tensor) -> Float[Tensor, "H W 3"]:
        height, width, channels = coded[0].shape
        mean = coded[0].new_empty(channels, height, width)
        native.power_mean([_planar(p) for p in coded], GAMMA, mean, torch.get_num_threads())
        ctx.save_for_backward(*coded)
        return mean.movedim(0, -1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, ...]:
        coded = ctx.saved_tensors
        above = upstream[0].movedim(-1, 0).contiguous()
        grads = above.new_empty(len(coded), *above.shape)
        pictures = [_planar(picture) for picture in coded]
        native.power_mean_backward(pictures, GAMMA, above, grads, torch.get_num_threads())
        return grads.movedim(1, -1).unbind(0)


class _LogLuminance(torch.autograd.Function):
    """`CodedPictures.log_luminance` of planes of light; autograd would go back by channels."""

    @staticmethod
    def forward(
        ctx: Any, linear: Float[Tensor, "T 3 H W"], eps: float, keeps_hue: bool
    ) -> Float[Tensor, "T H W"]:
        weights = constant(REC709, linear).expand(len(linear), 1, -1)
        light = torch.baddbmm(constant((eps,), linear), weights, linear.flatten(2))
        light = light.unflatten(-1, linear.shape[2:])[:, 0]
        ctx.eps, ctx.keeps_hue = eps, keeps_hue
        ctx.save_for_backward(linear if keeps_hue else light)
        return torch.log(light)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None, None]:
        (light,) = ctx.saved_tensors
        above = upstream[0][:, None]
        if ctx.keeps_hue:
            return above / (light + ctx.eps) / light.shape[1], None, None
        weights = constant(REC709, light)[:, None, None]
        return above / light[:, None] * weights, None, None


class _NativeLogLuminance(torch.autograd.Function):
    """The same for the power curve in the compiled module, or of two pictures the change.

    Slopes are found on the way back: three planes a picture would else be written and read again.
    """

    @staticmethod
    def forward(
        ctx: Any, darkest: float, eps: float, keeps_hue: bool, change: bool, *coded: Tensor
    ) -> Tensor:
        pictures = [_planar(picture) for picture in coded]
        size = coded[0].shape[:2]
        value = pictures[0].new_empty(size if change else (len(coded), *size))
        ctx.how = REC709, (GAMMA, darkest, eps), keeps_hue, change
        native.log_brightness(pictures, *ctx.how, value, torch.get_num_threads())
        ctx.save_for_backward(*coded)
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        pictures = [_planar(picture) for picture in ctx.saved_tensors]
        height, width, channels = pictures[0].shape
        grads = pictures[0].new_empty(len(pictures), channels, height, width)
        above, threads = upstream[0].contiguous(), torch.get_num_threads()
        native.log_brightness_backward(pictures, *ctx.how, above, grads, threads)
        return None, None, None, None, *grads.movedim(1, -1).unbind(0)


class _PowerEncode(torch.autograd.Function):
    """The inverse of the power curve; its slope, none up to the least value, is of the result."""

    @staticmethod
    def forward(ctx: Any, linear: Tensor, least: float) -> Tensor:
        coded = linear.clamp_min(least) ** (1 / GAMMA)
        ctx.least = least
        ctx.save_for_backward(linear, coded)
        return coded

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None]:
        linear, coded = ctx.saved_tensors
        slope = upstream[0] * (coded / linear) * (1 / GAMMA)
        return torch.ops.aten.threshold_backward(slope, linear, ctx.least), None


class _PowerLogBrightness(torch.autograd.Function):
    """The power curve's case with its gradient in closed form: one power instead of two."""

    @staticmethod
    def forward(ctx: Any, rgb: Tensor, eps: float) -> Float[Tensor, "*shape"]:
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
