"""The rasteriser in plain torch, any dtype and device: slow, the oracle of the tests."""

import math
from dataclasses import fields

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.camera import Camera
from evsplat.render.job import RenderJob
from evsplat.render.splats import LOW_PASS, RenderOutput, Splats, join

# The rules of gsplat 1.5.3 (cuda/csrc/ProjectionEWA3DGSFused.cu, RasterizeToPixels3DGSFwd.cu).
MIN_ALPHA = 1 / 255
MAX_ALPHA = 0.999
MIN_TRANSMITTANCE = 1e-4
MAX_EXTENT = 3.33
FOV_MARGIN = 0.3
MAX_PIXEL = 1e6  # farther from the image, or larger, is not drawn

_TILE = 32
_PAIRS_PER_CHUNK = 1 << 19


def render(job: RenderJob) -> RenderOutput:
    """Draw tile by tile, all pairs of a tile's pixels and Gaussians at once."""
    splats = job.splats if job.static is None else join(job.splats, job.static, job.times)
    values = [getattr(splats, f.name) for f in fields(Splats)]
    drawn = [
        _draw([None if v is None else v[t if len(v) > 1 else 0] for v in values], job)
        for t in range(job.times)
    ]
    images, alphas, radii = zip(*drawn, strict=True)
    image, alpha, all_radii = torch.stack(images), torch.stack(alphas), torch.stack(radii)
    if job.background is not None:
        image = image + (1 - alpha)[..., None] * job.background
    count = job.splats.means.shape[1]
    return RenderOutput(image, alpha, all_radii[:, :count], all_radii[:1, count:])


