"""Which Gaussian of the scene covers which before a camera that stands still: decided once.

Such a camera sees no depth. Next to nothing pulls a Gaussian along its ray, and Adam, which divides
gradients by their size, makes steps of full length of it. Those of a wall that faces the camera
have one depth, so that each step drew lots for which of them covers which.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import torch

from evsplat.camera import Camera
from evsplat.gaussians.gaussian_set import Rows

SPREAD = 1e-3
"""Largest change of a depth that sets Gaussians apart, as a share of it: far above what a step's
rounding changes, and millimetres in a room."""
_GOLDEN = (5**0.5 - 1) / 2


def set_apart(rows: Rows, camera: Camera) -> None:
    """Move the scene along the rays of ``camera`` by up to `SPREAD`, each Gaussian by its share.

    Shares follow the golden ratio: rows that follow each other get others, and so do those some
    lines of pixels away.
    """
    with torch.no_grad():
        means = rows.means[rows.scene]
        even = torch.arange(len(means), dtype=torch.float64) * _GOLDEN % 1
        share = (1 + SPREAD * (2 * even - 1)).to(means)
        torch.lerp(camera.center(), means, share[:, None], out=means)


@contextmanager
def depths_kept(sets: Iterable[Rows], camera: Camera | None) -> Iterator[None]:
    """What happens inside moves the scene across the picture of ``camera``, and not along its rays.

    The number of rows must not change. Without a camera everything moves as it does.
    """
    if camera is None:
        yield
        return
    center, axis, offset = (
        camera.center(),
        camera.world_to_camera[2, :3],
        camera.world_to_camera[2, 3],
    )
    with torch.no_grad():
        scenes = [rows.means[rows.scene] for rows in sets if rows.holds("scene")]
        before = [torch.addmv(offset, means, axis) for means in scenes]
        yield
        for means, depth in zip(scenes, before, strict=True):
            share = depth / torch.addmv(offset, means, axis)
            torch.lerp(center, means, share[:, None], out=means)
