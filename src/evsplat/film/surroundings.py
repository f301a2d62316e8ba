"""What stands around the person in a film: a calm room where nothing was seen, nothing in between.

A recording shows the scene from one side. From elsewhere there are holes, and walls whose backs
hide the person: holes show a soft floor below an even gradient, and what is nearer to the camera
than the person fades.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, ImageColor
from torch import Tensor
from torch.nn.functional import interpolate

from evsplat.body import BodyTrack, up_axis
from evsplat.camera import Camera
from evsplat.errors import ConfigError
from evsplat.models.beyond import (
    FLOOR_M,
    along_floor,
    eased,
    instants,
    lowest_m,
    on_floor,
    ray_directions,
    wall_m,
)
from evsplat.models.layers import Layers
from evsplat.pictures.files import read_opaque, to_rgb, to_unit_range

_FLOOR, _HORIZON, _TOP = (0.60, 0.58, 0.56), (0.83, 0.83, 0.82), (0.66, 0.69, 0.73)
"""sRGB."""
_FLOOR_ENDS_M = 5.0
_SHADOW, _SHADOW_M = 0.4, 0.4
"""Depth and standard deviation of the soft spot below the person."""
_CLEAR_M = (0.3, 0.0)
"""What is nearer to the camera than the person's middle by these has faded and begins to fade."""
_COARSE_PX = 64
"""Side of the pictures in a hurry, at least: with less the horizon and the spot are steps."""
_BEHIND, _WALL = 1.05, 0.97
"""Depth of a wall as a share of the person's largest; share of its depth from which it is one."""
_EDGE = 0.08
"""Width of the rim of the recorded picture that fades, in its shorter side."""
_ELSEWHERE = (0.3, 0.15)
"""Metres and radians from the recording camera at which the rim has faded."""


