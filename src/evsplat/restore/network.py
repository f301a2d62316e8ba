"""Bases of restorers with a pretrained network, one that runs it on each frame, in tiles."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from evsplat.capture import Frame, TrainingCapture, coded
from evsplat.devices import network_device
from evsplat.errors import BackendError, DataError
from evsplat.pictures import stored
from evsplat.weights import WeightFile, sha256_of

SIDE_PX = 512
"""Longest side of a tile; all the pictures that fit go through whole."""
OVERLAP_PX = 64
# what torch says on Linux and on Windows
_CPU_SIGNS = ("can't allocate memory", "not enough memory")


class Pretrained(ABC):
    """A restorer with a pretrained network."""

    name: str
    file: ClassVar[WeightFile]
    needs_events: ClassVar[bool] = True

    def __init__(
        self, capture: TrainingCapture, *, weights: Path | str | None = None, device: str = "auto"
    ) -> None:
        """``weights``: the file; else looked for as `WeightFile.find` says.

        Raises:
            WeightsError: There is none, or it is not this network's.
            DataError: The capture has no events, or no polarity, and the network needs it.
        """
        if self.needs_events:
            require_signed_events(capture, self.name)
        self.weights = self.find(weights)
        self.device = network_device(device)
        self.network = self.load(self.weights).to(self.device)

    @classmethod
    def find(cls, weights: Path | str | None = None) -> Path:
        """The weight file; `MissingWeights` where there is none."""
        return cls.file.find(weights)

    @abstractmethod
    def load(self, path: Path) -> Any:
        """The network with the weights of ``path``."""

    def provenance(self) -> dict[str, Any]:
        """The weights."""
        return {"weights": self.weights.name, "sha256": sha256_of(self.weights)}


class NetworkRestorer(Pretrained):
    """Sharp pictures by a network that takes some inputs of each frame and gives its picture."""

    multiple: ClassVar[int]
    """The network wants sides that are a multiple of this."""

    def inputs(self, capture: TrainingCapture, frame: Frame) -> Sequence[Float[Tensor, "1 _ H W"]]:
        """Inputs of the network for a frame: the blurry picture, where it takes nothing else."""
        return [as_input(capture.image(frame))]

    def restore(
        self, capture: TrainingCapture, frames: Sequence[Frame]
    ) -> Iterator[tuple[Frame, Float[Tensor, "H W 3"]]]:
        """See `Restorer`."""
        seen = coded(capture)
        for frame in frames:
            inputs = [part.to(self.device) for part in self.inputs(seen, frame)]
            height, width = inputs[0].shape[-2:]
            with torch.inference_mode(), enough_memory(self.name, height, width, self.device):
                picture = in_tiles(self.network, inputs, multiple=self.multiple)
            picture = picture[0].permute(1, 2, 0).clamp(0, 1).cpu().contiguous()
            yield frame, stored(picture, capture.transfer(frame))

    def provenance(self) -> dict[str, Any]:
        """The weights and how large pictures were cut."""
        return {**super().provenance(), "tile_px": SIDE_PX, "overlap_px": OVERLAP_PX}


class SupervisedAttention(nn.Module):
    """Features that one stage passes on to the next, weighted by its own picture."""

    def __init__(self, channels: int, size: int, *, bias: bool) -> None:
        """``size`` of the convolutions, pixels."""
        super().__init__()
        self.conv1, self.conv2, self.conv3 = (
            nn.Conv2d(inputs, outputs, size, padding=size // 2, bias=bias)
            for inputs, outputs in ((channels, channels), (channels, 3), (3, channels))
        )

    def forward(
        self, x: Float[Tensor, "1 C H W"], picture: Float[Tensor, "1 3 H W"]
    ) -> Float[Tensor, "1 C H W"]:
        """Features for the next stage."""
        attention = torch.sigmoid(self.conv3(self.conv2(x) + picture))
        return x + self.conv1(x) * attention


def as_input(picture: Float[Tensor, "H W C"]) -> Float[Tensor, "1 C H W"]:
    """A picture in the order that networks take."""
    return picture.permute(2, 0, 1)[None]


@contextmanager
def enough_memory(name: str, height: int, width: int, device: torch.device) -> Iterator[None]:
    """Tell in one sentence that a picture does not fit into the memory of a device."""
    try:
        yield
    except RuntimeError as error:
        is_cuda = isinstance(error, torch.OutOfMemoryError)
        if not is_cuda and not any(sign in str(error) for sign in _CPU_SIGNS):
            raise
        raise BackendError(
            f"{name}: a picture of {width}x{height} pixels does not fit into the memory of the "
            f"{device.type}; use {'--device cpu' if is_cuda else 'a machine with more memory'}, or "
            "a smaller capture."
        ) from error


def require_signed_events(capture: TrainingCapture, restorer: str) -> None:
    """Raises `DataError` where the capture has no events, or they have no polarity."""
    if capture.events is None:
        raise DataError(
            f"{capture.path}: has no events, which {restorer} needs; record or simulate them first."
        )
    if not capture.events.has_polarity:
        raise DataError(
            f"{capture.events.path}: no event has a polarity (events/p is 0 throughout), which "
            f"{restorer} needs; record or simulate them with it."
        )


def in_tiles(
    network: Callable[..., Float[Tensor, "1 C h w"]],
    inputs: Sequence[Float[Tensor, "1 _ H W"]],
    *,
    multiple: int,
    side: int = SIDE_PX,
    overlap: int = OVERLAP_PX,
) -> Float[Tensor, "1 C H W"]:
    """``network(*inputs)``, tile by tile where the pictures are larger than ``side``.

    Each tile is padded to sides that are a multiple of ``multiple`` by repeating its border, and
    neighbours are blended linearly over their overlap.
    """
    height, width = inputs[0].shape[-2:]
    total: Tensor | None = None
    share = torch.zeros(height, width, device=inputs[0].device)
    for top in _starts(height, side, overlap):
        for left in _starts(width, side, overlap):
            place = (..., slice(top, top + side), slice(left, left + side))
            parts = [part[place] for part in inputs]
            h, w = parts[0].shape[-2:]
            padding = (0, -w % multiple, 0, -h % multiple)
            made = network(*(F.pad(part, padding, mode="replicate") for part in parts))[..., :h, :w]
            weight = _ramp(h, overlap).to(made)[:, None] * _ramp(w, overlap).to(made)
            if total is None:
                total = made.new_zeros((*made.shape[:-2], height, width))
            total[place] += weight * made
            share[place] += weight
    assert total is not None
    return total / share


def _starts(length: int, side: int, overlap: int) -> list[int]:
    """Starts of tiles, evenly spread and overlapping by at least ``overlap``."""
    if length <= side:
        return [0]
    count = -(-(length - overlap) // (side - overlap))
    return [round(i * (length - side) / (count - 1)) for i in range(count)]


def _ramp(length: int, overlap: int) -> Float[Tensor, "L"]:
    """Grows from the border inwards over ``overlap`` pixels, and is 1 further in."""
    at = torch.arange(1, length + 1)
    return torch.minimum(at, at.flip(0)).clamp_max(overlap + 1) / (overlap + 1)
