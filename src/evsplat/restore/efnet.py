"""EFNet (Sun et al., ECCV 2022), for the public checkpoints trained on GoPro or REBlur.

A two-stage U-Net in which features of the picture ask those of the events. Names and shapes of the
parameters are those of github.com/AHupuJR/EFNet (Apache-2.0).
"""

import math
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import ClassVar, cast

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from evsplat.capture import Frame, TrainingCapture
from evsplat.events import EventStream
from evsplat.events.maps import count_map
from evsplat.restore.network import NetworkRestorer, SupervisedAttention, as_input
from evsplat.weights import WeightFile, fill, state_under

CHANNELS = (64, 128, 256)
"""At full, half and quarter resolution."""
HEADS = (1, 2, 4)
BINS = 6
_SLOPE = 0.2


class EfNet(NetworkRestorer):
    """Each frame deblurred with the events of its exposure."""

    name = "efnet"
    file: ClassVar = WeightFile(
        network="EFNet",
        name="EFNet-GoPro.pth",
        size="about 34 MB",
        source="by the link in the README of github.com/AHupuJR/EFNet (Apache-2.0; "
        "EFNet-REBlur.pth, tuned on real events, does as well)",
        variable="EVSPLAT_EFNET",
    )
    multiple = 4

    def load(self, path: Path) -> nn.Module:
        """The network with 64 channels."""
        what = f"{self.file.name} or another checkpoint of EFNet"
        return fill(TwoStages(), state_under(path, ("params_ema", "params")), path, what=what)

    def inputs(self, capture: TrainingCapture, frame: Frame) -> Sequence[Float[Tensor, "1 _ H W"]]:
        """The blurry picture, the normalised event maps and where there were events."""
        assert capture.events is not None
        picture = capture.image(frame)
        height, width = picture.shape[:2]
        events = capture.events.between(*frame.exposure_us)
        maps = symmetric_cumulative(events, height, width, frame.exposure_us)
        mask = event_mask(maps)
        return [as_input(picture), maps[None] / maps.abs().max().clamp_min(1), mask[None, None]]


