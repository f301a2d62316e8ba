"""Distance of two images in the features of a convolutional network (Zhang et al. 2018)."""

import copy
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from evsplat.devices import send

# Normalisation that the networks were trained with, for input in [-1, 1].
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)


class Blur(nn.Module):
    """Depthwise 3×3 filter: reflect-padded by 2, stride 2."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.filt = nn.Parameter(torch.empty(channels, 1, 3, 3))

    def forward(self, x: Float[Tensor, "B C H W"]) -> Float[Tensor, "B C h w"]:
        """Features at half the resolution."""
        padded = F.pad(x, (2, 2, 2, 2), mode="reflect")
        return F.conv2d(padded, self.filt, stride=2, groups=len(self.filt))


Stage = Mapping[str, nn.Module]
"""Layers in their order, by the names that the weight file has for them."""


@dataclass(frozen=True)
class Network:
    """A feature network: the output of each stage takes part in the distance."""

    name: str
    stages: Sequence[Stage]
    """Layers without values (on the meta device), or with them: see `filled`."""
    min_side: int
    """Shortest image side, in pixels, that leaves something to compare after the last stage."""

    @property
    def layers(self) -> dict[str, nn.Module]:
        """All layers, by the names that the weight file has for them."""
        return {key: layer for stage in self.stages for key, layer in stage.items()}

    @property
    def parameter_shapes(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes of all parameters, as they are called in the weight file."""
        return {
            f"{key}.{name}": tuple(value.shape)
            for key, layer in self.layers.items()
            for name, value in layer.state_dict().items()
        }

    def filled(self, parameters: Mapping[str, Tensor]) -> "Network":
        """The network with values for its parameters, for inference."""
        network = replace(self, stages=copy.deepcopy(self.stages))
        for key, layer in network.layers.items():
            own = {name: _channels_last(parameters[f"{key}.{name}"]) for name in layer.state_dict()}
            layer.load_state_dict(own, assign=True)
            layer.requires_grad_(False)
        return network

    def features(self, x: Float[Tensor, "B 3 H W"]) -> list[Float[Tensor, "B C h w"]]:
        """Output of every stage; ``x`` is in [-1, 1]."""
        shift, scale = send(torch.tensor([_SHIFT, _SCALE], dtype=x.dtype), x.device)
        x = (x - shift.view(3, 1, 1)) / scale.view(3, 1, 1)
        outputs = []
        for stage in self.stages:
            for layer in stage.values():
                x = layer(x)
            outputs.append(x)
        return outputs


def _channels_last(value: Tensor) -> Tensor:
    """As pictures have them, for filters: pooling and blurring are then three times as fast."""
    value = value.detach()
    return value.contiguous(memory_format=torch.channels_last) if value.dim() == 4 else value


def numbered(stages: Iterable[Iterable[nn.Module]], name: str) -> list[Stage]:
    """Layers by their names, which count stages from 1 and places of layers through all stages."""
    places = itertools.count()
    return [
        {name.format(stage=stage, place=next(places)): layer for layer in layers}
        for stage, layers in enumerate(stages, 1)
    ]


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
        self.device = torch.device(device)
        self.network = network.filled({k: v.to(self.device) for k, v in parameters.items()})
        self.sha256 = sha256
        """Checksum of the file that the network's weights came from."""
        self._heads = [head.detach().to(self.device) for head in heads]
        self._keep_bytes = 0
        self._kept: list[tuple[Tensor, Features]] = []

    def keeping(self, limit_bytes: int) -> "PerceptualMetric":
        """The same metric, which knows the images it was shown last, without their gradients."""
        keeping = copy.copy(self)
        keeping._keep_bytes, keeping._kept = limit_bytes, []
        return keeping

    def features(self, image: Float[Tensor, "H W 3"]) -> Features:
        """Normalised features of an image in [-1, 1]; a ValueError where it is too small."""
        if not self._keep_bytes:
            return self._features(image)
        for known, features in self._kept:
            if (known.shape, known.dtype) == (image.shape, image.dtype) and known.equal(image):
                return features
        with torch.no_grad():
            features = self._features(image)
        self._kept.append((image.detach().clone(), features))
        sizes = [sum(part.nbytes for part in kept) for _, kept in self._kept]
        while sum(sizes) > self._keep_bytes:
            del self._kept[0], sizes[0]
        return features

    def _features(self, image: Float[Tensor, "H W 3"]) -> Features:
        if min(image.shape[:2]) < self.network.min_side:
            raise ValueError(
                f"{self.network.name} needs sides of at least {self.network.min_side} pixels"
            )
        dtype = self._heads[0].dtype
        x = image.to(self.device, dtype).movedim(-1, 0)[None]
        # 1e-10 outside the root, as in the reference code: it keeps all-zero vectors zero.
        return [
            (f / (f.square().sum(dim=1, keepdim=True).sqrt() + 1e-10))[0]
            for f in self.network.features(x)
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
