"""What a still camera sees behind the person, from frames of which the person hides a part."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt

from evsplat.body import BodyTrack, default_body, silhouette
from evsplat.camera import Camera
from evsplat.methods.background import background_without, gone_on

SIDE, FRAMES, SKIN = 64, 9, 230 / 255


@dataclass(frozen=True)
class Shot:
    mid_us: int
    exposure_us: tuple[int, int]
    camera: str = "main"


class Still:
    """A capture of somebody before a wall, as far as `background_without` asks."""

    def __init__(self, track: BodyTrack, camera: Camera, wall: torch.Tensor) -> None:
        self.train_frames = [Shot(t, (t - 100, t + 100)) for t in track.times_us.tolist()]
        self._track, self._camera, self._wall = track, camera, wall

    def camera(self, frame: Shot) -> Camera:
        return self._camera

    def cameras_at(self, name: str, times_us: list[int]) -> tuple[Camera, ...]:
        return (self._camera,) * len(times_us)

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


def test_where_somebody_always_is_the_wall_goes_on():
    """A median shows them there, and so do the frames in which they are farthest."""
    capture, _, track = capture_of([0.0] * FRAMES)
    capture._wall = torch.tensor([0.2, 0.3, 0.4]).expand(SIDE, SIDE, 3)
    shown = capture.image(capture.train_frames[0])
    found = background_without(capture, track, 120.0)
    assert ((shown - capture._wall).abs().amax(-1) > 0.1).sum() > 100
    assert torch.allclose(found, capture._wall, atol=1e-2)


def test_a_place_beside_the_body_in_one_frame_alone_is_taken_from_that_frame():
    """Nearer than the band in all frames, and farthest in one of them."""
    capture, wall, track = capture_of([0.0] * (FRAMES - 1) + [0.5])
    found = background_without(capture, track, 60.0)
    hidden = [
        silhouette(track.vertices(t), track.body.faces, capture.camera(None)).numpy()
        for t in track.times_us.tolist()
    ]
    once = torch.from_numpy(hidden[0] & (distance_transform_edt(~hidden[-1]) > 4))
    assert once.sum() > 10
    assert torch.allclose(found[once], wall[once], atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_what_was_seen_stays_and_the_rest_lies_within_its_range(seed):
    generator = torch.Generator().manual_seed(seed)
    height, width = torch.randint(1, 90, (2,), generator=generator).tolist()
    picture = torch.rand(height, width, 3, generator=generator)
    seen = torch.rand(height, width, generator=generator) < 0.02
    seen[-1, -1] = True
    found = gone_on(picture, seen)
    assert torch.equal(found[seen], picture[seen])
    known = picture[seen]
    assert (found >= known.amin(0) - 1e-5).all() and (found <= known.amax(0) + 1e-5).all()
    # Colours at places that were not seen count nothing.
    other = torch.where(seen[..., None], picture, 1 - picture)
    assert torch.equal(gone_on(other, seen), found)


def test_an_even_slope_goes_on_through_a_hole():
    """Laplace's equation, which continues a slope exactly, is the reference."""
    y, x = torch.meshgrid(torch.arange(96.0), torch.arange(128.0), indexing="ij")
    picture = torch.stack([x / 128, y / 96, (x + y) / 224], -1)
    hole = ((x - 60) / 22).square() + ((y - 50) / 30).square() < 1
    found = gone_on(torch.where(hole[..., None], torch.nan, picture).nan_to_num(5.0), ~hole)
    assert (found - picture)[hole].abs().max() < 0.13
    assert (found - picture)[hole].square().mean().sqrt() < 0.05


def test_a_picture_of_which_nothing_was_seen_stays():
    picture = torch.rand(5, 7, 3)
    assert torch.equal(gone_on(picture, torch.zeros(5, 7, dtype=torch.bool)), picture)


def test_nobody_in_the_picture_leaves_the_median():
    capture, wall, track = capture_of([50.0] * FRAMES)
    assert torch.allclose(background_without(capture, track, 12.0), wall, atol=1e-6)
