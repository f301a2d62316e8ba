"""E2VID (Rebecq et al., TPAMI 2019), for the public checkpoint ``E2VID_lightweight.pth.tar``.

A recurrent U-Net that makes a grey picture of each window of events. Written anew; names and shapes
of the parameters are those of github.com/uzh-rpg/rpg_e2vid, whose code is GPL-3 and no part of
evsplat. Its size is read from the checkpoint, which states it.
"""

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from evsplat.errors import WeightsError
from evsplat.events import EventStream
from evsplat.events.maps import voxel_grid
from evsplat.restore.intensity import FromEvents
from evsplat.restore.network import enough_memory
from evsplat.weights import WeightFile, fill, named_tensors, read_state

EVENTS_PER_PIXEL = 0.35
"""About how many events its authors give the network at a time."""

_NUMBERS = {
    "num_bins": (5, 64),
    "num_encoders": (4, 5),
    "base_num_channels": (32, 64),
    "num_residual_blocks": (2, 16),
}
"""Usual values of what a checkpoint states, and the largest that are built."""

State = tuple[Tensor, Tensor]


class E2Vid(FromEvents):
    """Brightness from events by E2VID, colour from the blurry frame."""

    name = "e2vid"
    file: ClassVar = WeightFile(
        network="E2VID",
        name="E2VID_lightweight.pth.tar",
        size="about 43 MB",
        source="from rpg.ifi.uzh.ch/data/E2VID/models (its README: github.com/uzh-rpg/rpg_e2vid)",
        variable="EVSPLAT_E2VID",
    )
    _states: Sequence[State | None] = ()

    def load(self, path: Path) -> "RecurrentUNet":
        """The network in the shape that the checkpoint states under 'model'."""
        state = read_state(path)
        config = state.get("config")
        stated = state.get("model") or (config.get("model") if isinstance(config, dict) else None)
        if not isinstance(stated, Mapping) or not isinstance(state.get("state_dict"), Mapping):
            raise WeightsError(
                f"{path}: holds no 'model' and 'state_dict', expected {self.file.name}; fetch it "
                "again."
            )
        known = {"skip_type": "sum", "recurrent_block_type": "convlstm"}
        for key, value in known.items():
            if stated.get(key, value) != value:
                raise WeightsError(
                    f"{path}: model.{key}: expected {value!r} as in {self.file.name}, found "
                    f"{stated[key]!r}."
                )
        network = RecurrentUNet(
            bins=_number(stated, "num_bins", path),
            levels=_number(stated, "num_encoders", path),
            channels=_number(stated, "base_num_channels", path),
            residuals=_number(stated, "num_residual_blocks", path),
            normalised=stated.get("norm") == "BN",
            interpolated=bool(stated.get("use_upsample_conv", True)),
        )
        tensors = {
            name.removeprefix("unetrecurrent."): value
            for name, value in named_tensors(state["state_dict"]).items()
        }
        fill(network, tensors, path, what=self.file.name, part="unetrecurrent.")
        return network

    def reset(self) -> None:
        """Forget all windows so far."""
        self._states = ()

    @torch.inference_mode()
    def step(self, events: EventStream, height: int, width: int) -> Float[Tensor, "H W"]:
        """Intensity in [0, 1] at the end of a window, which is taken in equal parts."""
        count = max(1, round(len(events) / (EVENTS_PER_PIXEL * height * width)))
        edges = np.linspace(0, len(events), count + 1).round().astype(int)
        multiple = 2 ** len(self.network.encoders)
        # evenly on both sides, the odd pixel first
        down, right = -height % multiple, -width % multiple
        top, left = (down + 1) // 2, (right + 1) // 2
        picture = torch.empty(0)
        with enough_memory(self.name, height, width, self.device):
            for first, last in zip(edges, edges[1:], strict=False):
                part = events.take(slice(first, last))
                grid = voxel_grid(part, height, width, self.network.bins, scaling="standard")
                padded = F.pad(
                    grid[None].to(self.device),
                    (left, right - left, top, down - top),
                    mode="reflect",
                )
                made, self._states = self.network(padded, self._states)
                picture = made[0, 0, top : top + height, left : left + width]
        return picture

    def provenance(self) -> dict[str, Any]:
        """The weights and how events were grouped."""
        return {**super().provenance(), "events_per_pixel": EVENTS_PER_PIXEL}


def _number(stated: Mapping[str, Any], key: str, path: Path) -> int:
    """A number of layers or channels that a checkpoint states."""
    usual, most = _NUMBERS[key]
    found = stated.get(key, usual)
    try:
        number = int(found)
    except (TypeError, ValueError, OverflowError):
        number = 0
    if not 1 <= number <= most:
        raise WeightsError(
            f"{path}: model.{key}: expected a whole number from 1 to {most}, found "
            f"{str(found)[:60]!r}; this is not {E2Vid.file.name}."
        )
    return number


