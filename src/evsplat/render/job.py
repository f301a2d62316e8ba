"""One render as backends take it, and the static layer kept from one to the next."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import torch
from torch import Tensor

from evsplat.camera import Camera
from evsplat.render.splats import Splats

Kept = TypeVar("Kept")


@dataclass(frozen=True)
class RenderJob:
    """Checked arguments of `evsplat.render.render`; Gaussians have their leading axis of times."""

    splats: Splats
    static: Splats | None
    times: int
    """Number of pictures."""
    camera: Camera
    background: Tensor | None
    near: float
    """Least depth of what is drawn, metres."""
    low_pass: float
    """Added to the projected covariances, px^2."""
    backdrop: "Backdrop | None" = None
    static_light: Tensor | None = None
    groups: tuple[int, ...] = ()
    """Sizes of the groups of channels that come as pictures of their own; empty: none."""


class Backdrop:
    """The static layer of one render after another, as long as layer and camera are the same.

    The native backend then projects and sorts that layer once, and composites the tiles that
    nothing moving touches once; the pictures are bit for bit those without it. When the layer or
    the camera changes, it begins anew. It serves one render at a time and has no gradients.
    """

    def __init__(self) -> None:
        self.kept: Any = None
        """The native render that kept the layer; None: it is to be drawn anew."""
        self._seen: list[Any] = []
        self._versions: list[int | None] = []
        self._beside: Any = None

    def beside(self, make: Callable[[], Kept]) -> Kept:
        """What a caller keeps of the same static layer beside this, made once by ``make``."""
        if self._beside is None:
            self._beside = make()
        kept: Kept = self._beside
        return kept

    def show(self, job: RenderJob) -> None:
        """Forget what does not fit the render that comes next."""
        camera = job.camera
        seen = [
            *(camera.width, camera.height, job.near, job.low_pass, job.splats.means.shape[1]),
            *(camera.K, camera.world_to_camera, job.background),
            *(getattr(job.static, field.name) for field in fields(Splats)),
        ]
        if self.kept is not None and all(map(_same, seen, self._seen, self._versions)):
            return
        self.kept, self._seen = None, seen
        self._versions = [value._version if isinstance(value, Tensor) else None for value in seen]


def _same(value: Any, old: Any, version: int | None) -> bool:
    if not isinstance(value, Tensor) or not isinstance(old, Tensor):
        return bool(value is old or value == old)
    # A tensor that was changed in place since is not what was drawn.
    return old._version == version and same_values(value, old)


def same_values(new: Tensor, old: Tensor) -> bool:
    """True for tensors that hold the same; they are not read where they are one in memory."""
    if new.shape != old.shape or new.dtype != old.dtype or new.device != old.device:
        return False
    return same_memory(new, old) or torch.equal(new, old)


def same_memory(new: Tensor, old: Tensor) -> bool:
    """True for two views of the same values; ``old`` was held, so that its memory is no other's."""
    return new.dtype == old.dtype and new.device == old.device and new.is_set_to(old)
