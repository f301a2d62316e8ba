"""The scene behind the person before a moving camera: all frames carried onto one floor and wall.

No two frames show it from the same place, so that a pixel's median over time means nothing. Seen
from the middle of the camera's way, on a surface behind the person, it does.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.ndimage import map_coordinates
from torch import Tensor

from evsplat.body import BodyTrack, up_axis
from evsplat.camera import Camera
from evsplat.capture import Frame, TrainingCapture
from evsplat.errors import ConfigError
from evsplat.gaussians.initialise import backdrop_depth, pixel_rays
from evsplat.gaussians.surround import margins
from evsplat.methods.background import NEVER, apart, looked_at, median_far_away
from evsplat.methods.plane_sweep import Shot, depth_shares
from evsplat.methods.starts import Backdrop, places

MOST_TURN_DEG = 45.0
"""Turn of a camera from the middle of its way up to which one sheet stands for the scene: what is
seen from other sides has other surfaces."""
WALLS = (0.15, 0.3, 0.5, 0.75, 1.1, 1.6, 2.5)
"""Distances of the wall behind the deepest body point that are compared, as shares of its depth."""
COMPARED_FRAMES, COMPARED_PIXELS, SWEPT_FRAMES = 12, 65_536, 24
"""Of the comparison of walls, and frames that tell the depth of each pixel, at most."""
WELL_AWAY = 3.0
"""Bands from the body at which a frame tells how far away the scene is: nearer by, shadows move."""
_TELLING = 0.02
"""Share by which frames must agree better on a farther wall: of a camera that only turns, all agree
alike."""


def require_one_side(capture: TrainingCapture) -> None:
    """Raise a `ConfigError` where one sheet cannot stand for what the training frames show."""
    turn = _turns_deg(capture, middle_view(capture)).max()
    if turn > MOST_TURN_DEG:
        raise ConfigError(
            f"{capture.path}: scene.kind is median_backdrop, which sees the scene from one side; "
            f"this capture's camera turns by {turn:.0f} degrees from the middle of its way, more "
            f"than {MOST_TURN_DEG:.0f}. Pass --set scene.kind=random_cube."
        )


def middle_view(capture: TrainingCapture) -> Camera:
    """The training camera whose place is nearest to the mean of all."""
    cameras = [capture.camera(frame) for frame in capture.train_frames]
    centers = torch.stack([camera.center() for camera in cameras])
    return cameras[int((centers - centers.mean(0)).norm(dim=1).argmin())]


def moving_backdrop(capture: TrainingCapture, track: BodyTrack, band_px_at_256: float) -> Backdrop:
    """What `background_without` is to a still camera, in a view that holds all training frames.

    The floor lies under the feet. The wall is as far as the frames agree best on what it shows.
    """
    middle = middle_view(capture)
    frames = looked_at(capture)
    band = band_px_at_256 * middle.height / 256
    seen = [_Seen.of(capture, track, frame, WELL_AWAY * band) for frame in frames]
    body = _Body(places(capture, track), up_axis(track))
    share, spread = WALLS[0], math.inf
    few = seen[:: -(-len(seen) // COMPARED_FRAMES)]
    step = max(1, math.isqrt(middle.width * middle.height // COMPARED_PIXELS))
    for wall in WALLS:
        points = body.sheet(middle, wall)[::step, ::step]
        apart_by = _spread([each.carried(points) for each in few], band)
        if apart_by < (1 - _TELLING) * spread:
            share, spread = wall, apart_by
    view = middle.widened(*_beyond([each.camera for each in seen], middle, body, share))
    sheet = body.sheet_depth(view, share)
    compared = seen[:: -(-len(seen) // SWEPT_FRAMES)]
    shares = depth_shares(view, sheet, (each.shot(WELL_AWAY * band) for each in compared))
    points = view.center() + (sheet * shares)[..., None] * pixel_rays(view)
    shown = [each.carried(points) for each in seen]
    pictures, near = (np.stack([each[part] for each in shown]) for part in (0, 1))
    near = np.minimum(near, np.float16(band))
    return Backdrop(view, median_far_away(pictures, near, band), share, shares)


@dataclass(frozen=True, eq=False)
class _Seen:
    """A training frame."""

    camera: Camera
    picture: UInt8[np.ndarray, "h w 3"]
    near: Float[np.ndarray, "h w"]
    """Pixels to the body, up to some."""

    @staticmethod
    def of(capture: TrainingCapture, track: BodyTrack, frame: Frame, farthest: float) -> "_Seen":
        """In eight bits: many large pictures would fill the memory."""
        picture = (255 * capture.image(frame)).round().byte().cpu().numpy()
        near = np.minimum(apart(capture, track, frame), farthest).astype(np.float32)
        return _Seen(capture.camera(frame), picture, near)

    def shot(self, away: float) -> Shot:
        """Its pixels count that are so far from the body, pixels."""
        picture, free = torch.from_numpy(self.picture), torch.from_numpy(self.near >= away)
        return Shot(self.camera, picture.float() / 255, free.float())

    def carried(
        self, points: Float[Tensor, "H W 3"]
    ) -> tuple[UInt8[np.ndarray, "H W 3"], Float[np.ndarray, "H W"]]:
        """Picture and distances where ``points`` of the world are; `NEVER` out of view."""
        pixels, depth = self.camera.project(points)
        x, y = (pixels.numpy()[..., axis] - 0.5 for axis in (0, 1))
        # A pixel shows half of one beyond its centre.
        shown = (depth.numpy() > 0) & (x > -0.5) & (y > -0.5)
        shown &= (x < self.camera.width - 0.5) & (y < self.camera.height - 0.5)
        at = np.stack([np.where(shown, y, 0), np.where(shown, x, 0)])

        def looked_up(values: np.ndarray) -> np.ndarray:
            found: np.ndarray = map_coordinates(values, at, np.float32, order=1, mode="nearest")
            return found

        channels = [looked_up(self.picture[..., channel]) for channel in range(3)]
        colours = np.stack(channels, -1).round().clip(0, 255).astype(np.uint8)
        near = np.where(shown, looked_up(self.near), NEVER).astype(np.float16)
        return colours, near


@dataclass(frozen=True, eq=False)
class _Body:
    """Where the person goes."""

    points: Float[Tensor, "M 3"]
    up: Float[Tensor, "3"]

    def sheet(self, view: Camera, share: float) -> Float[Tensor, "H W 3"]:
        """Places of floor and wall at the pixels of ``view``."""
        return view.center() + self.sheet_depth(view, share)[..., None] * pixel_rays(view)

    def sheet_depth(self, view: Camera, share: float) -> Float[Tensor, "H W"]:
        """How far away they are, metres."""
        return backdrop_depth(view, [self.points], up=self.up, margin=share)


def _turns_deg(capture: TrainingCapture, view: Camera) -> Float[np.ndarray, "F"]:
    """Angles between where the training cameras look and where ``view`` does, degrees."""
    axes = [capture.camera(frame).world_to_camera[2, :3] for frame in capture.train_frames]
    cosines = torch.stack(axes) @ view.world_to_camera[2, :3]
    turns: np.ndarray = np.degrees(np.arccos(cosines.clamp(-1, 1).numpy()))
    return turns


def _spread(
    shown: Sequence[tuple[UInt8[np.ndarray, "H W 3"], Float[np.ndarray, "H W"]]], band: float
) -> float:
    """Mean distance from the median, over the frames in which the person is a band away."""
    pictures = np.stack([picture for picture, _ in shown]).astype(np.float32)
    free = np.stack([near for _, near in shown]) >= np.float16(band)
    kept = np.where(free[..., None], pictures, np.nan)[:, free.sum(0) > 1]
    return float(np.nanmean(np.abs(kept - np.nanmedian(kept, 0)))) if kept.size else math.inf


def _beyond(
    cameras: Sequence[Camera], middle: Camera, body: _Body, share: float
) -> tuple[int, int]:
    """Pixels by which ``middle`` is to be widened to show what the cameras' borders do."""
    outside = torch.zeros(2)
    size = torch.tensor([float(middle.width), float(middle.height)])
    for camera in cameras:
        points = body.sheet(camera, share)
        border = torch.cat([points[0], points[-1], points[:, 0], points[:, -1]])
        pixels, depth = middle.project(border)
        pixels = pixels[depth > 0]
        outside = torch.maximum(outside, torch.maximum(-pixels, pixels - size).amax(0))
    most = torch.tensor(margins(middle)).float()
    x, y = torch.minimum(outside.ceil(), most).long().tolist()
    return x, y