class RecurrentUNet(nn.Module):
    """Levels of half the resolution, each with a memory; skips are added."""

    def __init__(
        self,
        *,
        bins: int = 5,
        levels: int = 3,
        channels: int = 32,
        residuals: int = 2,
        normalised: bool = True,
        interpolated: bool = True,
    ) -> None:
        """``normalised``: batch normalisation; ``interpolated``: no transposed convolutions."""
        super().__init__()
        self.bins = bins
        widths = [channels * 2**level for level in range(levels + 1)]
        self.head = Convolution(bins, channels, 5)
        self.encoders = nn.ModuleList(
            Recurrent(narrow, wide, normalised)
            for narrow, wide in zip(widths, widths[1:], strict=False)
        )
        self.resblocks = nn.ModuleList(Residual(widths[-1], normalised) for _ in range(residuals))
        decoder = Enlarging if interpolated else Transposed
        self.decoders = nn.ModuleList(
            decoder(wide, wide // 2, normalised) for wide in reversed(widths[1:])
        )
        self.pred = Convolution(channels, 1, 1, normalised=normalised, rectified=False)

    def forward(
        self, grid: Float[Tensor, "1 B H W"], states: Sequence[State | None]
    ) -> tuple[Float[Tensor, "1 1 H W"], list[State | None]]:
        """The picture in [0, 1] and the memories after it; sides multiples of 2 per level."""
        head = x = self.head(grid)
        skips, after = [], []
        for encoder, state in zip(
            self.encoders, states or [None] * len(self.encoders), strict=True
        ):
            x, state = encoder(x, state)
            skips.append(x)
            after.append(state)
        for block in self.resblocks:
            x = block(x)
        for decoder in self.decoders:
            x = decoder(x + skips.pop())
        return torch.sigmoid(self.pred(x + head)), after


class Convolution(nn.Module):
    """Convolution, batch normalisation where there is one, rectifier where there is one."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        size: int,
        *,
        stride: int = 1,
        normalised: bool = False,
        rectified: bool = True,
    ) -> None:
        super().__init__()
        self.conv2d = nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=not normalised)
        self.norm_layer = nn.BatchNorm2d(outputs) if normalised else nn.Identity()
        self.act = nn.ReLU() if rectified else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        """At the resolution divided by the stride."""
        y: Tensor = self.act(self.norm_layer(self.conv2d(x)))
        return y


class Enlarging(Convolution):
    """Twice the resolution by interpolation, then a convolution."""

    def __init__(self, inputs: int, outputs: int, normalised: bool) -> None:
        super().__init__(inputs, outputs, 5, normalised=normalised)

    def forward(self, x: Tensor) -> Tensor:
        """Features at twice the resolution."""
        return super().forward(
            F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
        )


class Transposed(nn.Module):
    """Twice the resolution by a transposed convolution."""

    def __init__(self, inputs: int, outputs: int, normalised: bool) -> None:
        super().__init__()
        self.transposed_conv2d = nn.ConvTranspose2d(
            inputs, outputs, 5, stride=2, padding=2, output_padding=1, bias=not normalised
        )
        self.norm_layer = nn.BatchNorm2d(outputs) if normalised else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        """Features at twice the resolution."""
        return F.relu(self.norm_layer(self.transposed_conv2d(x)))


class Recurrent(nn.Module):
    """Half the resolution, then a convolutional LSTM (Shi et al. 2015)."""

    def __init__(self, inputs: int, outputs: int, normalised: bool) -> None:
        super().__init__()
        self.conv = Convolution(inputs, outputs, 5, stride=2, normalised=normalised)
        gates = nn.Conv2d(2 * outputs, 4 * outputs, 3, padding=1)
        self.recurrent_block = nn.Sequential(OrderedDict(Gates=gates))

    def forward(self, x: Tensor, state: State | None) -> tuple[Tensor, State]:
        """The output, and the output with the cells as the next memory."""
        x = self.conv(x)
        hidden, cell = state or (torch.zeros_like(x), torch.zeros_like(x))
        gates = self.recurrent_block(torch.cat((x, hidden), 1))
        write, keep, show, new = gates.chunk(4, 1)
        cell = keep.sigmoid() * cell + write.sigmoid() * new.tanh()
        hidden = show.sigmoid() * cell.tanh()
        return hidden, (hidden, cell)


class Residual(nn.Module):
    """Two convolutions, the input added before the last rectifier."""

    conv1: nn.Module
    conv2: nn.Module
    bn1: nn.Module
    bn2: nn.Module

    def __init__(self, channels: int, normalised: bool) -> None:
        super().__init__()
        for place in (1, 2):
            layer = nn.Conv2d(channels, channels, 3, padding=1, bias=not normalised)
            self.add_module(f"conv{place}", layer)
            norm = nn.BatchNorm2d(channels) if normalised else nn.Identity()
            self.add_module(f"bn{place}", norm)

    def forward(self, x: Tensor) -> Tensor:
        """Features of the same shape."""
        y = F.relu(self.bn1(self.conv1(x)))
        return F.relu(self.bn2(self.conv2(y)) + x)
