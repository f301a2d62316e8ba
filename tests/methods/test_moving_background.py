"""What a moving camera sees behind the person, on a floor and a wall that are known."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from evsplat.body import BodyTrack, axis_angle_to_matrix, default_body, silhouette, up_axis
from evsplat.camera import Camera
from evsplat.capture import load_capture
from evsplat.errors import ConfigError
from evsplat.gaussians.initialise import backdrop_depth, pixel_rays
from evsplat.methods.moving_background import middle_view, moving_backdrop, require_one_side

from ..evaluation.helpers import edit
from ..small_model import built

SIDE, FRAMES, SKIN = 64, 9, 230 / 255
DISTANCE = 6.0
UPRIGHT = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Of a camera that looks along y, z being up."""


@dataclass(frozen=True)
class Shot:
    mid_us: int
    exposure_us: tuple[int, int]
    camera: str = "main"


class Moving:
    """Somebody on a floor before a wall ``share`` behind them, filmed from a camera's way."""

    path = "moving"

    def __init__(self, eyes: np.ndarray, turns_deg: np.ndarray, share: float) -> None:
        body = default_body()
        transl = np.zeros((FRAMES, 3))
        transl[:, 0] = np.linspace(-1.0, 1.0, FRAMES)
        poses = np.zeros((FRAMES, len(body.parents), 3))
        self.track = BodyTrack(body, 50_000 * np.arange(FRAMES), poses, transl)
        self.train_frames = tuple(Shot(t, (t - 100, t + 100)) for t in self.track.times_us.tolist())
        middle = self.track.vertices(self.train_frames[FRAMES // 2].mid_us).mean(0)
        self.cameras = {}
        for shot, eye, degrees in zip(self.train_frames, eyes, turns_deg, strict=True):
            turn = axis_angle_to_matrix(torch.tensor([0.0, np.radians(degrees), 0.0])).float()
            rotation = turn @ UPRIGHT
            pose = torch.eye(4)
            pose[:3, :3] = rotation
            center = middle + torch.tensor(eye).float() - torch.tensor([0.0, DISTANCE, 0.0])
            pose[:3, 3] = -rotation @ center
            K = torch.tensor([[90.0, 0, SIDE / 2], [0, 90.0, SIDE / 2], [0, 0, 1]])
            self.cameras[shot] = Camera(SIDE, SIDE, K, pose)
        view = middle_view(self)
        body_points = [self.track.vertices(shot.mid_us) for shot in self.train_frames]
        # Wall and floor of the middle view: a depth, and a height that the lowest points have.
        axis = view.world_to_camera[2, :3]
        deepest = max(float(view.project(points)[1].max()) for points in body_points)
        self.wall = axis, float(view.center() @ axis) + deepest * (1 + share)
        up = up_axis(self.track)
        lowest = torch.cat([points[::7] @ up for points in body_points]).sort().values
        self.floor = up, float(torch.quantile(lowest, 1 / 500))

    def camera(self, frame: Shot) -> Camera:
        return self.cameras[frame]

    def cameras_at(self, name: str, times_us: list[int]) -> list[Camera]:
        """It stands during the exposures, which are short."""
        nearest = [min(self.cameras, key=lambda shot: abs(shot.mid_us - t)) for t in times_us]
        return [self.cameras[shot] for shot in nearest]

    def scene(self, camera: Camera) -> torch.Tensor:
        """Colours where each pixel's ray first meets floor or wall."""
        rays, center = pixel_rays(camera), camera.center()
        lengths = []
        for normal, offset in (self.wall, self.floor):
            length = (offset - center @ normal) / (rays @ normal)
            lengths.append(torch.where(length > 0, length, torch.inf))
        places = center + torch.minimum(*lengths)[..., None] * rays
        return colours(places)

    def image(self, frame: Shot) -> torch.Tensor:
        """The scene, and skin where the body and a pixel around it are."""
        camera = self.camera(frame)
        body = silhouette(self.track.vertices(frame.mid_us), self.track.body.faces, camera)
        grown = torch.nn.functional.max_pool2d(body[None].float(), 3, 1, 1)[0] > 0
        return torch.where(grown[..., None], torch.tensor(SKIN), self.scene(camera))


def colours(places: torch.Tensor) -> torch.Tensor:
    """A texture below the brightness of skin."""
    waves = torch.stack([places @ torch.tensor(k) for k in WAVES], -1)
    return 0.35 + 0.25 * torch.sin(waves)


WAVES = ((2.0, 0.4, 0.8), (-0.8, 1.2, 2.2), (1.2, 1.6, -1.6))
"""Radians per metre; a pixel of the farthest wall is 0.2 m wide."""


def across(metres: float) -> np.ndarray:
    """A way from left to right."""
    eyes = np.zeros((FRAMES, 3))
    eyes[:, 0] = np.linspace(-metres, metres, FRAMES)
    return eyes


@pytest.mark.parametrize("share", [0.3, 0.75, 1.6])
def test_frames_from_elsewhere_tell_how_far_the_wall_is_and_what_is_on_it(share):
    capture = Moving(across(1.5), np.zeros(FRAMES), share)
    found = moving_backdrop(capture, capture.track, 9.0)
    assert found.margin == share
    true = capture.scene(found.camera)
    # Floor and wall meet at an edge that is missed by a pixel, and the floor is fine far away.
    missed = (found.picture - true)[:, SIDE // 2 : -SIDE // 2].abs()
    assert missed.median() < 0.01
    assert missed.quantile(0.9) < 0.05


def test_the_view_holds_what_every_frame_shows():
    capture = Moving(across(0.8), np.linspace(-8, 8, FRAMES), 0.5)
    view = moving_backdrop(capture, capture.track, 9.0).camera
    depth = backdrop_depth(view, [capture.track.vertices(0)], up=up_axis(capture.track), margin=0.5)
    assert depth.shape == (view.height, view.width)
    for shot in capture.train_frames:
        camera = capture.camera(shot)
        corners = torch.tensor([[0, 0], [SIDE - 1, 0]])  # above the floor
        rays = pixel_rays(camera)[corners[:, 1], corners[:, 0]]
        normal, offset = capture.wall
        lengths = (offset - camera.center() @ normal) / (rays @ normal)
        pixels = view.project(camera.center() + lengths[:, None] * rays)[0]
        assert (pixels > -1).all() and (pixels[:, 0] < view.width + 1).all()


def test_a_camera_that_stands_still_has_the_nearest_wall_and_its_own_picture():
    capture = Moving(np.zeros((FRAMES, 3)), np.zeros(FRAMES), 0.5)
    found = moving_backdrop(capture, capture.track, 9.0)
    assert found.margin == 0.15
    assert (found.camera.width, found.camera.height) == (SIDE, SIDE)
    assert (found.picture - capture.scene(found.camera)).abs().max() < 2 / 255


def test_a_camera_that_goes_round_is_refused_with_what_to_do():
    capture = Moving(across(0.1), np.linspace(-60, 60, FRAMES), 0.5)
    with pytest.raises(ConfigError, match=r"turns by 60 degrees.*scene.kind=random_cube"):
        require_one_side(capture)
    require_one_side(Moving(across(0.1), np.linspace(-40, 40, FRAMES), 0.5))


@pytest.mark.parametrize("purpose", ["train", "draw"])
def test_method_evsplat_starts_with_it(tiny_capture, purpose):
    def move(document):
        pose = document["cameras"]["main"]["world_to_camera"]
        for number, frame in enumerate(document["frames"]):
            moved = [list(row) for row in pose]
            moved[0][3] += 0.01 * number
            frame["world_to_camera"] = moved

    path = edit(tiny_capture(), move)
    assert not load_capture(path).is_static_camera
    composition = built("evsplat", path, purpose=purpose)
    assert composition.recording is None and composition.model.relief is None
    assert len(composition.model.gaussians.get_parameter("means")) > 100
