"""Gaussians in pictures whose pixels are finer than those that training saw them by."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.camera import Camera
from evsplat.models.layers import Layers
from evsplat.render import Splats


def smoothed(layers: Layers, camera: Camera, recorders: Sequence[Camera]) -> Layers:
    """Person and scene as `widened` for pictures of ``camera``."""
    human, scene = (
        widened(layer, layers.low_pass, camera, recorders) for layer in (layers.human, layers.scene)
    )
    return replace(layers, human=human, scene=scene)


def widened(layer: Splats, low_pass: float, camera: Camera, recorders: Sequence[Camera]) -> Splats:
    """Gaussians as wide as training saw them, however fine the pixels of ``camera`` are.

    A pixel adds its ``low_pass`` (px^2) to what it shows, and training learns Gaussians the thinner
    for it; a finer one adds less, and shows what is behind between them. With pixels as large as p
    (metres at the Gaussian: z / f) to the nearest of ``recorders`` and p' to ``camera``, ``low_pass
    (p^2 - p'^2)`` is added to the Gaussian's variances where that is above 0: the 3D smoothing of
    Mip-Splatting (Yu et al., CVPR 2024), less what a pixel adds itself. So pictures of a
    recorder at its own size stay as they are, bit for bit.
    """
    finer = _recorded_pixels(layer.means, recorders) ** 2 - _pixels(layer.means, camera) ** 2
    added = low_pass * finer.clamp_min_(0)[..., None]
    scales = (layer.scales.square() + added).sqrt_()
    return replace(layer, scales=torch.where(added > 0, scales, layer.scales))


def _pixels(points: Float[Tensor, "*T N 3"], camera: Camera) -> Float[Tensor, "*T N"]:
    """Size of a camera's pixels at each point, metres; 0 behind it."""
    return (camera.depth(points) / camera.K.diagonal()[:2].prod().sqrt()).clamp_min_(0)


def _recorded_pixels(
    points: Float[Tensor, "*T N 3"], recorders: Sequence[Camera]
) -> Float[Tensor, "*T N"]:
    """The finest of recorders that show a point; else of those that it is before, or 0."""
    if len(recorders) == 1:
        return _pixels(points, recorders[0])
    finest = finest_before = torch.full_like(points[..., 0], torch.inf)
    for recorder in recorders:
        size, inside = _pixels(points, recorder), recorder.pixels(points)[3]
        finest = torch.where(inside, torch.minimum(finest, size), finest)
        finest_before = torch.where(size > 0, torch.minimum(finest_before, size), finest_before)
    found = torch.where(finest.isfinite(), finest, finest_before)
    return torch.where(found.isfinite(), found, 0.0)
