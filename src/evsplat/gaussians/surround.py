"""What goes on beyond the borders of a recorded picture: its rim, softer the farther out.

A camera a little beside the recording one sees past what was recorded. There the floor and the wall
of the backdrop go on, in colours of the nearest part of the rim.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from evsplat.camera import Camera
from evsplat.gaussians.initialise import gaussians_at, pixel_rays

CELLS = 32
"""Along the shorter side of the picture; there is one Gaussian per cell around it."""
_WIDTH = 0.75
"""Standard deviation of a Gaussian in cells: what is behind does not shine through."""
_BEHIND = 1.01
"""Depth as a share of the sheet's, which hides the tails that reach into the picture."""
_OPACITY, _FADES = 0.97, 0.25
"""Opacity, and the outer share of the surround in which it falls to 0."""
_NEARNESS = 3.0
"""Power of the distance by which cells of the rim count less."""


def margins(camera: Camera) -> tuple[int, int]:
    """Pixels beyond the left and right, and beyond the upper and lower border: half a picture."""
    cell = cell_px(camera.width, camera.height)
    return -(-camera.width // (2 * cell)) * cell, -(-camera.height // (2 * cell)) * cell


def surround(
    camera: Camera,
    background_srgb: Float[Tensor, "H W 3"],
    depth: Float[Tensor, "H2 W2"],
    semantic_logit: float,
    feature_dim: int | None,
) -> dict[str, Tensor]:
    """Start values of Gaussians around the recorded picture, see `gaussians_at`.

    ``camera`` is the recording one widened by `margins`, and ``depth`` its backdrop's, metres;
    ``background_srgb`` is the recorded picture in its middle, without the person.
    """
    height, width = background_srgb.shape[:2]
    cell = cell_px(width, height)
    size, inner = torch.tensor([camera.width, camera.height]), torch.tensor([width, height])
    beyond = (size - inner) // 2
    middles = torch.cartesian_prod(*(torch.arange(count) for count in (size // cell).tolist()))
    middles = (middles + 0.5) * cell
    out = (((middles - size / 2).abs() - inner / 2) / beyond).amax(-1)
    middles, out = middles[out > 0], out[out > 0]

    x, y = middles.long().unbind(-1)
    z = _BEHIND * depth[y, x]
    values = gaussians_at(
        camera.center() + z[:, None] * pixel_rays(camera)[y, x],
        (_WIDTH * cell * z / camera.K[0, 0])[:, None].repeat(1, 3),
        opacity=_OPACITY,
        semantic_logit=semantic_logit,
        rgb_srgb=continued(background_srgb, middles - beyond, cell),
        feature_dim=feature_dim,
    )
    opacities = _OPACITY * ((1 - out) / _FADES).clamp(0.01, 1)
    return values | {"opacity_logits": opacities.logit()}


def continued(
    picture: Float[Tensor, "H W 3"], places: Float[Tensor, "N 2"], cell: int
) -> Float[Tensor, "N 3"]:
    """Colours at ``places`` (x, y) outside of a picture: means of its rim, the near part first.

    ``cell``: see `cell_px`.
    """
    pooled = avg_pool2d(
        picture.permute(2, 0, 1)[None], cell, ceil_mode=True, count_include_pad=False
    )[0].permute(1, 2, 0)
    rim = torch.ones(pooled.shape[:2], dtype=torch.bool)
    rim[1:-1, 1:-1] = False
    # The last cell of a row or column may be cut by the border: its middle lies in the picture, and
    # never at a place outside.
    size = torch.tensor([picture.shape[1], picture.shape[0]])
    first = rim.nonzero().flip(-1) * cell
    middles = (first + torch.minimum(first + cell, size)) / 2
    weights = torch.cdist(places, middles).pow(-_NEARNESS)
    return weights / weights.sum(-1, keepdim=True) @ pooled[rim]


def cell_px(width: int, height: int) -> int:
    """Side of a cell of the surround, pixels."""
    return max(1, min(width, height) // CELLS)
