"""The CUDA backend: the kernels of gsplat 1.5, float32, any number of times and channels.

gsplat sums gradients with atomic additions: two runs agree up to rounding, not bit for bit.
"""

import functools
import logging
import os
import shutil
from dataclasses import dataclass, fields
from importlib import import_module
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from evsplat.cuda_support import what_is_missing
from evsplat.devices import send
from evsplat.errors import BackendError
from evsplat.render.job import RenderJob
from evsplat.render.reference import MAX_PIXEL, rotation_matrices
from evsplat.render.splats import RenderOutput, Splats

logger = logging.getLogger(__name__)

_TILE = 16
_CHANNELS_AT_ONCE = 32
"""gsplat's kernels keep a pixel's channels in registers; beyond this they spill."""


def render(job: RenderJob) -> RenderOutput:
    """Draw with gsplat.

    A ``centers2d_offset`` moves what is drawn, but whether a Gaussian is on the screen is decided
    where its centre lies without it.
    """
    means = job.splats.means
    if means.dtype != torch.float32 or means.device.type != "cuda":
        raise BackendError(
            f"The gsplat render backend needs float32 tensors on a CUDA device, not {means.dtype} "
            f"on {means.device}."
        )
    return draw(load(), job)


@functools.cache
def load() -> Any:
    """The package gsplat with its kernels, built if need be; a `BackendError` says what lacks."""
    missing = what_is_missing()
    if missing is not None:
        raise BackendError(f"The gsplat render backend cannot run here. {missing}")
    if shutil.which("ninja") is None:
        # An interpreter that is called by its path does not have its own scripts on PATH.
        os.environ["PATH"] += os.pathsep + import_module("ninja").BIN_DIR
    logger.info("Loading gsplat's kernels; the first time they are built, which takes minutes.")
    try:
        built = import_module("gsplat.cuda._backend")._C
    except Exception as error:  # the compiler's and the loader's, of many kinds
        raise BackendError(f"gsplat's kernels could not be built or loaded: {error}") from error
    if built is None:
        raise BackendError("gsplat found no CUDA toolkit to build its kernels with; set CUDA_HOME.")
    return import_module("gsplat")


def draw(gsplat: Any, job: RenderJob) -> RenderOutput:
    """Project each layer, bin all Gaussians of all times into tiles at once, and composite."""
    width, height, channels = job.camera.width, job.camera.height, job.splats.channels
    layers = [
        _project(gsplat, layer, job) for layer in (job.splats, job.static) if layer is not None
    ]
    if sum(layer.radii.shape[1] for layer in layers) == 0:
        image = channels.new_zeros(job.times, height, width, channels.shape[-1])
        alpha = image[..., 0]
    else:
        image, alpha = _composite(gsplat, _join(layers, job.times), width, height)
    if job.background is not None:
        image = image + (1 - alpha)[..., None] * job.background
    drawn = [layer.radii.amax(-1) for layer in layers]
    static = drawn[1] if len(drawn) > 1 else drawn[0].new_zeros(1, 0)
    return RenderOutput(image, alpha, drawn[0].expand(job.times, -1), static)


@dataclass(frozen=True)
class _Projected:
    """Gaussians on the screen; where radii are zero the other values mean nothing."""

    centers: Float[Tensor, "T N 2"]
    conics: Float[Tensor, "T N 3"]
    depths: Float[Tensor, "T N"]
    radii: Int[Tensor, "T N 2"]
    opacities: Float[Tensor, "T N"]
    channels: Float[Tensor, "T N C"]


