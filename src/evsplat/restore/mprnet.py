"""MPRNet (Zamir et al., CVPR 2021), for the public deblurring checkpoint.

Three stages, each at the full resolution of its part: four quarters, two halves, the whole. The
definition is written anew; names and shapes of the parameters are those of ``model_deblurring.pth``
of github.com/swz30/MPRNet, whose code and weights are for academic use only and are no part of
evsplat.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from evsplat.restore.network import NetworkRestorer, SupervisedAttention
from evsplat.weights import WeightFile, fill, state_under

LEVELS = (96, 144, 192)
"""Channels at full, half and quarter resolution."""
WIDE = 128
"""Channels of the last stage."""
REDUCTION = 4


class MprNet(NetworkRestorer):
    """Each frame deblurred on its own, without events."""

    name = "mprnet"
    file: ClassVar = WeightFile(
        network="MPRNet",
        name="model_deblurring.pth",
        size="about 80 MB",
        source="by the link in Deblurring/README.md of github.com/swz30/MPRNet (academic use only)",
        variable="EVSPLAT_MPRNET",
    )
    multiple = 8
    needs_events = False

    def load(self, path: Path) -> nn.Module:
        """The network for deblurring."""
        return fill(ThreeStages(), state_under(path, ("state_dict",)), path, what=self.file.name)


class ThreeStages(nn.Module):
    """The whole network; sides are multiples of 8."""

    shallow_feat1: nn.Module
    shallow_feat2: nn.Module
    shallow_feat3: nn.Module

    def __init__(self) -> None:
        super().__init__()
        act, channels = nn.PReLU(), LEVELS[0]
        for stage in (1, 2, 3):
            shallow = nn.Sequential(_conv(3, channels), AttentionBlock(channels, act))
            self.add_module(f"shallow_feat{stage}", shallow)
        self.stage1_encoder = Encoder(act, takes_earlier=False)
        self.stage1_decoder = Decoder(act)
        self.stage2_encoder = Encoder(act, takes_earlier=True)
        self.stage2_decoder = Decoder(act)
        self.stage3_orsnet = FullResolution(act)
        self.sam12 = SupervisedAttention(channels, 1, bias=False)
        self.sam23 = SupervisedAttention(channels, 1, bias=False)
        self.concat12 = _conv(2 * channels, channels)
        self.concat23 = _conv(2 * channels, WIDE)
        self.tail = _conv(WIDE, 3)

    def forward(self, picture: Float[Tensor, "1 3 H W"]) -> Float[Tensor, "1 3 H W"]:
        """The last stage's picture."""
        halves = picture.chunk(2, -2)
        made = [self._first(half) for half in halves]
        second = [
            self.stage2_encoder(
                self.concat12(torch.cat((self.shallow_feat2(half), attended), 1)), encoded, decoded
            )
            for half, (encoded, decoded, attended) in zip(halves, made, strict=True)
        ]
        encoded = [torch.cat(level, -2) for level in zip(*second, strict=True)]
        decoded = self.stage2_decoder(encoded)
        attended = self.sam23(decoded[0], picture)
        whole = self.concat23(torch.cat((self.shallow_feat3(picture), attended), 1))
        restored: Tensor = self.tail(self.stage3_orsnet(whole, encoded, decoded)) + picture
        return restored

    def _first(self, half: Tensor) -> tuple[list[Tensor], list[Tensor], Tensor]:
        """Features that the first stage finds in the two quarters of a half."""
        quarters = [
            self.stage1_encoder(self.shallow_feat1(quarter)) for quarter in half.chunk(2, -1)
        ]
        encoded = [torch.cat(level, -1) for level in zip(*quarters, strict=True)]
        decoded = self.stage1_decoder(encoded)
        return encoded, decoded, self.sam12(decoded[0], half)


class AttentionBlock(nn.Module):
    """Two convolutions, channel attention, and the input added."""

    def __init__(self, channels: int, act: nn.Module) -> None:
        """``act`` is one for the whole network."""
        super().__init__()
        self.CA = ChannelAttention(channels)
        self.body = nn.Sequential(_conv(channels, channels), act, _conv(channels, channels))

    def forward(self, x: Float[Tensor, "1 C H W"]) -> Float[Tensor, "1 C H W"]:
        """Features of the same shape."""
        return self.CA(self.body(x)) + x


