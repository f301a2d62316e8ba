"""Gaps in a scene: what shows from beside between Gaussians of a surface that is looked along."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

_CELLS, _SAMPLES = 96, 4
"""Cells in the shorter side of a picture, which are wider than most gaps; of how many pixels in a
row of one at least its mean is made."""
_LETS_THROUGH = 0.15
"""Share of the light from behind up to which it is no gap: the scene is trained before black, and
its colours make up for that."""
_SOLID = (0.5, 0.8)
"""Mean opacity about a place from which on it begins to be part of a surface, and is."""


def close_gaps(
    rgb: Float[Tensor, "T H W 3"], alpha: Float[Tensor, "T H W"], human: Float[Tensor, "T H W"]
) -> tuple[Float[Tensor, "T H W 3"], Float[Tensor, "T H W"]]:
    """Pictures on black and their opacity, without gaps where the scene is solid about them.

    There nothing behind shows, and gaps have the scene's mean colour about them. ``human``: the
    person's share of each pixel, of whose colours nothing goes there.
    """
    height, width = alpha.shape[1:]
    side = max(1, round(min(height, width) / _CELLS))
    step = max(1, side // _SAMPLES)
    few = slice(None, None, step)
    scene = (1 - human[:, few, few])[..., None]
    own = torch.cat([rgb[:, few, few], alpha[:, few, few, None], torch.ones_like(scene)], -1)
    cells = avg_pool2d(
        (own * scene).movedim(-1, 1), side // step, ceil_mode=True, count_include_pad=False
    )
    sums = avg_pool2d(cells, 3, stride=1, padding=1, count_include_pad=False)
    colour, covered, share = sums.split((3, 1, 1), 1)
    least, most = _SOLID
    solid = ((covered / share.clamp_min(1e-3) - least) / (most - least)).clamp(0, 1)
    around = torch.cat([colour / covered.clamp_min(1e-3), solid], 1)
    around = interpolate(around, (height, width), mode="bilinear").movedim(1, -1)
    through = 1 - alpha
    solid = around[..., 3]
    gap = solid * (through - _LETS_THROUGH).clamp_min(0) / (1 - _LETS_THROUGH)
    closed = torch.addcmul(rgb, gap[..., None], around[..., :3]).clamp(0, 1)
    return closed, torch.addcmul(alpha, through, solid).clamp(0, 1)
