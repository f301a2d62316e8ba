"""Distance of two images in the features of a convolutional network (Zhang et al. 2018)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from evsplat.devices import send

# Normalisation that the networks were trained with, for input in [-1, 1].
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)


@dataclass(frozen=True)
class Conv:
    """Convolution with the weight and bias stored under ``key``."""

    key: str
    shape: tuple[int, int, int, int]
    """Shape of the weight: channels out, channels in, height, width."""
    stride: int = 1
    padding: int = 1


@dataclass(frozen=True)
class MaxPool:
    """Largest value of each window."""

    size: int
    stride: int


@dataclass(frozen=True)
class Blur:
    """Depthwise 3×3 filter stored under ``key`` + ".filt": reflect-padded by 2, stride 2."""

    key: str
    channels: int


@dataclass(frozen=True)
class Relu:
    """Negative values become zero."""


Layer = Conv | MaxPool | Blur | Relu


@dataclass(frozen=True)
class Network:
    """A feature network: the output of each stage takes part in the distance."""

    name: str
    stages: tuple[tuple[Layer, ...], ...]
    min_side: int
    """Shortest image side, in pixels, that leaves something to compare after the last stage."""

    @property
    def channels(self) -> tuple[int, ...]:
        """Channels of the output of each stage."""
        return tuple(
            next(layer.shape[0] for layer in reversed(stage) if isinstance(layer, Conv))
            for stage in self.stages
        )

    @property
    def parameter_shapes(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes of all parameters, as they are called in the weight file."""
        shapes: dict[str, tuple[int, ...]] = {}
        for stage in self.stages:
            for layer in stage:
                if isinstance(layer, Conv):
                    shapes[f"{layer.key}.weight"] = layer.shape
                    shapes[f"{layer.key}.bias"] = layer.shape[:1]
                elif isinstance(layer, Blur):
                    shapes[f"{layer.key}.filt"] = (layer.channels, 1, 3, 3)
        return shapes

    def features(
        self, x: Float[Tensor, "B 3 H W"], parameters: Mapping[str, Tensor]
    ) -> list[Float[Tensor, "B C h w"]]:
        """Output of every stage; ``x`` is in [-1, 1]."""
        shift, scale = send(torch.tensor([_SHIFT, _SCALE], dtype=x.dtype), x.device)
        x = (x - shift.view(3, 1, 1)) / scale.view(3, 1, 1)
        outputs = []
        for stage in self.stages:
            for layer in stage:
                x = _apply(layer, x, parameters)
            outputs.append(x)
        return outputs


def _apply(layer: Layer, x: Tensor, parameters: Mapping[str, Tensor]) -> Tensor:
    match layer:
        case Conv(key, _, stride, padding):
            weight, bias = parameters[f"{key}.weight"], parameters[f"{key}.bias"]
            return F.conv2d(x, weight, bias, stride, padding)
        case MaxPool(size, stride):
            return F.max_pool2d(x, size, stride)
        case Blur(key, channels):
            padded = F.pad(x, (2, 2, 2, 2), mode="reflect")
            return F.conv2d(padded, parameters[f"{key}.filt"], stride=2, groups=channels)
        case Relu():
            return F.relu(x)


Features = Sequence[Float[Tensor, "C h w"]]
"""Feature maps of one image, each pixel's vector scaled to length one."""


class PerceptualMetric:
    """A network with its weights; 0 for equal images, larger for less alike ones."""

    def __init__(
        self,
        network: Network,
        parameters: Mapping[str, Tensor],
        heads: Sequence[Float[Tensor, " C"]],
        *,
        sha256: str,
        device: torch.device | str = "cpu",
    ) -> None:
        self.network = network
        self.sha256 = sha256
        """Checksum of the file that the network's weights came from."""
        self.device = torch.device(device)
        self._parameters = {k: v.detach().to(self.device) for k, v in parameters.items()}
        self._heads = [head.detach().to(self.device) for head in heads]

    def features(self, image: Float[Tensor, "H W 3"]) -> Features:
        """Normalised features of an image in [-1, 1]; a ValueError where it is too small."""
        if min(image.shape[:2]) < self.network.min_side:
            raise ValueError(
                f"{self.network.name} needs sides of at least {self.network.min_side} pixels"
            )
        dtype = self._heads[0].dtype
        x = image.to(self.device, dtype).movedim(-1, 0)[None]
        # 1e-10 outside the root, as in the reference code: it keeps all-zero vectors zero.
        return [
            (f / (f.square().sum(dim=1, keepdim=True).sqrt() + 1e-10))[0]
            for f in self.network.features(x, self._parameters)
        ]

    def compare(self, first: Features, second: Features) -> Float[Tensor, ""]:
        """Distance of two images given by their features."""
        total = self._heads[0].new_zeros(())
        for head, a, b in zip(self._heads, first, second, strict=True):
            total = total + ((a - b).square() * head.view(-1, 1, 1)).sum(dim=0).mean()
        return total

    def __call__(
        self, image: Float[Tensor, "H W 3"], reference: Float[Tensor, "H W 3"]
    ) -> Float[Tensor, ""]:
        """Distance of two images in [-1, 1]."""
        return self.compare(self.features(image), self.features(reference))