class ChannelAttention(nn.Module):
    """Each channel times a weight in [0, 1] that its mean and those of the others decide."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        inner = channels // REDUCTION
        self.conv_du = nn.Sequential(
            _conv(channels, inner, 1), nn.ReLU(), _conv(inner, channels, 1), nn.Sigmoid()
        )

    def forward(self, x: Float[Tensor, "1 C H W"]) -> Float[Tensor, "1 C H W"]:
        """Features of the same shape."""
        return x * self.conv_du(x.mean((-2, -1), keepdim=True))


class Encoder(nn.Module):
    """Features at three resolutions; the second stage adds those of the first to them."""

    def __init__(self, act: nn.Module, *, takes_earlier: bool) -> None:
        super().__init__()
        for level, channels in enumerate(LEVELS, 1):
            self.add_module(f"encoder_level{level}", _pair(channels, act))
        self.down12 = Resize(0.5, LEVELS[0], LEVELS[1], "down")
        self.down23 = Resize(0.5, LEVELS[1], LEVELS[2], "down")
        for level, channels in enumerate(LEVELS, 1) if takes_earlier else ():
            self.add_module(f"csff_enc{level}", _conv(channels, channels, 1))
            self.add_module(f"csff_dec{level}", _conv(channels, channels, 1))

    def forward(
        self, x: Tensor, encoded: Sequence[Tensor] = (), decoded: Sequence[Tensor] = ()
    ) -> list[Tensor]:
        """Full, half and quarter resolution."""
        features = []
        for level in (1, 2, 3):
            x = self.get_submodule(f"encoder_level{level}")(x)
            if encoded:
                x = x + self.get_submodule(f"csff_enc{level}")(encoded[level - 1])
                x = x + self.get_submodule(f"csff_dec{level}")(decoded[level - 1])
            features.append(x)
            if level < 3:
                x = self.get_submodule(f"down{level}{level + 1}")(x)
        return features


class Decoder(nn.Module):
    """From the coarsest features back to full resolution, all three kept."""

    decoder_level1: nn.Module
    decoder_level2: nn.Module
    decoder_level3: nn.Module

    def __init__(self, act: nn.Module) -> None:
        super().__init__()
        for level, channels in enumerate(LEVELS, 1):
            self.add_module(f"decoder_level{level}", _pair(channels, act))
        self.skip_attn1 = AttentionBlock(LEVELS[0], act)
        self.skip_attn2 = AttentionBlock(LEVELS[1], act)
        self.up21 = Resize(2, LEVELS[1], LEVELS[0], "up")
        self.up32 = Resize(2, LEVELS[2], LEVELS[1], "up")

    def forward(self, features: Sequence[Tensor]) -> list[Tensor]:
        """Full, half and quarter resolution."""
        coarse = self.decoder_level3(features[2])
        middle = self.decoder_level2(self.up32(coarse) + self.skip_attn2(features[1]))
        fine = self.decoder_level1(self.up21(middle) + self.skip_attn1(features[0]))
        return [fine, middle, coarse]


class FullResolution(nn.Module):
    """The last stage: never scaled down, fed by the stage before at three places."""

    def __init__(self, act: nn.Module) -> None:
        super().__init__()
        for place in (1, 2, 3):
            self.add_module(f"orb{place}", Original(act))
            for side in ("enc", "dec"):
                self.add_module(f"conv_{side}{place}", _conv(LEVELS[0], WIDE, 1))
        for side in ("enc", "dec"):
            self.add_module(f"up_{side}1", Resize(2, LEVELS[1], LEVELS[0], "up"))
            twice = (Resize(2, LEVELS[2], LEVELS[1], "up"), Resize(2, LEVELS[1], LEVELS[0], "up"))
            self.add_module(f"up_{side}2", nn.Sequential(*twice))

    def forward(self, x: Tensor, encoded: Sequence[Tensor], decoded: Sequence[Tensor]) -> Tensor:
        """Same shape as ``x``."""
        for place in (1, 2, 3):
            x = self.get_submodule(f"orb{place}")(x)
            for side, features in (("enc", encoded), ("dec", decoded)):
                found = features[place - 1]
                if place > 1:
                    found = self.get_submodule(f"up_{side}{place - 1}")(found)
                x = x + self.get_submodule(f"conv_{side}{place}")(found)
        return x


class Original(nn.Module):
    """Eight attention blocks and a convolution, and the input added."""

    def __init__(self, act: nn.Module) -> None:
        super().__init__()
        blocks = (AttentionBlock(WIDE, act) for _ in range(8))
        self.body = nn.Sequential(*blocks, _conv(WIDE, WIDE))

    def forward(self, x: Tensor) -> Tensor:
        """Features of the same shape."""
        return self.body(x) + x


class Resize(nn.Module):
    """Bilinear scaling, then other channels."""

    def __init__(self, scale: float, inputs: int, outputs: int, name: str) -> None:
        """``name`` is what the checkpoint calls the pair."""
        super().__init__()
        self._name = name
        self.add_module(name, nn.Sequential(_Scale(scale), _conv(inputs, outputs, 1)))

    def forward(self, x: Tensor) -> Tensor:
        """At the new scale."""
        scaled: Tensor = self.get_submodule(self._name)(x)
        return scaled


class _Scale(nn.Module):
    def __init__(self, scale: float) -> None:
        super().__init__()
        self.scale = scale

    def forward(self, x: Tensor) -> Tensor:
        return F.interpolate(x, scale_factor=self.scale, mode="bilinear", align_corners=False)


def _pair(channels: int, act: nn.Module) -> nn.Sequential:
    return nn.Sequential(AttentionBlock(channels, act), AttentionBlock(channels, act))


def _conv(inputs: int, outputs: int, size: int = 3) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, size, padding=size // 2, bias=False)
