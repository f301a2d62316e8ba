"""Up-sampling by Super SloMo (Jiang et al. 2018), for the public PyTorch checkpoint.

Two U-Nets: one finds the flow between the pictures (paper section 3.1), the other refines the
flows and finds the visibility at a time in between (section 3.2). Names and shapes of the
parameters are those of ``SuperSloMo.ckpt`` of github.com/avinashpaliwal/Super-SloMo (MIT), which is
trained on Adobe240fps. Weights are never downloaded and never shipped.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from evsplat.errors import WeightsError
from evsplat.pictures.light import Transfer, decode
from evsplat.synthesis.interpolate import Picture
from evsplat.weights import WeightFile, fill, named_tensors, read_state, sha256_of

CHECKPOINT = WeightFile(
    network="Super SloMo",
    name="SuperSloMo.ckpt",
    size="151 MB",
    source="by the link in the README of github.com/avinashpaliwal/Super-SloMo (--interpolation "
    "flow needs no weights)",
    variable="EVSPLAT_SUPER_SLOMO",
)
_NETWORKS = {"state_dictFC": (6, 4), "state_dictAT": (20, 5)}
# The checkpoint was trained on pictures with these channel means taken off.
_MEAN_RGB = (0.429, 0.431, 0.397)
# Five halvings, so sides must be multiples of this.
_MULTIPLE = 32


class _Down(nn.Module):
    def __init__(self, inputs: int, outputs: int, size: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, size, padding=size // 2)
        self.conv2 = nn.Conv2d(outputs, outputs, size, padding=size // 2)

    def forward(self, x: Tensor) -> Tensor:
        return _leaky(self.conv2(_leaky(self.conv1(F.avg_pool2d(x, 2)))))


class _Up(nn.Module):
    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, padding=1)
        self.conv2 = nn.Conv2d(2 * outputs, outputs, 3, padding=1)

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        x = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
        return _leaky(self.conv2(torch.cat((_leaky(self.conv1(x)), skip), 1)))


class UNet(nn.Module):
    """Six levels with skips, as both networks of Super SloMo are built (paper figure 4)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, 32, 7, padding=3)
        self.conv2 = nn.Conv2d(32, 32, 7, padding=3)
        self.down1 = _Down(32, 64, 5)
        self.down2 = _Down(64, 128, 3)
        self.down3 = _Down(128, 256, 3)
        self.down4 = _Down(256, 512, 3)
        self.down5 = _Down(512, 512, 3)
        self.up1 = _Up(512, 512)
        self.up2 = _Up(512, 256)
        self.up3 = _Up(256, 128)
        self.up4 = _Up(128, 64)
        self.up5 = _Up(64, 32)
        self.conv3 = nn.Conv2d(32, outputs, 3, padding=1)

    def forward(self, x: Float[Tensor, "B Cin H W"]) -> Float[Tensor, "B Cout H W"]:
        """Sides are multiples of 32."""
        skips = [_leaky(self.conv2(_leaky(self.conv1(x))))]
        for down in (self.down1, self.down2, self.down3, self.down4, self.down5):
            skips.append(down(skips[-1]))
        x = skips.pop()
        for up in (self.up1, self.up2, self.up3, self.up4, self.up5):
            x = up(x, skips.pop())
        return _leaky(self.conv3(x))


class SuperSloMo:
    """Interpolates with Super SloMo (`Interpolator`).

    ``transfer`` decodes what the networks give, which is coded as the input (`Picture.coded`).
    """

    def __init__(self, transfer: Transfer, weights: Path | str | None = None) -> None:
        self._transfer: Transfer = transfer
        path = CHECKPOINT.find(weights)
        state = read_state(path)
        self.sha256 = sha256_of(path)
        self._flow, self._refine = (
            _network(path, state, key, *channels) for key, channels in _NETWORKS.items()
        )

    @torch.inference_mode()
    def between(
        self, before: Picture, after: Picture, fractions: Sequence[float]
    ) -> Iterator[Float[np.ndarray, "H W C"]]:
        """Linear light at each fraction of the way from ``before`` to ``after``."""
        height, width, channels = before.coded.shape
        first, second = _as_input(before.coded), _as_input(after.coded)
        flows = self._flow(torch.cat((first, second), 1))
        for fraction in fractions:
            rgb = self._at(first, second, flows, fraction) + _mean()
            coded = rgb[0, :, :height, :width].clamp(0, 1).permute(1, 2, 0)
            if channels == 1:
                coded = coded.mean(-1, keepdim=True)
            yield decode(coded, self._transfer).numpy()

    def _at(
        self,
        first: Float[Tensor, "1 3 H W"],
        second: Float[Tensor, "1 3 H W"],
        flows: Float[Tensor, "1 4 H W"],
        t: float,
    ) -> Float[Tensor, "1 3 H W"]:
        forward, backward = flows[:, :2], flows[:, 2:]
        # eq. 4: what the flows between the pictures say of those from time t
        to_first = -t * (1 - t) * forward + t * t * backward
        to_second = (1 - t) ** 2 * forward - t * (1 - t) * backward
        near = (backward_warp(second, to_second), backward_warp(first, to_first))
        seen = torch.cat((first, second, forward, backward, to_second, to_first, *near), 1)
        refined = self._refine(seen)
        visible = torch.sigmoid(refined[:, 4:5])
        weight_first, weight_second = (1 - t) * visible, t * (1 - visible)
        blended = weight_first * backward_warp(first, to_first + refined[:, :2])
        blended += weight_second * backward_warp(second, to_second + refined[:, 2:4])
        return blended / (weight_first + weight_second)


def backward_warp(
    image: Float[Tensor, "B C H W"], flow: Float[Tensor, "B 2 H W"]
) -> Float[Tensor, "B C H W"]:
    """``image`` read at each pixel plus ``flow`` (x, y), bilinear, zero outside.

    Places are scaled as in the code that trained the checkpoint (PyTorch 0.4, corners aligned):
    coordinate x reads pixel x (W - 1) / W.
    """
    height, width = image.shape[-2:]
    x = torch.arange(width).to(flow) + flow[:, 0]
    y = torch.arange(height).to(flow)[:, None] + flow[:, 1]
    grid = torch.stack((2 * x / width - 1, 2 * y / height - 1), -1)
    return F.grid_sample(image, grid, align_corners=True)


def _leaky(x: Tensor) -> Tensor:
    return F.leaky_relu(x, 0.1)


def _mean() -> Float[Tensor, "3 1 1"]:
    return torch.tensor(_MEAN_RGB)[:, None, None]


def _as_input(coded: Float[np.ndarray, "H W C"]) -> Float[Tensor, "1 3 H2 W2"]:
    """Mean taken off, grey made RGB, sides made multiples of 32 by repeating the border."""
    height, width = coded.shape[:2]
    picture = torch.from_numpy(coded).permute(2, 0, 1).expand(3, -1, -1) - _mean()
    padding = (0, -width % _MULTIPLE, 0, -height % _MULTIPLE)
    return F.pad(picture[None], padding, mode="replicate")


def _network(path: Path, state: dict[str, Any], key: str, inputs: int, outputs: int) -> UNet:
    if not isinstance(state.get(key), dict):
        raise WeightsError(
            f"{path}: holds no {key!r}, expected {CHECKPOINT.name} with "
            f"{' and '.join(_NETWORKS)}; fetch it again."
        )
    what = f"{CHECKPOINT.name} of colour pictures"
    network = UNet(inputs, outputs)
    fill(network, named_tensors(state[key]), path, what=what, part=f"{key}.")
    return network
