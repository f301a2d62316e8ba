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
from jaxtyping import Bool, Float, Int
from torch import Tensor

from evsplat.cuda_support import what_is_missing
from evsplat.devices import send
from evsplat.errors import BackendError
from evsplat.render.job import RenderJob
from evsplat.render.reference import MAX_PIXEL
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
    moving = _project(gsplat, job.splats, job)
    static = None if job.static is None else _project(gsplat, job.static, job)
    if moving.count + (0 if static is None else static.count) == 0:
        image = channels.new_zeros(job.times, height, width, channels.shape[-1])
        alpha = image[..., 0]
    else:
        image, alpha = _composite(gsplat, moving.at_times(job.times), static, width, height)
    if job.background is not None:
        image = image + (1 - alpha)[..., None] * job.background
    drawn = moving.radii.amax(-1).expand(job.times, -1)
    still = drawn.new_zeros(1, 0) if static is None else static.radii.amax(-1)
    return RenderOutput(image, alpha, drawn, still)


@dataclass(frozen=True)
class _Projected:
    """Gaussians on the screen; where radii are zero the other values mean nothing."""

    centers: Float[Tensor, "T N 2"]
    conics: Float[Tensor, "T N 3"]
    depths: Float[Tensor, "T N"]
    radii: Int[Tensor, "T N 2"]
    opacities: Float[Tensor, "T N"]
    channels: Float[Tensor, "T N C"]

    @property
    def count(self) -> int:
        """Gaussians per time."""
        return self.radii.shape[1]

    def at_times(self, times: int) -> "_Projected":
        """At every time, without copies."""
        values = (getattr(self, f.name) for f in fields(self))
        return _Projected(*(value.expand(times, *value.shape[1:]) for value in values))


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

    broken = ~sound

    def usable(value: Tensor) -> Tensor:
        inner = value.shape[1:]
        mask = broken.view(*broken.shape, *(1,) * (len(inner) - 1))
        return value.masked_fill(mask, 0.0).expand(times, *inner).contiguous()

    means, opacities = usable(splats.means), usable(splats.opacities)
    quaternions, scales = usable(splats.quaternions), usable(splats.scales)
    covariances = None
    if splats.linear is not None:
        shape = usable(splats.linear) @ _rotations(quaternions) * scales[..., None, :]
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


def _rotations(quaternions: Float[Tensor, "*N 4"]) -> Float[Tensor, "*N 3 3"]:
    """Rotations of quaternions wxyz, as sums over the products of their parts: few operations."""
    products = (quaternions[..., :, None] * quaternions[..., None, :]).flatten(-2)
    sums = products @ send(_OF_PRODUCTS, products.device)
    squares = quaternions.square().sum(-1, keepdim=True)
    return (sums / squares).unflatten(-1, (3, 3))


def _of_products() -> Float[Tensor, "16 9"]:
    """How the entries of a rotation are made of ww, wx, ... zz."""
    w, x, y, z = range(4)
    terms = {
        0: ((w, w, 1), (x, x, 1), (y, y, -1), (z, z, -1)),
        1: ((x, y, 2), (w, z, -2)),
        2: ((x, z, 2), (w, y, 2)),
        3: ((x, y, 2), (w, z, 2)),
        4: ((w, w, 1), (x, x, -1), (y, y, 1), (z, z, -1)),
        5: ((y, z, 2), (w, x, -2)),
        6: ((x, z, 2), (w, y, -2)),
        7: ((y, z, 2), (w, x, 2)),
        8: ((w, w, 1), (x, x, -1), (y, y, -1), (z, z, 1)),
    }
    found = torch.zeros(4, 4, 9)
    for entry, parts in terms.items():
        for i, j, factor in parts:
            found[i, j, entry] = factor
    return found.flatten(0, 1)


_OF_PRODUCTS = _of_products()


def _upper(matrices: Float[Tensor, "*N 3 3"]) -> Float[Tensor, "*N 6"]:
    """Rows of the upper triangle, as gsplat takes symmetric matrices."""
    xx, xy, xz, _, yy, yz, _, _, zz = matrices.flatten(-2).unbind(-1)
    return torch.stack([xx, xy, xz, yy, yz, zz], -1)


