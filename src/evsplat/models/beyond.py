"""What cameras beside the recording one show where it never looked: floor and wall, out of focus.

A recording at rest shows a scene from one side. From elsewhere one looks past it, and from behind
its wall at the wall's back, which would hide the person.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from evsplat.body import BodyTrack, up_axis
from evsplat.camera import Camera
from evsplat.gaussians.initialise import pixel_rays
from evsplat.models.layers import Layers

FLOOR_M = 0.12
"""Height above the floor up to which something is part of it."""
_RIM = 1 / 16
"""Width of the rim of the recorded picture whose colours go on, in its shorter side."""
_LEAST_ROOM_M = 0.5
_DOWN = 1e-4
"""Sine of the steepest ray that no longer meets the floor."""
_INSTANTS = 16


@dataclass(frozen=True, eq=False)
class Beyond:
    """An even floor before an even wall, in the mean colours of the rim of a recorded picture."""

    recording: Camera
    """At rest."""
    up: Float[Tensor, "3"]
    floor_m: float
    """Height of the floor along ``up``."""
    middle: Float[Tensor, "3"]
    """Of where the person was."""
    radius_m: float
    """From there to the wall; the floor ends between this and twice as far."""
    floor_rgb: Float[Tensor, "3"]
    """sRGB, as that of the wall."""
    wall_rgb: Float[Tensor, "3"]

    @classmethod
    def of(
        cls,
        recording: Camera,
        track: BodyTrack,
        picture: Float[Tensor, "H W 3"],
        depth: Float[Tensor, "H W"],
    ) -> "Beyond":
        """``picture`` and ``depth`` (metres) of the scene by ``recording``, without the person."""
        up = up_axis(track).float().cpu()
        recording = recording.to("cpu")
        floor_m = lowest_m(track, up)
        posed = track.vertices_at(instants(track))
        middle = torch.stack([vertices.mean(0) for vertices in posed]).mean(0)
        middle = middle.float().cpu()
        places = recording.center() + depth[..., None] * pixel_rays(recording)
        high = places @ up - floor_m > FLOOR_M
        width = max(1, round(_RIM * min(high.shape)))
        rim = torch.ones_like(high)
        rim[width:-width, width:-width] = False
        return cls(
            recording,
            up,
            floor_m,
            middle,
            max(_LEAST_ROOM_M, float(wall_m(depth, high) - recording.project(middle)[1])),
            _mean(picture, rim & ~high),
            _mean(picture, rim & high),
        )

    def fill(
        self, rgb: Float[Tensor, "T H W 3"], alpha: Float[Tensor, "T H W"], camera: Camera
    ) -> Float[Tensor, "T H W 3"]:
        """Pictures on black, sRGB, with the room in their holes."""
        return rgb + (1 - alpha.clamp(0, 1))[..., None] * self.behind(camera).to(rgb)

    def behind(self, camera: Camera) -> Float[Tensor, "H W 3"]:
        """The empty room as ``camera`` sees it, sRGB."""
        directions = ray_directions(camera)
        places, meets = on_floor(camera, directions, self.up, self.floor_m)
        far = along_floor(places - self.middle, self.up).norm(dim=-1) / self.radius_m - 1
        share = torch.where(meets, eased(far), 1.0)
        return torch.lerp(self.floor_rgb, self.wall_rgb, share[..., None])

    def uncovered(self, layers: Layers, camera: Camera) -> Layers:
        """Without what ``camera`` sees from behind: all but the floor that is nearer to the
        recording camera than ``camera`` itself.
        """
        scene = layers.scene
        depth = self.recording.project(scene.means[0])[1]
        mine = self.recording.project(camera.center())[1]
        height = scene.means[0] @ self.up.to(scene.means) - self.floor_m
        hides = (depth < mine) & (height > FLOOR_M)
        opacities = scene.opacities.masked_fill(hides, 0.0)
        return replace(layers, scene=replace(scene, opacities=opacities))


def on_floor(
    camera: Camera, directions: Float[Tensor, "H W 3"], up: Float[Tensor, "3"], floor_m: float
) -> tuple[Float[Tensor, "H W 3"], Bool[Tensor, "H W"]]:
    """Where the pixels' rays meet the plane at height ``floor_m`` along ``up``, and which do."""
    center = camera.center().cpu()
    climbing, height = directions @ up, float(center @ up) - floor_m
    way = max(height, 0.0) / (-climbing).clamp_min(_DOWN)
    return center + way[..., None] * directions, (climbing < -_DOWN) & (height > 0)


def along_floor(vectors: Float[Tensor, "*N 3"], up: Float[Tensor, "3"]) -> Float[Tensor, "*N 3"]:
    """Their horizontal part."""
    return vectors - (vectors @ up)[..., None] * up


def ray_directions(camera: Camera) -> Float[Tensor, "H W 3"]:
    """Unit directions of the pixels' middles in the world."""
    return normalize(pixel_rays(camera.to("cpu")), dim=-1)


def eased(share: Float[Tensor, "*N"]) -> Float[Tensor, "*N"]:
    """0 below 0, 1 above 1, and smooth in between."""
    share = share.clamp(0, 1)
    return share * share * (3 - 2 * share)


def instants(track: BodyTrack) -> list[int]:
    """Times over all of a motion."""
    first, last = int(track.times_us[0]), int(track.times_us[-1])
    return np.linspace(first, last, _INSTANTS).round().astype(int).tolist()


def lowest_m(track: BodyTrack, up: Float[Tensor, "3"]) -> float:
    """Height along ``up`` of the person's lowest point: that of the floor."""
    posed = track.vertices_at(instants(track))
    return min(float((vertices.cpu() @ up).min()) for vertices in posed)


def wall_m(depth: Float[Tensor, "*N"], high: Bool[Tensor, "*N"]) -> Float[Tensor, ""]:
    """Depth of the wall, metres: the median of what is above the floor, or the farthest."""
    return depth[high].median() if high.any() else depth.max()


def _mean(picture: Float[Tensor, "H W 3"], where: Bool[Tensor, "H W"]) -> Float[Tensor, "3"]:
    """Mean colour there; of all where there is nothing."""
    return picture[where].mean(0) if where.any() else picture.mean((0, 1))