@dataclass(frozen=True, eq=False)
class CalmRoom:
    """An even gradient above a soft floor, and the person's soft spot on it."""

    track: BodyTrack
    """The motion that is filmed."""
    up: Float[Tensor, "3"]
    floor_m: float
    """Height of the floor along ``up``."""
    recording: Camera | None = None
    """The camera that recorded the scene, where it stood still."""

    @classmethod
    def of(
        cls, recorded: BodyTrack, filmed: BodyTrack, recording: Camera | None = None
    ) -> "CalmRoom":
        """The floor is where the recorded person's lowest point is."""
        up = up_axis(recorded).float().cpu()
        return cls(filmed, up, lowest_m(recorded, up), recording)

    def behind(self, camera: Camera, time_us: int) -> Float[Tensor, "H W 3"]:
        """The picture of the empty room, sRGB."""
        directions = ray_directions(camera)
        colour = _mixed(_HORIZON, _TOP, (directions @ self.up / 0.6).clamp(0, 1))
        places, below = on_floor(camera, directions, self.up, self.floor_m)
        if not below.any():
            return colour
        root = self.track.at([time_us])[1][0] + self.track.body.rest_joints[0]
        pelvis = root.float().cpu()
        square = along_floor(places - pelvis, self.up).square().sum(-1)
        floor = _mixed(_FLOOR, _HORIZON, 1 - torch.exp(-square / _FLOOR_ENDS_M**2))
        spot = 1 - _SHADOW * torch.exp(-square / (2 * _SHADOW_M**2))
        return torch.where(below[..., None], floor * spot[..., None], colour)

    def behind_coarsely(self, camera: Camera, time_us: int) -> Float[Tensor, "H W 3"]:
        """The same, smooth between one pixel in 16 of a large picture: for pictures in a hurry."""
        width, height = (
            max(size // 4, min(size, _COARSE_PX)) for size in (camera.width, camera.height)
        )
        picture = self.behind(camera.resized(width, height), time_us)
        size = (camera.height, camera.width)
        enlarged = interpolate(picture.permute(2, 0, 1)[None], size, mode="bilinear")
        return enlarged[0].permute(1, 2, 0)

    def clear(self, layers: Layers, camera: Camera) -> Layers:
        """Fade what stands between the camera and the person, but for the floor."""
        scene, human = layers.scene, layers.human
        if not human.means.numel():
            return layers
        depth, person = (camera.project(part.means)[1] for part in (scene, human))
        begin, end = (person.mean() - metres for metres in _CLEAR_M)
        share = eased((depth[0] - begin) / (end - begin))
        height = scene.means[0] @ self.up.to(scene.means) - self.floor_m
        share = torch.where(height < FLOOR_M, 1.0, share)
        return replace(layers, scene=replace(scene, opacities=scene.opacities * share))

    def stand_back(self, layers: Layers, camera: Camera) -> Layers:
        """Put a wall that somebody would walk through behind all that the filmed person does.

        A camera that stood still has not seen how far away the wall is, and recorded the same.
        A person alone has none.
        """
        if self.recording is None or not layers.scene.means.numel():
            return layers
        scene, recording = layers.scene, self.recording.to(layers.scene.means.device)
        depth = recording.project(scene.means[0])[1]
        height = scene.means[0] @ self.up.to(scene.means) - self.floor_m
        high = height > FLOOR_M
        factor = (_BEHIND * self._deepest_m / depth.clamp_min(0.1)).clamp_min(1.0)
        factor = torch.where(high | (depth > _WALL * wall_m(depth, high)), factor, 1.0)[:, None]
        center = recording.center()
        means = center + (scene.means - center) * factor
        return replace(layers, scene=replace(scene, means=means, scales=scene.scales * factor))

    @cached_property
    def _deepest_m(self) -> float:
        """How far from the recording camera the filmed person gets."""
        assert self.recording is not None
        recording = self.recording.to("cpu")
        posed = self.track.vertices_at(instants(self.track))
        return max(float(recording.project(vertices.cpu())[1].max()) for vertices in posed)

    def soften(self, layers: Layers, camera: Camera) -> Layers:
        """Fade the scene towards the edge of what was recorded, the more the camera went away."""
        if self.recording is None:
            return layers
        scene, recording = layers.scene, self.recording.to(layers.scene.means.device)
        axes = camera.world_to_camera[2, :3] @ recording.world_to_camera[2, :3].to(camera.K)
        turned = float(axes.clamp(-1, 1).arccos())
        moved = float((camera.center() - recording.center().to(camera.K)).norm())
        gone = eased(torch.tensor(moved / _ELSEWHERE[0] + turned / _ELSEWHERE[1]))
        pixels, depth = recording.project(scene.means[0])
        size = pixels.new_tensor([recording.width, recording.height])
        inside = torch.minimum(pixels, size - pixels).amin(-1) / size.min()
        rim = eased(inside / _EDGE).masked_fill(depth <= 0, 0.0)
        share = 1 - gone.to(rim) * (1 - rim)
        return replace(layers, scene=replace(scene, opacities=scene.opacities * share))


@dataclass(frozen=True, eq=False)
class Painted:
    """A colour or a picture behind everything."""

    picture: Float[Tensor, "h w 3"]
    """sRGB; fills the frame, and what does not fit is cut off evenly."""

    @classmethod
    def of(cls, asked: str) -> "Painted":
        """By a colour's name, ``#rrggbb``, or the path of a picture; else a `ConfigError`."""
        if Path(asked).is_file():
            pixels = read_opaque(Path(asked))
            if pixels is None:
                raise ConfigError(
                    f"--background {asked}: is transparent in places, where nothing would be "
                    "behind the person; fill them with a colour."
                )
            return cls(to_rgb(to_unit_range(pixels)))
        try:
            rgb = ImageColor.getrgb(asked)[:3]
        except ValueError:
            raise ConfigError(
                f"--background {asked}: neither a colour (white, #202830) nor a picture's file."
            ) from None
        return cls(torch.tensor(rgb).view(1, 1, 3) / 255)

    def behind(self, camera: Camera, time_us: int) -> Float[Tensor, "H W 3"]:
        """The picture at the camera's size."""
        high, wide = self.picture.shape[:2]
        scale = max(camera.height / high, camera.width / wide)
        size = max(camera.width, round(wide * scale)), max(camera.height, round(high * scale))
        image = Image.fromarray((self.picture * 255).round().byte().numpy())
        image = image.resize(size, Image.Resampling.LANCZOS)
        left, top = (size[0] - camera.width) // 2, (size[1] - camera.height) // 2
        image = image.crop((left, top, left + camera.width, top + camera.height))
        return torch.from_numpy(np.asarray(image).astype(np.float32) / 255)


def _mixed(
    near: tuple[float, ...], far: tuple[float, ...], share: Float[Tensor, "H W"]
) -> Float[Tensor, "H W 3"]:
    return torch.lerp(torch.tensor(near), torch.tensor(far), share[..., None])
