"""PIE-Net: pictures from events by a network whose weights are on the package registry.

The package ``event-pienet`` (MIT) holds definition and weights. Its own loader builds the full
network without the block that its checkpoint has after each recurrent layer and leaves those
weights out without a word; here the network is built as it was trained and loaded whole.
"""

import importlib
import importlib.util
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from evsplat.capture import TrainingCapture
from evsplat.errors import DataError, WeightsError
from evsplat.events import EventStream
from evsplat.events.maps import voxel_grid
from evsplat.restore.intensity import FromEvents
from evsplat.weights import MissingWeights, read_state

PACKAGE = "pie_net"
DISTRIBUTION = "event-pienet"
INSTALL = f"pip install --no-deps {DISTRIBUTION}"
BINS = 5
# Three poolings by 2, 2 and 5.
_LEAST_SIDE = 20


class PieNet(FromEvents):
    """Brightness from events by the full PIE-Net, colour from the blurry frame."""

    name = "pienet"

    def __init__(self, capture: TrainingCapture, *, device: str = "auto") -> None:
        """Raises `WeightsError` where the package is not installed, or another one than 1.1.3."""
        super().__init__(capture, device=device)

    @classmethod
    def find(cls, weights: Path | str | None = None) -> Path:
        """The weight file in the installed package."""
        return find_weights()

    def load(self, path: Path) -> nn.Module:
        """The network as it was trained; takes 5-bin voxel grids as they are."""
        state = read_state(path)
        try:
            definition = importlib.import_module(f"{PACKAGE}.model")
            params = {**definition.CONFIG_PIENET, "n_rep_dn": [1, 1, 1]}
            network: nn.Module = definition.PIENet()
            network.model = definition.SingleEncoderEffUNet_v3(BINS, 1, 3, params)
            network.load_state_dict(state)
        except (ImportError, AttributeError, TypeError, RuntimeError) as error:
            reason = str(error).splitlines()[0]
            raise WeightsError(
                f"{path}: not the network of {DISTRIBUTION} 1.1.3 ({reason}); get it with: "
                f"{INSTALL}==1.1.3."
            ) from error
        return network.eval()

    def reset(self) -> None:
        """Forget all windows so far."""
        self.network.reset_states()

    @torch.inference_mode()
    def step(self, events: EventStream, height: int, width: int) -> Float[Tensor, "H W"]:
        """Intensity in [0, 1] at the end of a window; bins reach from its first to last event."""
        if min(height, width) < _LEAST_SIDE:
            raise DataError(
                f"pictures of {width}x{height} pixels are too small for pienet, which needs "
                f"{_LEAST_SIDE} pixels each way; use --with edi."
            )
        grid = voxel_grid(events, height, width, BINS).to(self.device)
        picture: Tensor = self.network(grid[None])["image"][0, 0]
        return picture

    def provenance(self) -> dict[str, Any]:
        """Package and weights."""
        return {"package": f"{DISTRIBUTION} {version(DISTRIBUTION)}", **super().provenance()}


def find_weights() -> Path:
    """The weight file in the installed package."""
    spec = importlib.util.find_spec(PACKAGE)
    if spec is None or not spec.submodule_search_locations:
        raise MissingWeights(
            f"PIE-Net: the package {DISTRIBUTION} (1 MB, weights inside) is not installed; get it "
            f"with: {INSTALL} (it declares torchvision, which it never imports)."
        )
    path = Path(spec.submodule_search_locations[0]) / "pretrained" / "model.pth"
    if not path.is_file():
        raise WeightsError(f"{path}: file not found; get it again with: {INSTALL}.")
    return path
