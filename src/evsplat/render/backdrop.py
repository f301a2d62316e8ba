"""What static Gaussians look like to a camera that stands still, kept from render to render."""

from dataclasses import fields
from typing import Any

import torch
from torch import Tensor

from evsplat.render.splats import PinholeCamera, Splats


class Backdrop:
    """The static layer of one render after another, as long as layer and camera are the same.

    The native backend then projects and sorts that layer once, and composites the tiles that
    nothing moving touches once; the pictures are bit for bit those without it. When the layer or
    the camera changes, it begins anew. It serves one render at a time and has no gradients.
    """

    def __init__(self) -> None:
        self.job: Any = None
        """The native render that kept the layer; None: it is to be drawn anew."""
        self._seen: list[Any] = []
        self._versions: list[int | None] = []

    def show(
        self,
        moving: Splats,
        static: Splats,
        camera: PinholeCamera,
        background: Tensor | None,
        near: float,
        low_pass: float,
    ) -> None:
        """Forget what does not fit the render that comes next."""
        seen = [
            *(camera.width, camera.height, near, low_pass, moving.means.shape[1]),
            *(camera.K, camera.world_to_camera, background),
            *(getattr(static, field.name) for field in fields(Splats)),
        ]
        if self.job is not None and all(map(_same, seen, self._seen, self._versions)):
            return
        self.job, self._seen = None, seen
        self._versions = [value._version if isinstance(value, Tensor) else None for value in seen]


def _same(value: Any, old: Any, version: int | None) -> bool:
    if not isinstance(value, Tensor) or not isinstance(old, Tensor):
        return bool(value is old or value == old)
    # A tensor that was changed in place since is not what was drawn.
    return old._version == version and same_values(value, old)


def same_values(new: Tensor, old: Tensor) -> bool:
    """Whether two tensors hold the same; they are not read where they are one in memory."""
    if new.shape != old.shape or new.dtype != old.dtype or new.device != old.device:
        return False
    if new.data_ptr() == old.data_ptr() and new.stride() == old.stride():
        return True
    return torch.equal(new, old)
