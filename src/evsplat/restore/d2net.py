"""D2Net (Shang et al., ICCV 2021), for the public checkpoints with events.

Each frame from the five around it and the events of the middle three. All frames count as blurry,
as in the model for consecutively blurry frames. Written anew; names and shapes of the parameters
are those of github.com/shangwei5/D2Net, which states no licence and is no part of evsplat. Its
memory between frames has weights but is never switched on there, and so is not here.
"""

from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from evsplat.capture import Frame, TrainingCapture
from evsplat.errors import DataError
from evsplat.events import EventStream
from evsplat.events.maps import polarity_counts
from evsplat.restore.network import NetworkRestorer, as_input
from evsplat.restore.pwcnet import PwcNet, warped
from evsplat.weights import WeightFile, fill, state_under

FRAMES = 5
SLICES = 20
CHANNELS = 32
_SLOPE = 0.2


class D2Net(NetworkRestorer):
    """Each frame deblurred with its neighbours and their events."""

    name = "d2net"
    file: ClassVar = WeightFile(
        network="D2Net",
        name="model_best_event.pt",
        size="about 140 MB",
        source="by the links in the README of github.com/shangwei5/D2Net (no licence stated), best "
        "the one for consecutively blurry frames,",
        variable="EVSPLAT_D2NET",
    )
    multiple = 4

    def load(self, path: Path) -> nn.Module:
        """The network with events."""
        return fill(TwoIterations(), state_under(path, ()), path, what="D2Net with events")

    def inputs(self, capture: TrainingCapture, frame: Frame) -> Sequence[Float[Tensor, "1 _ H W"]]:
        """Five pictures and three stacks of events.

        Beyond the first and last frame before a held-out one, frames come back reversed.
        """
        assert capture.events is not None
        if len(capture.train_frames) < FRAMES // 2 + 1:
            raise DataError(
                f"{capture.path}: has {len(capture.train_frames)} frames, expected at least "
                f"{FRAMES // 2 + 1}, which {self.name} looks at together; use --with edi."
            )
        run = capture.neighbours(frame)
        middle = next(place for place, other in enumerate(run) if other.name == frame.name)
        places = range(middle - FRAMES // 2, middle + FRAMES // 2 + 1)
        near = [run[_reflected(place, len(run))] for place in places]
        pictures = torch.cat([as_input(capture.image(one)) for one in near], 1)
        height, width = pictures.shape[-2:]
        stacks = [
            event_stack(capture.events.between(*one.exposure_us), height, width)
            for one in near[1:-1]
        ]
        return [pictures, torch.cat(stacks)[None]]


def _reflected(place: int, count: int) -> int:
    """The place in 0..count-1 where a step beyond the ends turns back."""
    last = count - 1
    return abs((place + last) % (2 * last) - last) if last else 0


def event_stack(events: EventStream, height: int, width: int) -> Float[Tensor, "40 H W"]:
    """Darker and brighter events per pixel in twenty equal slices, divided by the largest count.

    Slices reach from the first to the last event; of each, darker comes first.
    """
    stack = torch.zeros(SLICES, 2, height, width)
    if len(events) == 0:
        return stack.flatten(0, 1)
    start, end = int(events.t[0]), int(events.t[-1])
    edges = [start - (start - end) * index // SLICES for index in range(SLICES)]
    for index, (first, last) in enumerate(zip(edges, [*edges[1:], end + 1], strict=True)):
        part = events.between(first, last)
        stack[index] = polarity_counts(part, height, width).flip(0)
    return (stack / stack.max()).flatten(0, 1)


class TwoIterations(nn.Module):
    """Three frames deblurred from their neighbours, then the middle one from those."""

    def __init__(self) -> None:
        super().__init__()
        for part in ("near", "nsf"):
            flow = nn.Sequential(OrderedDict(moduleNetwork=PwcNet()))
            self.add_module(f"flow_net_{part}", flow)
            self.add_module(f"recons_net_{part}", Reconstruction())

    def forward(
        self, pictures: Float[Tensor, "1 15 H W"], events: Float[Tensor, "1 120 H W"]
    ) -> Float[Tensor, "1 3 H W"]:
        """The middle frame; sides are multiples of 4."""
        frames, stacks = pictures.chunk(FRAMES, 1), events.chunk(FRAMES - 2, 1)
        first = [self._joined("nsf", frames[i : i + 3], stack) for i, stack in enumerate(stacks)]
        return self._joined("near", first, stacks[1])

    def _joined(self, part: str, frames: Sequence[Tensor], events: Tensor) -> Tensor:
        """The middle of three frames, with the outer two laid onto it."""
        flow = self.get_submodule(f"flow_net_{part}.moduleNetwork")
        before, middle, after = frames
        before, after = (
            warped(other, flow(middle, other), outside="border") for other in (before, after)
        )
        restored: Tensor = self.get_submodule(f"recons_net_{part}")(
            torch.cat((before, middle, after), 1), events
        )
        return restored


class Reconstruction(nn.Module):
    """U-Net of residual blocks, fused with events at a quarter of the resolution."""

    def __init__(self) -> None:
        super().__init__()
        one, two, four = CHANNELS, 2 * CHANNELS, 4 * CHANNELS
        self.event_in = nn.Sequential(
            nn.Conv2d(2 * SLICES, one, 3, 1, 1, bias=False),
            _leaky(),
            nn.Conv2d(one, one, 5, 2, 2, bias=False),
            _leaky(),
            nn.Conv2d(one, one, 3, 1, 1, bias=False),
        )
        self.inBlock = nn.Sequential(_start(9, one, 1), *_residuals(one))
        self.encoder_first = nn.Sequential(_start(one, two, 2), *_residuals(two))
        self.encoder_second = nn.Sequential(_start(two, four, 2), *_residuals(four))
        self.midLSTM = _unused_memory(four)
        self.decoder_second = nn.Sequential(*_residuals(four), _enlarge(four, two))
        self.decoder_first = nn.Sequential(*_residuals(two), _enlarge(two, one))
        self.outBlock = nn.Sequential(*_residuals(one), nn.Conv2d(one, 3, 5, padding=2))
        self.transform1 = EventFusion(four, one)

    def forward(
        self, frames: Float[Tensor, "1 9 H W"], events: Float[Tensor, "1 40 H W"]
    ) -> Float[Tensor, "1 3 H W"]:
        """The sharp middle frame."""
        fine = self.inBlock(frames)
        middle = self.encoder_first(fine)
        coarse = self.transform1(
            self.encoder_second(middle), F.pixel_unshuffle(self.event_in(events), 2)
        )
        y = self.decoder_first(self.decoder_second(coarse) + middle)
        restored: Tensor = self.outBlock(y + fine)
        return restored


class EventFusion(nn.Module):
    """Non-local block (Wang et al. 2018) in which events ask features of the pictures."""

    def __init__(self, channels: int, inner: int) -> None:
        super().__init__()
        self.g = nn.Sequential(nn.Conv2d(channels, inner, 1), nn.MaxPool2d(2))
        self.W = nn.Conv2d(inner, channels, 1)
        self.theta = nn.Conv2d(channels, inner, 1)
        self.phi = nn.Sequential(nn.Conv2d(channels, inner, 1), nn.MaxPool2d(2))

    def forward(self, x: Tensor, events: Tensor) -> Tensor:
        """Same shape as ``x``."""
        key, value = self.phi(x).flatten(2), self.g(x).flatten(2)
        query = self.theta(events).flatten(2)
        weights = (query.transpose(1, 2) @ key / key.shape[-1]).softmax(-1)
        asked = (weights @ value.transpose(1, 2)).transpose(1, 2)
        fused: Tensor = x + self.W(asked.reshape(x.shape[0], -1, *x.shape[2:]))
        return fused


class Residual(nn.Module):
    """Two convolutions, channel attention, the input added."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 5, padding=2)
        self.conv2 = nn.Conv2d(channels, channels, 5, padding=2)
        self.se = _attention(channels)

    def forward(self, x: Tensor) -> Tensor:
        """Features of the same shape."""
        y = self.conv2(F.relu(self.conv1(x)))
        return x + y * self.se(y.mean((-2, -1)))[..., None, None]


def _attention(channels: int) -> nn.Module:
    inner = channels // 4
    layers = (nn.Linear(channels, inner), nn.ReLU(), nn.Linear(inner, channels), nn.Sigmoid())
    return nn.Sequential(OrderedDict(fc=nn.Sequential(*layers)))


def _unused_memory(channels: int) -> nn.Module:
    """Entries of the checkpoint for the memory between frames."""
    holder = nn.Module()
    for source in "xh":
        for gate in "fioj":
            holder.add_module(f"conv_{source}{gate}", nn.Conv2d(channels, channels, 3))
    holder.add_module("se", _attention(channels))
    return holder


def _residuals(channels: int) -> list[nn.Module]:
    return [Residual(channels) for _ in range(3)]


def _start(inputs: int, outputs: int, stride: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 5, stride, 2), _leaky())


def _enlarge(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.ConvTranspose2d(inputs, outputs, 3, 2, 1, 1), _leaky())


def _leaky() -> nn.Module:
    return nn.LeakyReLU(_SLOPE)