def _project(gsplat: Any, splats: Splats, job: RenderJob) -> _Projected:
    """A layer on the screen, once for all times where nothing of its geometry moves."""
    camera = job.camera
    geometry = [
        getattr(splats, f.name)
        for f in fields(splats)
        if f.name != "channels" and getattr(splats, f.name) is not None
    ]
    times, count = max(map(len, geometry)), splats.means.shape[1]
    device = splats.means.device
    if count == 0:
        centers, conics, depths = (splats.means.new_zeros(1, 0, *n) for n in ((2,), (3,), ()))
        radii = torch.zeros(1, 0, 2, dtype=torch.int32, device=device)
        return _Projected(centers, conics, depths, radii, splats.opacities, splats.channels)

    # A value that is no number must not be drawn, nor spoil the gradients of the rest.
    sums = [value.flatten(2).sum(-1) if value.ndim > 2 else value for value in geometry]
    sound = functools.reduce(torch.add, sums).isfinite()

    def usable(value: Tensor) -> Tensor:
        inner = value.shape[1:]
        mask = sound.view(*sound.shape, *(1,) * (len(inner) - 1))
        return torch.where(mask, value, 0.0).expand(times, *inner).contiguous()

    means, opacities = usable(splats.means), usable(splats.opacities)
    quaternions, scales = usable(splats.quaternions), usable(splats.scales)
    covariances = None
    if splats.linear is not None:
        shape = usable(splats.linear) @ rotation_matrices(quaternions) * scales[..., None, :]
        covariances = _upper(shape @ shape.mT)
    view = send(camera.world_to_camera, device).to(means.dtype)
    K = send(camera.K.detach().float(), device)
    radii, centers, depths, conics, _ = gsplat.fully_fused_projection(
        means,
        covariances,
        quaternions if covariances is None else None,
        scales if covariances is None else None,
        view.expand(times, 1, 4, 4),
        K.expand(times, 1, 3, 3),
        camera.width,
        camera.height,
        eps2d=job.low_pass,
        near_plane=job.near,
        opacities=opacities.detach(),
    )
    radii, centers, depths, conics = (
        value.squeeze(1) for value in (radii, centers, depths, conics)
    )
    far_off = (radii >= MAX_PIXEL).any(-1) | (centers.detach().abs() >= MAX_PIXEL).any(-1)
    radii = radii.masked_fill(far_off[..., None], 0)
    if splats.centers2d_offset is not None:
        centers = centers + splats.centers2d_offset
    return _Projected(centers, conics, depths, radii, opacities, splats.channels)


def _upper(matrices: Float[Tensor, "*N 3 3"]) -> Float[Tensor, "*N 6"]:
    """Rows of the upper triangle, as gsplat takes symmetric matrices."""
    xx, xy, xz, _, yy, yz, _, _, zz = matrices.flatten(-2).unbind(-1)
    return torch.stack([xx, xy, xz, yy, yz, zz], -1)


def _join(layers: list[_Projected], times: int) -> _Projected:
    """All layers in one, at every time."""

    def all_times(value: Tensor) -> Tensor:
        return value.expand(times, *value.shape[1:])

    return _Projected(
        *(
            torch.cat([all_times(getattr(layer, f.name)) for layer in layers], 1)
            for f in fields(_Projected)
        )
    )


def _composite(
    gsplat: Any, all_of: _Projected, width: int, height: int
) -> tuple[Float[Tensor, "T H W C"], Float[Tensor, "T H W"]]:
    """Image and alpha. Binning reads the number of pairs back: the host waits here, once."""
    across, down = -(-width // _TILE), -(-height // _TILE)
    _, pairs, order = gsplat.isect_tiles(
        all_of.centers.detach(), all_of.radii, all_of.depths.detach(), _TILE, across, down
    )
    offsets = gsplat.isect_offset_encode(pairs, len(all_of.radii), across, down)
    drawn = [
        gsplat.rasterize_to_pixels(
            all_of.centers,
            all_of.conics,
            channels,
            all_of.opacities,
            width,
            height,
            _TILE,
            offsets,
            order,
        )
        for channels in all_of.channels.split(_CHANNELS_AT_ONCE, -1)
    ]
    return torch.cat([image for image, _ in drawn], -1), drawn[0][1].squeeze(-1)
