"""Where along the rays of a camera at rest its scene lies, as the shadows on it tell."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from evsplat.camera import Camera
from evsplat.devices import constant
from evsplat.models.kept import Kept
from evsplat.models.layers import SceneShadow

_COARSE, _FINE = 8, 64
"""Cells along each side of the picture; the coarse ones move as one what many pixels agree on."""
_LOG_DEPTH, _LOG_STRENGTH = 0.2, 0.5
"""Units of what is learned."""
_ABSOLUTE = 0.1
"""Weight of a value against that of its difference to a neighbour."""
_NEAREST_M = 0.1
_DARKEST = 1e-3


class Relief(nn.Module):
    """What a camera at rest cannot see of its scene, but the person's shadow on it tells.

    Such a scene starts on a floor and a wall, and its pictures are the same wherever along the
    camera's rays it is: furniture stands farther forward. A shadow that falls on it there has
    another shape. How dark it is depends on how a surface is turned to the lamps. Both are learned
    on a grid over the recorded picture; a place of any other view is looked up where it is in it.
    """

    center: Tensor
    to_picture: Tensor
    stencil: Tensor

    def __init__(self, camera: Camera) -> None:
        """Start at the places that are given, of strength 1. ``camera``: the recording one."""
        super().__init__()
        half = torch.tensor([camera.width, camera.height]) / 2
        to_unit = torch.diag(torch.cat([1 / half, torch.ones(1)]))
        to_unit[:2, 2] = -1.0
        pose = camera.world_to_camera.cpu()
        self.register_buffer("center", camera.center().cpu(), persistent=False)
        self.register_buffer("to_picture", to_unit @ camera.K @ pose[:3], persistent=False)
        self.coarse = nn.Parameter(torch.zeros(1, 2, _COARSE, _COARSE))
        self.fine = nn.Parameter(torch.zeros(1, 2, _FINE, _FINE))
        self.register_buffer("stencil", _stencil(), persistent=False)
        self._kept, self._seen = Kept(), Kept()

    def forward(
        self, places: Float[Tensor, "H W 3"]
    ) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"]]:
        """Where the scene of ``places`` (world, metres) is, and the exponents of its shadows."""
        at, rays = self._seen.of([places], lambda: self._looked_up(places))
        learned = F.grid_sample(
            self._learned(), at[None], padding_mode="border", align_corners=False
        ).squeeze(0)
        units = constant((_LOG_DEPTH, _LOG_STRENGTH), learned)[:, None, None]
        farther, exponents = (units * learned).exp().unbind(0)
        return self.center + rays * farther[..., None], exponents

    def _looked_up(
        self, places: Float[Tensor, "H W 3"]
    ) -> tuple[Float[Tensor, "H W 2"], Float[Tensor, "H W 3"]]:
        """Where in the recorded picture they are, -1 to 1, and the ways there from its camera."""
        to_picture = self.to_picture
        seen = torch.addmm(to_picture[:, 3], places.flatten(0, 1), to_picture[:, :3].T)
        at = seen[:, :2] / seen[:, 2:].clamp_min(_NEAREST_M)
        return at.view(*places.shape[:2], 2), places - self.center

    def price(self) -> Float[Tensor, ""]:
        """Differences of neighbours, squared, and a tenth of the squares; to be kept small.

        Adam moves cells that next to no shadow reaches as far as any other.
        """
        price: Tensor = _Quadratic.apply(self._learned(), self.stencil)
        return price

    def _learned(self) -> Float[Tensor, "1 2 C C"]:
        """Depth and strength of all cells."""
        size = self.fine.shape[2:]
        return self.fine + F.interpolate(self.coarse, size, mode="bilinear", align_corners=False)

    def shade(self, places: Float[Tensor, "H W 3"], shadow: SceneShadow) -> Float[Tensor, "T H W"]:
        """Factors on the scene's colours where its ``places`` are, as dark as it is turned."""
        given = (places, self.coarse, self.fine)
        there, exponents = self._kept.of(given, lambda: self(places))
        shaded: Tensor = _Power.apply(shadow(there), exponents)
        return shaded


def _stencil() -> Float[Tensor, "2 1 3 3"]:
    """Half the gradient of `Relief.price` by a cell: weights of the cell and of its neighbours."""
    cells, pairs = 2 * _FINE**2, 2 * _FINE * (_FINE - 1)
    cross = torch.tensor([[0.0, 1.0, 0.0], [1.0, -4.0, 1.0], [0.0, 1.0, 0.0]])
    middle = torch.tensor([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    return (_ABSOLUTE / cells * middle - cross / pairs).expand(2, 1, 3, 3).contiguous()


class _Quadratic(torch.autograd.Function):
    """``x . H x`` of a stencil H, with the cells at the edges going on beyond them.

    There a difference is 0, so that it is a sum of squared differences, by which autograd would
    take several times as many operations.
    """

    @staticmethod
    def forward(
        ctx: Any, cells: Float[Tensor, "1 2 C C"], stencil: Float[Tensor, "2 1 3 3"]
    ) -> Float[Tensor, ""]:
        goes_on = F.pad(cells, (1, 1, 1, 1), mode="replicate")
        half = F.conv2d(goes_on, stencil, groups=2)
        ctx.save_for_backward(half)
        return torch.dot(cells.flatten(), half.flatten())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None]:
        (half,) = ctx.saved_tensors
        return 2 * upstream[0] * half, None


class _Power(torch.autograd.Function):
    """Factors, at least `_DARKEST`, to the power of exponents; one logarithm serves both ways."""

    @staticmethod
    def forward(
        ctx: Any, factors: Float[Tensor, "T H W"], exponents: Float[Tensor, "H W"]
    ) -> Float[Tensor, "T H W"]:
        logs = factors.clamp_min(_DARKEST).log_()
        result = (logs * exponents).exp_()
        ctx.save_for_backward(factors, exponents, logs, result)
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, Tensor]:
        factors, exponents, logs, result = ctx.saved_tensors
        slope = upstream[0] * result
        by_factors = (slope * exponents).div_(factors)
        by_factors = torch.ops.aten.threshold_backward(by_factors, factors, _DARKEST)
        return by_factors, slope.mul_(logs).sum(0)
