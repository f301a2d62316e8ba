"""A motion on a character's body, standing on the floor in the middle of the room."""

import logging
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from evsplat.body import Body, BodyTrack, skin
from evsplat.body.retarget import SkeletonMotion, retarget
from evsplat.body.rotations import nearest_axis_angle
from evsplat.camera import Camera
from evsplat.staging.character import Character

logger = logging.getLogger(__name__)

_LEAST_AREA = 1e-3
_FLOOR_TIMES = 60
_FLOOR_PERCENTILE = 10
"""Share of the time in which feet may sink in: a jump's landing must not lift all the rest."""


def cut_motion(motion: SkeletonMotion, start_s: float, length_s: float) -> SkeletonMotion:
    """The poses of a stretch of time, which begins at microsecond 0, and one beyond either end."""
    elapsed = motion.times_us - motion.times_us[0] - round(start_s * 1e6)
    first = max(0, int(np.searchsorted(elapsed, 0, side="right")) - 1)
    last = int(np.searchsorted(elapsed, length_s * 1e6, side="left")) + 1
    return replace(
        motion,
        world_rotations=motion.world_rotations[first:last],
        root_positions=motion.root_positions[first:last],
        times_us=elapsed[first:last],
    )


def place_motion(
    motion: SkeletonMotion, character: Character, *, yaw_deg: float = 0.0, in_place: bool = False
) -> BodyTrack:
    """The character's body over time.

    The middle of the way is put at the origin and the soles on z = 0. ``yaw_deg`` turns the person
    about the vertical, to the left seen from above; ``in_place`` leaves out all travel.
    """
    body = character.body
    poses, transl = retarget(motion, body)
    turn = Rotation.from_euler("z", yaw_deg, degrees=True)
    rest = body.rest_joints[0].double().numpy()
    root = turn.apply(transl + rest)
    root[:, :2] -= root[:, :2] if in_place else (root[:, :2].max(0) + root[:, :2].min(0)) / 2
    oriented = poses.copy()
    oriented[:, 0] = (turn * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    oriented = nearest_axis_angle(oriented)
    track = BodyTrack(body, motion.times_us, oriented, root - rest, source=motion.source)
    root[:, 2] -= np.percentile(_lowest(character, track), _FLOOR_PERCENTILE)
    return BodyTrack(body, motion.times_us, oriented, root - rest, source=motion.source)


def dressed_vertices(
    character: Character, track: BodyTrack, time_us: int
) -> Float[torch.Tensor, "V 3"]:
    """The character's own mesh, clothes and hair, in the world at one time."""
    bones = track.body.bone_transforms(*track.at([time_us]))
    vertices, weights = torch.from_numpy(character.vertices), torch.from_numpy(character.weights)
    return skin(vertices, weights, bones)[0][0]


def key_poses(
    track: BodyTrack, times_us: np.ndarray
) -> tuple[Float[np.ndarray, "P J 3"], Float[np.ndarray, "P 3"]]:
    """Axis-angle poses and root shifts of the track at some times."""
    rotations, transl = track.at(times_us.tolist())
    flat = Rotation.from_matrix(rotations.double().numpy().reshape(-1, 3, 3)).as_rotvec()
    return nearest_axis_angle(flat.reshape(len(times_us), -1, 3)), transl.double().numpy()


def warn_of_leaving(
    character: Character, track: BodyTrack, cameras: list[Camera], times_us: np.ndarray
) -> None:
    """Log how many of the pictures cut off more than a twentieth of the person."""
    cut = 0
    for camera, time in zip(cameras, times_us, strict=True):
        pixels, depth = camera.project(dressed_vertices(character, track, int(time)))
        size = torch.tensor([camera.width, camera.height])
        outside = ((pixels < 0) | (pixels > size)).any(1) | (depth <= 0)
        cut += int(outside.float().mean() > 0.05)
    if cut:
        logger.warning(
            "The person leaves the picture in %d of %d frames; --in-place holds them to the spot.",
            cut,
            len(cameras),
        )


def warn_of_hiding(area: float) -> None:
    """Log where the person's mean share of the pictures is next to nothing."""
    if area < _LEAST_AREA:
        logger.warning(
            "The person fills %.2g %% of the pictures in the mean, and so is hidden, out of view "
            "or far away; move or turn them, or the camera.",
            100 * area,
        )


def height_m(body: Body) -> float:
    """The body's largest extent at rest."""
    return float((body.rest_vertices.amax(0) - body.rest_vertices.amin(0)).max())


def _lowest(character: Character, track: BodyTrack) -> list[float]:
    times = np.linspace(int(track.times_us[0]), int(track.times_us[-1]), _FLOOR_TIMES)
    return [float(dressed_vertices(character, track, int(t))[:, 2].min()) for t in times]