def symmetric_cumulative(
    events: EventStream, height: int, width: int, window_us: tuple[int, int]
) -> Float[Tensor, "6 H W"]:
    """Brightness change between the middle of a window and six times of it (the paper's SCER).

    The first three begin the window's first, second and third sixth, and count the events from
    there to the middle with their sign turned; the others end its last three sixths and count from
    the middle to there. Counts are not normalised.
    """
    start, end = window_us
    middle = start + (end - start) / 2
    maps = []
    for sixth in range(BINS):
        edge = start + (end - start) * (sixth + (sixth >= BINS // 2)) / BINS
        low, high = sorted((edge, middle))
        chosen = events.between(math.ceil(low), math.ceil(high))
        maps.append(count_map(chosen, height, width) * (-1 if edge < middle else 1))
    return torch.stack(maps)


def event_mask(maps: Float[Tensor, "B H W"]) -> Float[Tensor, "H W"]:
    """1 where any map is not 0, closed with a square of 3 pixels; else 0."""
    seen = (maps != 0).any(0).float()[None]
    grown = F.max_pool2d(seen, 3, 1, 1)
    return -F.max_pool2d(-grown, 3, 1, 1)[0]


class TwoStages(nn.Module):
    """The whole network; sides are multiples of 4."""

    def __init__(self) -> None:
        super().__init__()
        full = CHANNELS[0]
        self.conv_01 = nn.Conv2d(3, full, 3, padding=1)
        self.conv_02 = nn.Conv2d(3, full, 3, padding=1)
        self.conv_ev1 = nn.Conv2d(BINS, full, 3, padding=1)
        self.down_path_1, self.down_path_2 = nn.ModuleList(), nn.ModuleList()
        self.down_path_ev = nn.ModuleList()
        before = full
        for level, (channels, heads) in enumerate(zip(CHANNELS, HEADS, strict=True)):
            down = level + 1 < len(CHANNELS)
            self.down_path_1.append(Level(before, channels, down=down, heads=heads))
            self.down_path_2.append(Level(before, channels, down=down, gated=down))
            self.down_path_ev.append(Level(before, channels, down=down, merges=True))
            before = channels
        self.up_path_1, self.up_path_2 = nn.ModuleList(), nn.ModuleList()
        self.skip_conv_1, self.skip_conv_2 = nn.ModuleList(), nn.ModuleList()
        for coarse, fine in ((CHANNELS[2], CHANNELS[1]), (CHANNELS[1], CHANNELS[0])):
            for up, skip in (
                (self.up_path_1, self.skip_conv_1),
                (self.up_path_2, self.skip_conv_2),
            ):
                up.append(Up(coarse, fine))
                skip.append(nn.Conv2d(fine, fine, 3, padding=1))
        self.sam12 = SupervisedAttention(full, 3, bias=True)
        self.cat12 = nn.Conv2d(2 * full, full, 1)
        self.last = nn.Conv2d(full, 3, 3, padding=1)

    def forward(
        self,
        picture: Float[Tensor, "1 3 H W"],
        events: Float[Tensor, "1 6 H W"],
        mask: Float[Tensor, "1 1 H W"],
    ) -> Float[Tensor, "1 3 H W"]:
        """The second stage's picture."""
        asked = []
        x = self.conv_ev1(events)
        for level in _levels(self.down_path_ev):
            y = level(x)
            asked.append(level.conv_before_merge(y))
            x = level.smaller(y)
        encoded = []
        x = self.conv_01(picture)
        for level, events_there in zip(_levels(self.down_path_1), asked, strict=True):
            x = level.image_event_transformer(level(x), events_there)
            encoded.append(x)
            x = level.smaller(x)
        decoded = []
        for up, skip, feature in zip(
            self.up_path_1, self.skip_conv_1, encoded[-2::-1], strict=True
        ):
            x = up(x, skip(feature))
            decoded.append(x)
        attended = self.sam12(x, picture)
        x = self.cat12(torch.cat((self.conv_02(picture), attended), 1))
        features = []
        for index, level in enumerate(_levels(self.down_path_2)):
            y = level(x)
            if level.gated:
                there = F.interpolate(mask, scale_factor=0.5**index)
                y = y + level.earlier(encoded[index], decoded[-index - 1], there)
            features.append(y)
            x = level.smaller(y)
        for up, skip, feature in zip(
            self.up_path_2, self.skip_conv_2, features[-2::-1], strict=True
        ):
            x = up(x, skip(feature))
        restored: Tensor = self.last(x) + picture
        return restored


class Level(nn.Module):
    """Two convolutions with a shortcut, and what its place in the network adds."""

    emgc_enc: nn.Module
    emgc_dec: nn.Module
    emgc_enc_mask: nn.Module
    emgc_dec_mask: nn.Module

    def __init__(
        self,
        inputs: int,
        outputs: int,
        *,
        down: bool = False,
        heads: int = 0,
        gated: bool = False,
        merges: bool = False,
    ) -> None:
        """``down``: half resolution follows; ``heads``: of the attention to events; ``gated``:
        takes features of the first stage; ``merges``: gives features to it.
        """
        super().__init__()
        self.gated = gated
        self.identity = nn.Conv2d(inputs, outputs, 1)
        self.conv_1 = nn.Conv2d(inputs, outputs, 3, padding=1)
        self.conv_2 = nn.Conv2d(outputs, outputs, 3, padding=1)
        for name in ("emgc_enc", "emgc_dec", "emgc_enc_mask", "emgc_dec_mask") if gated else ():
            self.add_module(name, nn.Conv2d(outputs, outputs, 3, padding=1))
        self.downsample = nn.Conv2d(outputs, outputs, 4, 2, 1, bias=False) if down else None
        if heads:
            self.image_event_transformer = EventAttention(outputs, heads)
        if merges:
            self.conv_before_merge = nn.Conv2d(outputs, outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        """At the resolution of ``x``."""
        y = F.leaky_relu(self.conv_1(x), _SLOPE)
        return F.leaky_relu(self.conv_2(y), _SLOPE) + self.identity(x)

    def smaller(self, x: Tensor) -> Tensor:
        """At half resolution; as it is at the last level."""
        return x if self.downsample is None else self.downsample(x)

    def earlier(self, encoded: Tensor, decoded: Tensor, mask: Tensor) -> Tensor:
        """The first stage's features, told apart by where there were events (the paper's EMGC)."""
        sharp = self.emgc_enc(encoded) + self.emgc_enc_mask((1 - mask) * encoded)
        return sharp + self.emgc_dec(decoded) + self.emgc_dec_mask(mask * decoded)


class Up(nn.Module):
    """Twice the resolution, joined with features of the way down."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.up = nn.ConvTranspose2d(inputs, outputs, 2, stride=2)
        self.conv_block = Level(inputs, outputs)

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        """At twice the resolution of ``x``."""
        joined: Tensor = self.conv_block(torch.cat((self.up(x), skip), 1))
        return joined


class EventAttention(nn.Module):
    """Channels of the picture attend to channels of the events."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.norm1_image = PixelNorm(channels)
        self.norm1_event = PixelNorm(channels)
        self.attn = ChannelAttention(channels, heads)
        self.norm2 = nn.LayerNorm(channels)
        layers = (nn.Linear(channels, 4 * channels), nn.GELU(), nn.Linear(4 * channels, channels))
        self.ffn = nn.Sequential(OrderedDict(zip(("fc1", "act", "fc2"), layers, strict=True)))

    def forward(self, picture: Tensor, events: Tensor) -> Tensor:
        """The picture's features, of the same shape as both."""
        x = picture + self.attn(self.norm1_image(picture), self.norm1_event(events))
        pixels = x.movedim(1, -1)
        return (pixels + self.ffn(self.norm2(pixels))).movedim(-1, 1)


class ChannelAttention(nn.Module):
    """Attention whose tokens are channels, so that it costs no more for larger pictures."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.temperature = nn.Parameter(torch.ones(heads, 1, 1))
        self.q, self.k, self.v, self.project_out = (
            nn.Conv2d(channels, channels, 1, bias=False) for _ in range(4)
        )

    def forward(self, picture: Tensor, events: Tensor) -> Tensor:
        """Attention of the picture to the events; same shape as both."""
        query, key, value = (
            part.unflatten(1, (len(self.temperature), -1)).flatten(3)
            for part in (self.q(picture), self.k(events), self.v(events))
        )
        likeness = F.normalize(query, dim=-1) @ F.normalize(key, dim=-1).transpose(-2, -1)
        mixed = (likeness * self.temperature).softmax(-1) @ value
        answer: Tensor = self.project_out(mixed.reshape(picture.shape))
        return answer


class PixelNorm(nn.Module):
    """Layer normalisation over the channels of each pixel."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.body = nn.LayerNorm(channels)

    def forward(self, x: Tensor) -> Tensor:
        """Features of the same shape."""
        normal: Tensor = self.body(x.movedim(1, -1))
        return normal.movedim(-1, 1)


def _levels(path: nn.ModuleList) -> Iterable[Level]:
    return cast(Iterable[Level], path)
