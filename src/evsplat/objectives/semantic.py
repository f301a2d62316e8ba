"""Teaches the semantic attribute where the person is, without any mask (A8)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from evsplat.capture import Frame
from evsplat.compiled import native, runs_native
from evsplat.devices import DeviceCache, constant
from evsplat.models.discs import DiscModel
from evsplat.models.paper import PaperModel
from evsplat.objectives.base import Objective, Step

LEAST_SHARE = 1e-4
"""A share of the person is held so far from 0 and 1, where the logarithm has no end."""


def silhouette_bounds(
    silhouette: Bool[np.ndarray, "H W"], band_px: int
) -> tuple[Bool[Tensor, "H W"], Bool[Tensor, "H W"]]:
    """Pixels that surely are the person, and pixels that surely are the scene.

    Inside the posed bare body it is the person; farther than ``band_px`` from it the scene; between
    lie clothes and hair, about which nothing is said.
    """
    if not silhouette.any():
        return torch.from_numpy(silhouette.copy()), torch.from_numpy(~silhouette)
    outside = distance_transform_edt(~silhouette) > band_px
    return torch.from_numpy(silhouette.copy()), torch.from_numpy(outside)


@dataclass(frozen=True)
class PackedBounds:
    """`silhouette_bounds` at one bit a mask and pixel: training keeps those of every frame."""

    bits: np.ndarray
    """A row of bytes per mask, the first pixel in a byte's highest bit."""
    height: int
    width: int

    @classmethod
    def of(cls, silhouette: Bool[np.ndarray, "H W"], band_px: int) -> "PackedBounds":
        """Find and pack them."""
        masks = torch.stack(silhouette_bounds(silhouette, band_px)).numpy()
        return cls(np.packbits(masks.reshape(2, -1), axis=1), *silhouette.shape)

    def masks(self) -> Bool[Tensor, "2 H W"]:
        """Inside and outside, as `silhouette_bounds` gave them."""
        pixels = self.height * self.width
        masks = torch.from_numpy(np.unpackbits(self.bits, axis=1, count=pixels).view(bool))
        return masks.view(2, self.height, self.width)


def membership_loss(
    share: Float[Tensor, "H W"], masks: Bool[Tensor, "2 H W"] | PackedBounds
) -> Float[Tensor, ""]:
    """Cross-entropy, mean over pixels, of the share of the person against what a pixel surely is.

    Pixels between ``inside`` and ``outside`` count as right. Packed masks are for the compiled
    module, which takes float32 on the CPU.
    """
    if isinstance(masks, PackedBounds):
        packed: Tensor = _NativeMembership.apply(share, masks.bits)
        return packed
    loss: Tensor = _Membership.apply(share, masks)
    return loss


class _Membership(torch.autograd.Function):
    """`membership_loss` in plain torch; the gradient is found on the way forward."""

    @staticmethod
    def forward(
        ctx: Any, share: Float[Tensor, "H W"], masks: Bool[Tensor, "2 H W"]
    ) -> Float[Tensor, ""]:
        inside, outside = masks.to(share.dtype)
        held = share.clamp(LEAST_SHARE, 1 - LEAST_SHARE)
        # The probability of what the pixel surely is: p inside, 1 - p outside, 1 between.
        slope = inside - outside
        right = torch.addcmul(1 - inside, slope, held)
        slope = torch.ops.aten.hardtanh_backward(
            slope.div_(right), share, LEAST_SHARE, 1 - LEAST_SHARE
        )
        ctx.save_for_backward(slope)
        return right.log_().mean().neg_()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None]:
        (slope,) = ctx.saved_tensors
        return slope * (upstream[0] / -slope.numel()), None


class _NativeMembership(torch.autograd.Function):
    """`membership_loss` in the compiled module; the gradient is found on the way forward."""

    @staticmethod
    def forward(ctx: Any, share: Tensor, bits: np.ndarray) -> Tensor:
        given = share.detach().contiguous()
        slope = torch.empty_like(given) if ctx.needs_input_grad[0] else None
        total = native.membership(given, bits, LEAST_SHARE, slope, torch.get_num_threads())
        if slope is not None:
            ctx.save_for_backward(slope)
        return share.new_tensor(-total / share.numel())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None]:
        (slope,) = ctx.saved_tensors
        return slope * (upstream[0] / -slope.numel()), None


class RenderedSemantics(Objective):
    """Cross-entropy of the rendered attribute against the posed body's bounds (A2 iii, A8).

    It looks at the mid-exposures that other objectives render.
    """

    def __init__(
        self,
        bounds: Mapping[tuple[str, int], Callable[[], PackedBounds]],
    ) -> None:
        """``bounds`` of the posed body, by the training frames' camera and mid-exposure (us)."""
        self.bounds = bounds

    def prefetch(self, frame: Frame, nominal: float, data: DeviceCache) -> None:
        """The bounds at the frame's mid-exposure."""
        place = frame.camera, frame.mid_us
        if place in self.bounds:
            data.prefetch(("bounds", *place), lambda: self.bounds[place]().masks())

    def loss(self, step: Step[PaperModel | DiscModel]) -> dict[str, Tensor]:
        """``semantic`` and the pressure ``binarise`` = mean m (1 - m) (A2)."""
        values: list[Float[Tensor, ""]] = []
        for time, drawn in zip(step.times_us, step.semantic, strict=True):
            place = step.frame.camera, time
            if place not in self.bounds:
                continue
            packed, key = self.bounds[place](), ("bounds", *place)
            masks = packed if runs_native(drawn) else step.data.get(key, packed.masks)
            values.append(membership_loss(drawn, masks))
        soft = step.model.gaussians.semantics()
        half = constant((0.5,), soft).expand_as(soft)
        # m (1 - m), with a third of the operations.
        terms = {"binarise": 0.25 - F.mse_loss(soft, half)}
        if values:
            terms["semantic"] = values[0] if len(values) == 1 else torch.stack(values).mean()
        return terms
