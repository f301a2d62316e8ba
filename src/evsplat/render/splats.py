"""Inputs and outputs of rendering."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

Picture = TypeVar("Picture", bound=Tensor | None)
LOW_PASS = 0.3
"""Low-pass filter of 3DGS and most viewers, px^2: see `render`."""


@dataclass(frozen=True)
class Splats:
    """Gaussians drawn at T times. A leading T of 1, or none, serves all times."""

    means: Float[Tensor, "T N 3"]
    """Centres in the world, metres."""
    quaternions: Float[Tensor, "*T N 4"]
    """Rotations wxyz, of any length but zero."""
    scales: Float[Tensor, "*T N 3"]
    """Standard deviations along the rotated axes, metres."""
    opacities: Float[Tensor, "*T N"]
    """Opacities at the centres, in [0, 1]."""
    channels: Float[Tensor, "T N C"]
    """Composited values, any number of channels."""
    linear: Float[Tensor, "T N 3 3"] | None = None
    """L in covariance = (L R S)(L R S)^T: a skinning matrix with its shear. None: identity."""
    centers2d_offset: Float[Tensor, "T N 2"] | None = None
    """Added to the projected centres, pixels: its gradient is theirs. None: zero."""

    def with_times(self) -> "Splats":
        """Every field with a leading axis of times, of size 1 where it was left out."""
        per_gaussian = {"opacities": 0, "linear": 2}
        given = {f.name: getattr(self, f.name) for f in fields(self)}
        return Splats(
            **{
                name: value[None]
                if value is not None and value.ndim == 1 + per_gaussian.get(name, 1)
                else value
                for name, value in given.items()
            }
        )

    def of_time(self, index: int) -> "Splats":
        """The same at one of the T times alone."""
        return Splats(
            **{
                name: value if value is None or len(value) == 1 else value[index : index + 1]
                for name, value in vars(self.with_times()).items()
            }
        )


def join(first: Splats, second: Splats, times: int) -> Splats:
    """Both sets in one, at each of ``times`` times; both have their axis of times."""

    def both(a: Tensor, b: Tensor) -> Tensor:
        times_of_both = 1 if len(a) == len(b) == 1 else times
        wide = [value.expand(times_of_both, *value.shape[1:]) for value in (a, b)]
        return torch.cat(wide, dim=1)

    identity = torch.eye(3, dtype=first.means.dtype, device=first.means.device)
    parts = []
    for splats in (first, second):
        count = splats.means.shape[1]
        linear, offset = splats.linear, splats.centers2d_offset
        parts.append(
            (
                splats.means,
                splats.quaternions,
                splats.scales,
                splats.opacities,
                splats.channels,
                identity.expand(1, count, 3, 3) if linear is None else linear,
                splats.means.new_zeros(1, count, 2) if offset is None else offset,
            )
        )
    return Splats(*(both(a, b) for a, b in zip(*parts, strict=True)))


@dataclass(frozen=True)
class RenderOutput:
    """Images of T times."""

    image: Float[Tensor, "T H W C"]
    """Composited channels over the background."""
    alpha: Float[Tensor, "T H W"]
    """Coverage in [0, 1)."""
    radii: Int[Tensor, "T N"]
    """Radius on the screen in pixels, rounded up; 0 = not drawn."""
    static_radii: Int[Tensor, "1 S"]
    """The same of the static Gaussians."""
    groups: tuple[tuple[Float[Tensor, "H W c"], ...], ...] = ()
    """Per group of channels that was asked for its picture at each time, views of ``image``."""


def split_channels(
    images: Float[Tensor, "T H W C"], sizes: Sequence[int]
) -> tuple[tuple[Float[Tensor, "H W c"], ...], ...]:
    """Pictures of all times per group of channels, as views.

    Their gradients are put into one tensor in few operations, which a GPU counts.
    """
    return by_group(_SplitChannels.apply(images, tuple(sizes)), len(images))


def by_group(pictures: Sequence[Picture], times: int) -> tuple[tuple[Picture, ...], ...]:
    """Pictures of all times of the first group, all of the second, ... per group."""
    return tuple(tuple(pictures[k : k + times]) for k in range(0, len(pictures), times))


def pictures_of(
    images: Float[Tensor, "T H W C"], sizes: Sequence[int]
) -> tuple[Float[Tensor, "H W c"], ...]:
    """Views of all times of the first group of channels, of all of the second, ..."""
    return tuple(part[t] for part in images.split(tuple(sizes), -1) for t in range(len(images)))


class _SplitChannels(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, images: Tensor, sizes: tuple[int, ...]) -> tuple[Tensor, ...]:
        ctx.set_materialize_grads(False)
        ctx.shape, ctx.sizes = images.shape, sizes
        return pictures_of(images, sizes)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None) -> tuple[Tensor | None, None]:
        given = next((part for part in upstream if part is not None), None)
        if given is None:
            return None, None
        times, height, width, _ = ctx.shape
        gradients = [
            _stacked(group, given.new_zeros(height, width, size))
            for group, size in zip(by_group(upstream, times), ctx.sizes, strict=True)
        ]
        return torch.cat(gradients, -1), None


def _stacked(pictures: Sequence[Tensor | None], nothing: Tensor) -> Float[Tensor, "T H W c"]:
    return torch.stack([nothing if picture is None else picture for picture in pictures])