def _draw(values: list[Tensor | None], job: RenderJob) -> tuple[Tensor, Tensor, Tensor]:
    """Image, alpha and radii of one time, without background."""
    camera = job.camera
    means, quaternions, scales, opacities, channels, linear, offset = values
    assert means is not None and quaternions is not None and scales is not None
    assert opacities is not None and channels is not None
    centers, covariance, depth = project(means, quaternions, scales, linear, camera, job.low_pass)
    if offset is not None:
        centers = centers + offset
    reach, visible = _extents(centers, covariance, depth, opacities, camera, job.near)

    # Stable: equal depths keep the order of the Gaussians.
    order = torch.argsort(torch.where(visible, depth, math.inf).detach(), stable=True)
    order = order[: int(visible.sum())]
    near_to_far = centers[order], covariance[order], opacities[order], channels[order]
    low, high = (centers - reach).detach()[order] - 1, (centers + reach).detach()[order] + 1

    rows = []
    for top in range(0, camera.height, _TILE):
        bottom = min(top + _TILE, camera.height)
        tiles = []
        for left in range(0, camera.width, _TILE):
            right = min(left + _TILE, camera.width)
            touch = (low[:, 0] < right) & (high[:, 0] > left)
            touch &= (low[:, 1] < bottom) & (high[:, 1] > top)
            y, x = torch.meshgrid(
                torch.arange(top, bottom).to(means) + 0.5,
                torch.arange(left, right).to(means) + 0.5,
                indexing="ij",
            )
            pixels = torch.stack([x, y], -1).view(-1, 2)
            some = [part[touch] for part in near_to_far]
            step = max(1, _PAIRS_PER_CHUNK // max(1, len(some[0])))
            tile = torch.cat([_composite(chunk, *some) for chunk in pixels.split(step)])
            tiles.append(tile.view(bottom - top, right - left, -1))
        rows.append(torch.cat(tiles, 1))
    image = torch.cat(rows)
    radii = torch.where(visible[:, None], reach, 0).amax(-1).to(torch.int32)
    return image[..., :-1], image[..., -1], radii


def project(
    means: Float[Tensor, "N 3"],
    quaternions: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    linear: Float[Tensor, "N 3 3"] | None,
    camera: Camera,
    low_pass: float = LOW_PASS,
) -> tuple[Float[Tensor, "N 2"], Float[Tensor, "N 2 2"], Float[Tensor, "N"]]:
    """EWA splatting: centres in px, covariances in px^2 with the low-pass, depths in metres."""
    view = camera.world_to_camera.to(means)
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    local = means @ view[:3, :3].T + view[:3, 3]
    x, y, z = local.unbind(-1)
    # A depth of zero must not make NaN, which would spread through the gradients of the rest.
    z = torch.where(z == 0, torch.ones_like(z), z)
    x, y = x / z, y / z
    centers = torch.stack([fx * x + cx, fy * y + cy], -1)

    # The Jacobian is taken inside the field of view, enlarged by 30 % of its half width.
    margin_x = FOV_MARGIN * 0.5 * camera.width / fx
    margin_y = FOV_MARGIN * 0.5 * camera.height / fy
    x = x.clamp(-cx / fx - margin_x, (camera.width - cx) / fx + margin_x)
    y = y.clamp(-cy / fy - margin_y, (camera.height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([fx / z, zero, -fx * x / z, zero, fy / z, -fy * y / z], -1)
    factor = jacobian.view(-1, 2, 3) @ view[:3, :3]
    if linear is not None:
        factor = factor @ linear
    factor = factor @ rotation_matrices(quaternions) * scales[:, None, :]
    blur = low_pass * torch.eye(2, dtype=means.dtype, device=means.device)
    return centers, factor @ factor.mT + blur, local[:, 2]


def rotation_matrices(quaternions: Float[Tensor, "*N 4"]) -> Float[Tensor, "*N 3 3"]:
    """Rotations of quaternions wxyz of any length but zero."""
    w, x, y, z = (quaternions / quaternions.norm(dim=-1, keepdim=True)).unbind(-1)
    return torch.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ],
        -1,
    ).unflatten(-1, (3, 3))  # fmt: skip


@torch.no_grad()
def _extents(
    centers: Tensor,
    covariance: Tensor,
    depth: Tensor,
    opacities: Tensor,
    camera: Camera,
    near: float,
) -> tuple[Tensor, Tensor]:
    """Reach of each Gaussian in x and y, whole pixels, and which Gaussians are drawn."""
    # Up to 3.33 deviations, or to where alpha falls under 1/255. For opacities up to 1 that is the
    # nearer one, so that compositing needs no cut but the one at 1/255.
    extent = (2 * torch.log(opacities / MIN_ALPHA)).clamp(min=0).sqrt().clamp(max=MAX_EXTENT)
    reach = (extent[:, None] * covariance.diagonal(dim1=-2, dim2=-1).sqrt()).ceil()
    size = torch.tensor([camera.width, camera.height], dtype=centers.dtype, device=centers.device)
    on_screen = (centers + reach > 0) & (centers - reach < size)
    # As NaN fails every comparison, it is not drawn.
    visible = (
        (depth >= near)
        & (opacities >= MIN_ALPHA)
        & (covariance.det() > 0)
        & on_screen.all(-1)
        & (reach < MAX_PIXEL).all(-1)
        & (centers.abs() < MAX_PIXEL).all(-1)
    )
    return reach, visible


def _composite(
    pixels: Tensor, centers: Tensor, covariance: Tensor, opacities: Tensor, channels: Tensor
) -> Float[Tensor, "P C+1"]:
    """Channels and, last, alpha at the pixels; the Gaussians come sorted by depth."""
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    determinant = a * c - b * b
    dx, dy = (pixels[:, None] - centers).unbind(-1)
    distance = (c * dx * dx - 2 * b * dx * dy + a * dy * dy) / determinant
    alpha = opacities * torch.exp(-0.5 * distance)
    alpha = torch.where(alpha >= MIN_ALPHA, alpha.clamp(max=MAX_ALPHA), 0)
    # The Gaussian that would make the pixel opaque is left out, and all behind it.
    after = torch.cumprod(1 - alpha, -1)
    alpha = torch.where(after > MIN_TRANSMITTANCE, alpha, 0)
    after = torch.cumprod(1 - alpha, -1)
    before = torch.cat([torch.ones_like(pixels[:, :1]), after[:, :-1]], -1)
    weights = alpha * before
    # The sum of the weights is 1 - final transmittance.
    return torch.cat([weights @ channels, weights.sum(-1, keepdim=True)], -1)
