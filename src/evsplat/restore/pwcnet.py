"""PWC-Net (Sun et al., CVPR 2018): optical flow between two pictures, as D2Net uses it.

Written anew; names and shapes of the parameters are those of the flow networks inside the
checkpoints of github.com/shangwei5/D2Net.
"""

from collections import OrderedDict

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

_PYRAMID = (3, 16, 32, 64, 96, 128, 196)
_DENSE = (128, 128, 96, 64, 32)
_REACH_PX = 4
_COSTS = (2 * _REACH_PX + 1) ** 2
_SLOPE = 0.1
# Flow is estimated in units of this many pixels of the full picture.
_UNIT_PX = 20.0
_MULTIPLE = 64
_NAMES = ("One", "Two", "Thr", "Fou", "Fiv", "Six")


class PwcNet(nn.Module):
    """Six levels of features; flow from the coarsest to a quarter of the resolution."""

    moduleExtractor: nn.Module
    moduleRefiner: nn.Sequential

    def __init__(self) -> None:
        super().__init__()
        self.moduleExtractor = nn.Module()
        for name, inputs, outputs in zip(_NAMES, _PYRAMID, _PYRAMID[1:], strict=False):
            chain = _chain(inputs, outputs, outputs, outputs, stride=2)
            self.moduleExtractor.add_module(f"module{name}", chain)
        for level in range(2, 7):
            self.add_module(f"module{_NAMES[level - 1]}", Estimator(level))
        channels = Estimator.inputs(2) + sum(_DENSE)
        widths = (channels, 128, 128, 128, 96, 64, 32, 2)
        layers: list[nn.Module] = []
        for inputs, outputs, dilation in zip(
            widths, widths[1:], (1, 2, 4, 8, 16, 1, 1), strict=False
        ):
            layers += [nn.Conv2d(inputs, outputs, 3, 1, dilation, dilation), _leaky()]
        main = nn.Sequential(*layers[:-1])
        self.moduleRefiner = nn.Sequential(OrderedDict(moduleMain=main))

    def forward(
        self, first: Float[Tensor, "1 3 H W"], second: Float[Tensor, "1 3 H W"]
    ) -> Float[Tensor, "1 2 H W"]:
        """Offset (x, y) in pixels to where each pixel of ``first`` lies in ``second``."""
        height, width = first.shape[-2:]
        size = (height + -height % _MULTIPLE, width + -width % _MULTIPLE)
        pyramids = [self._features(_resized(picture, size)) for picture in (first, second)]
        flow, feature = None, None
        for level in range(6, 1, -1):
            estimate = self.get_submodule(f"module{_NAMES[level - 1]}")
            flow, feature = estimate(pyramids[0][level], pyramids[1][level], flow, feature)
        flow = _UNIT_PX * _resized(flow + self.moduleRefiner(feature), (height, width))
        scale = torch.tensor((width / size[1], height / size[0])).to(flow)
        return flow * scale[:, None, None]

    def _features(self, picture: Tensor) -> list[Tensor]:
        features = [picture]
        for name in _NAMES:
            features.append(self.moduleExtractor.get_submodule(f"module{name}")(features[-1]))
        return features


class Estimator(nn.Module):
    """Flow of one level, from the costs of small shifts after the flow of the level above."""

    moduleUpflow: nn.Module
    moduleUpfeat: nn.Module
    moduleSix: nn.Module

    def __init__(self, level: int) -> None:
        super().__init__()
        self._level = level
        channels = self.inputs(level)
        if level < 6:
            above = self.inputs(level + 1) + sum(_DENSE)
            self.moduleUpflow = nn.ConvTranspose2d(2, 2, 4, 2, 1)
            self.moduleUpfeat = nn.ConvTranspose2d(above, 2, 4, 2, 1)
        for name, outputs in zip(_NAMES, (*_DENSE, 2), strict=True):
            layer = nn.Conv2d(channels, outputs, 3, padding=1)
            rest = () if name == "Six" else (_leaky(),)
            self.add_module(f"module{name}", nn.Sequential(layer, *rest))
            channels += outputs

    @staticmethod
    def inputs(level: int) -> int:
        """Channels that a level starts from: costs, features, flow and two of the level above."""
        return _COSTS + (_PYRAMID[level] + 4 if level < 6 else 0)

    def forward(
        self, first: Tensor, second: Tensor, flow: Tensor | None, feature: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Flow of the level and what it was found from; both given but at the coarsest level."""
        if flow is None or feature is None:
            x = _costs(first, second)
        else:
            flow, feature = self.moduleUpflow(flow), self.moduleUpfeat(feature)
            second = warped(second, flow * (_UNIT_PX / 2**self._level), outside="zeros")
            x = torch.cat((_costs(first, second), first, flow, feature), 1)
        for name in _NAMES[:-1]:
            x = torch.cat((self.get_submodule(f"module{name}")(x), x), 1)
        return self.moduleSix(x), x


def warped(
    picture: Float[Tensor, "1 C H W"], flow: Float[Tensor, "1 2 H W"], *, outside: str
) -> Float[Tensor, "1 C H W"]:
    """``picture`` read at each pixel plus ``flow``; 0 wherever that reads beyond its border."""
    height, width = picture.shape[-2:]
    x = torch.arange(width).to(flow) + flow[:, 0]
    y = torch.arange(height).to(flow)[:, None] + flow[:, 1]
    grid = torch.stack((2 * x / max(width - 1, 1) - 1, 2 * y / max(height - 1, 1) - 1), -1)
    inside = F.grid_sample(torch.ones_like(picture[:, :1]), grid, align_corners=True) >= 0.999
    return F.grid_sample(picture, grid, padding_mode=outside, align_corners=True) * inside


def _costs(first: Tensor, second: Tensor) -> Tensor:
    """Mean product of features for each shift of up to four pixels, rows of x for each y."""
    height, width = first.shape[-2:]
    wide = F.pad(second, (_REACH_PX,) * 4)
    products = [
        (first * wide[..., y : y + height, x : x + width]).mean(1)
        for y in range(2 * _REACH_PX + 1)
        for x in range(2 * _REACH_PX + 1)
    ]
    return F.leaky_relu(torch.stack(products, 1), _SLOPE)


def _resized(x: Tensor, size: tuple[int, int]) -> Tensor:
    return F.interpolate(x, size, mode="bilinear", align_corners=False)


def _leaky() -> nn.Module:
    return nn.LeakyReLU(_SLOPE)


def _chain(*widths: int, stride: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for inputs, outputs in zip(widths, widths[1:], strict=False):
        layers += [nn.Conv2d(inputs, outputs, 3, 1 if layers else stride, 1), _leaky()]
    return nn.Sequential(*layers)
