"""Rooms with brick walls, a plank floor and perhaps a crate, painted ray by ray."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from evsplat.camera import Camera
from evsplat.gaussians.initialise import pixel_rays
from evsplat.methods.room import Room

SIDE, FOCAL, SAMPLES = 128, 133.0, 3
HEIGHT_M, SOLE_M, BOARD_M = 1.4, 0.02, 0.08
UP = torch.tensor([0.0, 0.0, 1.0])


def camera_over(turn: float, tilt: float = 0.1, roll: float = 0.0) -> Camera:
    """At the origin, `HEIGHT_M` over the floor; it looks along y, turned to the right and down."""
    ahead = np.array([math.sin(turn), math.cos(turn), -math.tan(tilt)])
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, UP.numpy())
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead])
    cosine, sine = math.cos(roll), math.sin(roll)
    pose[:2] = np.array([[cosine, -sine], [sine, cosine]]) @ pose[:2]
    K = torch.tensor([[FOCAL, 0, SIDE / 2], [0, FOCAL, SIDE / 2], [0, 0, 1]])
    return Camera(SIDE, SIDE, K, torch.from_numpy(pose).float())


def room_of(ahead: float, left: float, right: float, feet: tuple[float, float] = (0, 2)) -> Room:
    """Distances of its walls from the camera, and where somebody stands."""
    normals = torch.tensor([[0.0, 0, -1], [0, 1, 0], [-1, 0, 0], [1, 0, 0]])
    offsets = torch.tensor([HEIGHT_M, ahead, left, right])
    return Room(normals, offsets, torch.tensor([[*map(float, feet), -HEIGHT_M]]))


@dataclass(frozen=True)
class Crate:
    """Its least and greatest corner."""

    least: tuple[float, float, float]
    greatest: tuple[float, float, float]

    def depth(self, rays: Tensor) -> Tensor:
        """Of where each ray from the origin enters it; infinite where none does."""
        ends = torch.stack([torch.tensor(corner) / rays for corner in (self.least, self.greatest)])
        enters, leaves = ends.amin(0).amax(-1), ends.amax(0).amin(-1)
        return torch.where((enters > 0) & (enters < leaves), enters, torch.inf)


def met(room: Room, camera: Camera, crate: Crate | None = None) -> tuple[Tensor, Tensor]:
    """Number of the plane that each ray meets first, or of the crate after them, and its depth."""
    rays = pixel_rays(camera)
    slopes = rays @ room.normals.T
    depths = [torch.where(slopes > 0, room.offsets / slopes, torch.inf)]
    if crate is not None:
        depths.append(crate.depth(rays)[..., None])
    depth, which = torch.cat(depths, -1).min(-1)
    return which, depth


def painted(
    room: Room, camera: Camera, rng: np.random.Generator, crate: Crate | None = None
) -> Tensor:
    """Its picture: colours by chance, walls brighter or darker than the floor."""
    K = camera.K * SAMPLES
    K[2, 2] = 1
    size = SAMPLES * camera.width, SAMPLES * camera.height
    fine = Camera(*size, K, camera.world_to_camera)
    which, depth = met(room, fine, crate)
    x, y, z = (depth[..., None] * pixel_rays(fine)).unbind(-1)
    floor, wall, joint, board = (torch.from_numpy(rng.uniform(0.2, 0.8, 3)) for _ in range(4))
    wall = wall + 0.4 * torch.sign(floor.mean() - wall.mean())
    colours = torch.where((which == 0)[..., None], floor, wall).float()
    colours[(which == 0) & (torch.remainder(x, 0.3) < 0.03)] *= 0.8
    walls = (which > 0) & (which < len(room.normals))
    along = torch.where(which == 1, x, y)
    bricks = (torch.remainder(z, 0.22) < 0.04) | (torch.remainder(along, 0.5) < 0.05)
    colours[walls & bricks] = joint.float()
    colours[walls & (z < BOARD_M - HEIGHT_M)] = board.float()
    colours[which == 1] *= 0.9
    colours[which == len(room.normals)] = 1 - 0.5 * (floor + wall).float()
    colours += 0.01 * torch.from_numpy(rng.standard_normal(colours.shape)).float()
    return avg_pool2d(colours.clamp(0, 1).movedim(-1, 0)[None], SAMPLES)[0].movedim(0, -1)


def pillar(x: float, y: float) -> Tensor:
    """Points of a body that stands there on its soles."""
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    rings = [
        np.stack([x + r * np.cos(angles), y + r * np.sin(angles), np.full(24, z)], -1)
        for r in (0.1, 0.3)
        for z in (SOLE_M - HEIGHT_M, -0.4, 0.3)
    ]
    return torch.from_numpy(np.concatenate(rings)).float()