def _composite(
    gsplat: Any, moving: _Projected, static: _Projected | None, width: int, height: int
) -> tuple[Float[Tensor, "T H W C"], Float[Tensor, "T H W"]]:
    """Image and alpha. Binning reads the number of pairs back: the host waits here, once.

    Static Gaussians are rows of their own that all times refer to. Of several times they are
    composited once, in a picture before the others, and once more only in the tiles around what
    moves at a time.
    """
    times, across, down = len(moving.radii), -(-width // _TILE), -(-height // _TILE)
    binned = [moving.centers.detach(), moving.radii, moving.depths.detach()]
    near = None
    if static is not None:
        still = [static.centers.detach(), static.radii, static.depths.detach()]
        if times > 1:
            near, kept = _near(moving, static, across, down)
            binned = [torch.cat([value[:1], value]) for value in binned]
            binned[1] = torch.cat([torch.zeros_like(binned[1][:1]), binned[1][1:]])
            kept = torch.cat([torch.ones_like(kept[:1]), kept])
            still[1] = still[1] * kept[..., None]
        binned = [
            torch.cat([a, b.expand(len(a), *b.shape[1:])], 1)
            for a, b in zip(binned, still, strict=True)
        ]
    pictures, count = binned[1].shape[:2]
    _, pairs, order = gsplat.isect_tiles(*binned, _TILE, across, down)
    offsets = gsplat.isect_offset_encode(pairs, pictures, across, down)
    rows = [
        torch.cat([getattr(layer, name).flatten(0, 1) for layer in (moving, static) if layer])
        for name in ("centers", "conics", "channels", "opacities")
    ]
    if static is not None:
        # From rows per picture to those of all moving Gaussians and then the static ones.
        picture, row = order // count, order % count
        own = row + (picture - (pictures - times)) * moving.count
        order = torch.where(row < moving.count, own, row + (times - 1) * moving.count)
    masks = None if near is None else torch.cat([torch.ones_like(near[:1]), near])
    drawn = [
        gsplat.rasterize_to_pixels(
            rows[0],
            rows[1],
            channels,
            rows[3],
            width,
            height,
            _TILE,
            offsets,
            order,
            masks=masks,
            packed=True,
        )
        for channels in rows[2].split(_CHANNELS_AT_ONCE, -1)
    ]
    image = torch.cat([part for part, _ in drawn], -1) if len(drawn) > 1 else drawn[0][0]
    alpha = drawn[0][1]
    if near is not None:
        pixels = near[:, :, None, :, None].expand(-1, -1, _TILE, -1, _TILE)
        shown = pixels.reshape(times, down * _TILE, across * _TILE, 1)[:, :height, :width]
        image, alpha = (torch.where(shown, value[1:], value[:1]) for value in (image, alpha))
    return image, alpha.squeeze(-1)


@torch.no_grad()
def _near(
    moving: _Projected, static: _Projected, across: int, down: int
) -> tuple[Bool[Tensor, "T down across"], Bool[Tensor, "T S"]]:
    """Tiles in the box around all that moves at a time, and the static Gaussians that reach it."""
    if moving.count == 0:
        nowhere = torch.zeros(len(moving.radii), 1, 1, dtype=torch.bool, device=moving.radii.device)
        return nowhere.expand(-1, down, across), nowhere[..., 0].expand(-1, static.count)
    drawn = (moving.radii > 0).all(-1, keepdim=True)
    low = (moving.centers - moving.radii).masked_fill(~drawn, torch.inf).amin(1)
    high = (moving.centers + moving.radii).masked_fill(~drawn, -torch.inf).amax(1)
    # A little more than gsplat's own tiles: roundings must not decide.
    low, high = ((low - 0.5) / _TILE).floor(), ((high + 0.5) / _TILE).ceil()
    inside = [
        (tile >= low[:, axis, None]) & (tile < high[:, axis, None])
        for axis, tile in enumerate(
            torch.arange(count, device=low.device) for count in (across, down)
        )
    ]
    reach = static.radii + 1
    touches = (static.centers + reach > _TILE * low[:, None]) & (
        static.centers - reach < _TILE * high[:, None]
    )
    return inside[1][:, :, None] & inside[0][:, None, :], touches.all(-1)
