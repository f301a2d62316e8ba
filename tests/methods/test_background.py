"""What a still camera sees behind the person, from frames of which the person hides a part."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from evsplat.body import BodyTrack, default_body
from evsplat.camera import Camera
from evsplat.methods.background import background_without

SIDE, FRAMES, SKIN = 64, 9, 230 / 255


@dataclass(frozen=True)
class Shot:
    mid_us: int
    exposure_us: tuple[int, int]


class Still:
    """A capture of somebody before a wall, as far as `background_without` asks."""

    def __init__(self, track: BodyTrack, camera: Camera, wall: torch.Tensor) -> None:
        self.train_frames = [Shot(t, (t - 100, t + 100)) for t in track.times_us.tolist()]
        self._track, self._camera, self._wall = track, camera, wall

    def camera(self, frame: Shot) -> Camera:
        return self._camera

    def image(self, frame: Shot) -> torch.Tensor:
        """The wall, and skin within a pixel of where the body's vertices are."""
        pixels = self._camera.project(self._track.vertices(frame.mid_us)[::7])[0]
        grid = torch.stack(
            torch.meshgrid(torch.arange(SIDE) + 0.5, torch.arange(SIDE) + 0.5, indexing="xy"), -1
        )
        near = torch.cdist(grid.reshape(-1, 2), pixels).amin(1).view(SIDE, SIDE) < 1
        return torch.where(near[..., None], torch.tensor(SKIN), self._wall)


def capture_of(places_x: list[float]) -> tuple[Still, torch.Tensor, BodyTrack]:
    """Somebody who stands at these places, in metres across the view, a frame each."""
    body = default_body()
    transl = np.zeros((len(places_x), 3))
    transl[:, 0] = places_x
    poses = np.zeros((len(places_x), len(body.parents), 3))
    track = BodyTrack(body, 50_000 * np.arange(len(places_x)), poses, transl)
    middle = track.vertices(0).mean(0) - torch.tensor(transl[0]).float()
    pose = torch.eye(4)
    pose[:3, 3] = -middle + torch.tensor([0.0, 0.0, 6.0])
    K = torch.tensor([[100.0, 0, SIDE / 2], [0, 100.0, SIDE / 2], [0, 0, 1]])
    camera = Camera(width=SIDE, height=SIDE, K=K, world_to_camera=pose)
    wall = torch.randint(150, (SIDE, SIDE, 3), generator=torch.Generator().manual_seed(0)) / 255
    return Still(track, camera, wall), wall, track


@pytest.mark.parametrize("away", [2, 4])
def test_somebody_who_leaves_for_a_few_frames_is_not_in_it(away):
    """In a median of all frames they would be, since they stay for most of them."""
    capture, wall, track = capture_of([0.0] * (FRAMES - away) + [2.2] * away)
    pictures = torch.stack([capture.image(frame) for frame in capture.train_frames])
    assert (pictures.median(0).values > 0.8).any()
    assert torch.allclose(background_without(capture, track, 12.0), wall, atol=1e-6)


def test_where_somebody_always_is_all_frames_count():
    capture, wall, track = capture_of([0.0] * FRAMES)
    found = background_without(capture, track, 12.0)
    first = capture.image(capture.train_frames[0])
    assert torch.allclose(found, first, atol=1e-6) and not torch.allclose(found, wall)


def test_nobody_in_the_picture_leaves_the_median():
    capture, wall, track = capture_of([50.0] * FRAMES)
    assert torch.allclose(background_without(capture, track, 12.0), wall, atol=1e-6)
