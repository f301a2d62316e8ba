"""Where in the world each pixel's scene is, without the person: that is where shadows fall."""

from dataclasses import replace
from typing import NamedTuple, Protocol

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from evsplat.camera import Camera
from evsplat.models.kept import Unchanged
from evsplat.render import Splats, render, same_values

LEAST_SCENE = 1e-3
"""Share of a pixel below which its scene has no place of its own."""


class WithScene(Protocol):
    """Layers, or what is known of them before the person's."""

    @property
    def scene(self) -> Splats:
        """With a leading axis of one time."""

    @property
    def low_pass(self) -> float:
        """Variance of the filter of a pixel, px^2."""


class SceneAlone(NamedTuple):
    """`WithScene` before there is a person."""

    scene: Splats
    low_pass: float


class ScenePlaces:
    """World places of the scene's pixels, kept from one picture to the next of a camera at rest.

    In training the scene moves a little with each step, and the places are drawn anew every
    ``refresh`` pictures and after densification; without ``refresh`` whenever anything changed.
    """

    def __init__(self, refresh: int | None = None) -> None:
        """Nothing is known before the first picture."""
        self.refresh, self.age = refresh, 0
        self.kept = torch.zeros(0, 0, 3)
        self.seen: list[Tensor] = []
        self._given = Unchanged()
        self.camera: Camera | None = None
        """The one of the kept places."""

    @torch.no_grad()
    def of(self, layers: WithScene, camera: Camera, step: int) -> Float[Tensor, "h w 3"]:
        """Places at every ``step``-th pixel; no gradients, as a shadow is not to move the scene."""
        shape = -(-camera.height // step), -(-camera.width // step), 3
        kept = tuple(self.kept.shape) == shape
        given = [camera.K, camera.world_to_camera]
        if self.refresh is None:
            scene = layers.scene
            given += [scene.means, scene.quaternions, scene.scales, scene.opacities]
        if not (kept and self._same(given, camera)):
            self.kept = places_of(scene_depth(layers, camera), camera, step)
            # Of these it is asked next; the comparison before may have been spared.
            self._given.again(given)
            self.seen, self.age = [tensor.detach().clone() for tensor in given], 0
            self.camera = camera
        self.age += 1
        return self.kept

    def _same(self, given: list[Tensor], camera: Camera) -> bool:
        if self.refresh is not None and self.age >= self.refresh:
            return False
        if given[1].device.type != "cpu":
            # To compare values the host would have to wait for the GPU.
            return self.refresh is not None and self.camera is camera
        if self._given.again(given) and self.seen:
            return True
        return len(given) == len(self.seen) and all(map(same_values, given, self.seen))

    def rows_changed(self) -> None:
        """The scene has other Gaussians now."""
        self.seen, self.camera = [], None

    def state(self) -> dict[str, Tensor]:
        """Tensors that a resume needs."""
        named = {f"seen{number}": tensor for number, tensor in enumerate(self.seen)}
        return {"kept": self.kept, "age": torch.tensor(self.age), **named}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Take back what `state` gave; nothing from a checkpoint without."""
        if not state:
            return
        self.kept, self.age = state["kept"], int(state["age"])
        self.seen = [state[f"seen{number}"] for number in range(len(state) - 2)]


def scene_depth(layers: WithScene, camera: Camera) -> Float[Tensor, "H W 2"]:
    """Of each pixel: z of its scene (metres) times the scene's share of it, and that share."""
    depth = camera.depth(layers.scene.means)[..., None]
    shown = replace(layers.scene, channels=torch.cat([depth, torch.ones_like(depth)], -1))
    return render(shown, camera, low_pass=layers.low_pass).image[0]


def places_of(depth: Float[Tensor, "H W 2"], camera: Camera, step: int) -> Float[Tensor, "h w 3"]:
    """World places of the scene at every ``step``-th pixel."""
    sums = F.avg_pool2d(depth.movedim(-1, 0), step, ceil_mode=True, count_include_pad=False)
    z = sums[0] / sums[1].clamp_min(LEAST_SCENE)
    y, x = ((torch.arange(count, device=z.device) + 0.5) * step for count in z.shape)
    K, pose = camera.K, camera.world_to_camera.detach()
    rays = torch.stack(
        [
            ((x - K[0, 2]) / K[0, 0]).expand(z.shape),
            ((y - K[1, 2]) / K[1, 1])[:, None].expand(z.shape),
            torch.ones_like(z),
        ],
        -1,
    )
    return (rays * z[..., None] - pose[:3, 3]) @ pose[:3, :3]
