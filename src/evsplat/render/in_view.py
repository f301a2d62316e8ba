"""Which Gaussians a picture may show, before anything else is known of them."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from evsplat.compiled import native, runs_native
from evsplat.render.splats import PinholeCamera


def rows_in_view(
    means: Float[Tensor, "N 3"], scales: Float[Tensor, "N 3"], camera: PinholeCamera
) -> Int[Tensor, " V"] | None:
    """Rows that may reach into the picture, whatever their rotation and opacity; None for all.

    Where the compiled module does not run it is None as well: a GPU would have to be waited for.
    No row is left out that `render` draws (with its default ``near``).
    """
    if not (runs_native(means) and runs_native(scales)):
        return None
    rows = torch.empty(len(means), dtype=torch.int64)
    count = native.rows_in_view(
        means.detach().contiguous(),
        scales.detach().contiguous(),
        camera.K.detach().float().contiguous(),
        camera.world_to_camera.detach().float().contiguous(),
        camera.width,
        camera.height,
        rows,
    )
    return None if count == len(means) else rows[:count]
