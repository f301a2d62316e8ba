"""NAFNet (Chen et al., ECCV 2022), for the public checkpoints trained on GoPro or REDS.

Blocks without nonlinear activations in a U-Net. Names and shapes of the parameters are those of
github.com/megvii-research/NAFNet (MIT). Where training averaged over whole 256 px crops, a square
of 1.5 times that side is averaged around each pixel, as its authors test it (Chu et al., "Improving
image restoration by revisiting global information aggregation", ECCV 2022).
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from evsplat.errors import WeightsError
from evsplat.restore.network import NetworkRestorer
from evsplat.weights import WeightFile, fill, state_under

AVERAGED_PX = 384
"""Side of the square, at full resolution, over which channel attention averages."""


class NafNet(NetworkRestorer):
    """Each frame deblurred on its own, without events."""

    name = "nafnet"
    file: ClassVar = WeightFile(
        network="NAFNet",
        name="NAFNet-GoPro-width64.pth",
        size="272 MB",
        source="by the link in the README of github.com/megvii-research/NAFNet (MIT; "
        "NAFNet-GoPro-width32.pth, 69 MB, and the one of REDS do as well)",
        variable="EVSPLAT_NAFNET",
    )
    multiple = 16
    needs_events = False

    def load(self, path: Path) -> nn.Module:
        """The network in the size that the checkpoint has."""
        state = state_under(path, ("params_ema", "params"))
        what = f"{self.file.name} or another checkpoint of NAFNet"
        if "intro.weight" not in state or not state["intro.weight"].ndim:
            raise WeightsError(f"{path}: holds no 'intro.weight'; this is not {what}.")
        width = len(state["intro.weight"])
        middle = _count(state, r"middle_blks\.(\d+)\.")
        levels = _count(state, r"encoders\.(\d+)\.")
        down = [_count(state, rf"encoders\.{level}\.(\d+)\.") for level in range(levels)]
        up = [_count(state, rf"decoders\.{level}\.(\d+)\.") for level in range(levels)]
        return fill(NafUNet(width, down, middle, up), state, path, what=what)


class NafUNet(nn.Module):
    """Blocks per level on the way down, at the bottom and on the way up; sides multiples of 16."""

    def __init__(self, width: int, down: Sequence[int], middle: int, up: Sequence[int]) -> None:
        super().__init__()
        self.intro = nn.Conv2d(3, width, 3, padding=1)
        self.ending = nn.Conv2d(width, 3, 3, padding=1)
        self.encoders, self.downs = nn.ModuleList(), nn.ModuleList()
        self.decoders, self.ups = nn.ModuleList(), nn.ModuleList()
        channels, side = width, AVERAGED_PX
        for count in down:
            self.encoders.append(_blocks(count, channels, side))
            self.downs.append(nn.Conv2d(channels, 2 * channels, 2, stride=2))
            channels, side = 2 * channels, side // 2
        self.middle_blks = _blocks(middle, channels, side)
        for count in up:
            widen = nn.Conv2d(channels, 2 * channels, 1, bias=False)
            self.ups.append(nn.Sequential(widen, nn.PixelShuffle(2)))
            channels, side = channels // 2, 2 * side
            self.decoders.append(_blocks(count, channels, side))

    def forward(self, picture: Float[Tensor, "1 3 H W"]) -> Float[Tensor, "1 3 H W"]:
        """The sharp picture."""
        x, skips = self.intro(picture), []
        for encoder, down in zip(self.encoders, self.downs, strict=True):
            skips.append(encoder(x))
            x = down(skips[-1])
        x = self.middle_blks(x)
        for up, decoder in zip(self.ups, self.decoders, strict=True):
            x = decoder(up(x) + skips.pop())
        restored: Tensor = self.ending(x) + picture
        return restored


class NafBlock(nn.Module):
    """Depthwise convolution, gate and channel attention, then a gated layer."""

    def __init__(self, channels: int, side: int) -> None:
        """``side`` of the square that channel attention averages, in pixels of this level."""
        super().__init__()
        self.conv1 = nn.Conv2d(channels, 2 * channels, 1)
        self.conv2 = nn.Conv2d(2 * channels, 2 * channels, 3, padding=1, groups=2 * channels)
        self.conv3 = nn.Conv2d(channels, channels, 1)
        self.sca = nn.Sequential(LocalMean(side), nn.Conv2d(channels, channels, 1))
        self.conv4 = nn.Conv2d(channels, 2 * channels, 1)
        self.conv5 = nn.Conv2d(channels, channels, 1)
        self.norm1 = ChannelNorm(channels)
        self.norm2 = ChannelNorm(channels)
        self.beta = nn.Parameter(torch.zeros(1, channels, 1, 1))
        self.gamma = nn.Parameter(torch.zeros(1, channels, 1, 1))

    def forward(self, x: Float[Tensor, "1 C H W"]) -> Float[Tensor, "1 C H W"]:
        """Features of the same shape."""
        y = _gate(self.conv2(self.conv1(self.norm1(x))))
        x = x + self.beta * self.conv3(y * self.sca(y))
        return x + self.gamma * self.conv5(_gate(self.conv4(self.norm2(x))))


class ChannelNorm(nn.Module):
    """Layer normalisation over the channels of each pixel."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))

    def forward(self, x: Float[Tensor, "1 C H W"]) -> Float[Tensor, "1 C H W"]:
        """Features of the same shape."""
        normal = F.layer_norm(x.movedim(1, -1), self.weight.shape, self.weight, self.bias, 1e-6)
        return normal.movedim(-1, 1)


class LocalMean(nn.Module):
    """Mean over a square around each pixel; squares at the border are moved inside."""

    def __init__(self, side: int) -> None:
        super().__init__()
        self.side = side

    def forward(self, x: Float[Tensor, "1 C H W"]) -> Float[Tensor, "1 C _ _"]:
        """One value per channel where the square covers all, else one per pixel."""
        height, width = x.shape[-2:]
        high, wide = min(self.side, height), min(self.side, width)
        if (high, wide) == (height, width):
            return x.mean((-2, -1), keepdim=True)
        sums = F.pad(x.double().cumsum(-1).cumsum(-2), (1, 0, 1, 0))
        rows = sums[..., high:, :] - sums[..., :-high, :]
        means = (rows[..., wide:] - rows[..., :-wide]) / (high * wide)
        left, top = (width - means.shape[-1]) // 2, (height - means.shape[-2]) // 2
        right, bottom = width - means.shape[-1] - left, height - means.shape[-2] - top
        return F.pad(means, (left, right, top, bottom), mode="replicate").to(x)


def _blocks(count: int, channels: int, side: int) -> nn.Sequential:
    return nn.Sequential(*(NafBlock(channels, side) for _ in range(count)))


def _gate(x: Float[Tensor, "1 _ H W"]) -> Float[Tensor, "1 C H W"]:
    first, second = x.chunk(2, 1)
    return first * second


def _count(names: Sequence[str] | dict[str, Tensor], pattern: str) -> int:
    found = [int(match[1]) for name in names if (match := re.match(pattern, name))]
    return max(found, default=-1) + 1
