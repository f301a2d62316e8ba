"""What all restorers have in common that run a pretrained network on each frame."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from evsplat.capture import Frame, TrainingCapture
from evsplat.devices import network_device
from evsplat.errors import BackendError
from evsplat.restore.needs import require_signed_events
from evsplat.restore.tiles import OVERLAP_PX, SIDE_PX, in_tiles
from evsplat.weights import WeightFile, sha256_of

# what torch says on Linux and on Windows
_CPU_SIGNS = ("can't allocate memory", "not enough memory")


class NetworkRestorer(ABC):
    """Sharp pictures by a network that takes some inputs of each frame and gives its picture."""

    name: str
    file: ClassVar[WeightFile]
    multiple: ClassVar[int]
    """The network wants sides that are a multiple of this."""
    needs_events: ClassVar[bool]

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
        self.weights = self.file.find(weights)
        self.device = network_device(device)
        self.network = self.load(self.weights).to(self.device)

    @abstractmethod
    def load(self, path: Path) -> nn.Module:
        """The network with the weights of ``path``."""

    @abstractmethod
    def inputs(self, capture: TrainingCapture, frame: Frame) -> Sequence[Float[Tensor, "1 _ H W"]]:
        """What the network takes for a frame."""

    def restore(
        self, capture: TrainingCapture, frames: Sequence[Frame]
    ) -> Iterator[tuple[Frame, Float[Tensor, "H W 3"]]]:
        """See `Restorer`."""
        for frame in frames:
            inputs = [part.to(self.device) for part in self.inputs(capture, frame)]
            height, width = inputs[0].shape[-2:]
            with torch.inference_mode(), enough_memory(self.name, height, width, self.device):
                picture = in_tiles(self.network, inputs, multiple=self.multiple)
            yield frame, picture[0].permute(1, 2, 0).clamp(0, 1).cpu().contiguous()

    def provenance(self) -> dict[str, Any]:
        """The weights and how large pictures were cut."""
        return {
            "weights": self.weights.name,
            "sha256": sha256_of(self.weights),
            "tile_px": SIDE_PX,
            "overlap_px": OVERLAP_PX,
        }


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
