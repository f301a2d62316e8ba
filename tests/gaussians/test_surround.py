"""Around the picture the scene goes on: what the camera saw stays as it is."""

import pytest
import torch
from tests.gaussians.test_initialise import body_points, camera

from evsplat.camera import Camera
from evsplat.gaussians.initialise import backdrop_depth, gaussians_at, median_backdrop
from evsplat.gaussians.surround import margins, surround
from evsplat.render import Splats, render

UP = torch.tensor([0.0, 0.0, 1.0])


def drawn(values: dict[str, torch.Tensor], seen_by: Camera) -> torch.Tensor:
    splats = Splats(
        values["means"][None],
        values["quaternions"],
        values["scales_log"].exp(),
        values["opacity_logits"].sigmoid(),
        torch.cat([values["colour_logits"].sigmoid(), torch.ones(len(values["means"]), 1)], -1),
    )
    return render(splats, seen_by).image[0]


def starts(recording: Camera, picture: torch.Tensor) -> tuple[dict, dict]:
    """The sheet's values alone and those around it."""
    beyond = margins(recording)
    wide = recording.widened(*beyond)
    depth = backdrop_depth(wide, [body_points()], up=UP, margin=0.15)
    inner = depth[beyond[1] : -beyond[1], beyond[0] : -beyond[0]]
    points, scales, colours = median_backdrop(recording, picture, inner, stride=1, edge_points=0)
    sheet = gaussians_at(
        points, scales, opacity=0.97, semantic_logit=-2.0, rgb_srgb=colours, feature_dim=None
    )
    return sheet, surround(wide, picture, depth, -2.0, None)


@pytest.mark.parametrize("size", [(64, 48), (45, 70)])
def test_a_wall_of_one_colour_goes_on_where_a_camera_beside_looks_past_it(size):
    recording = camera(*size)
    rgb = torch.tensor([0.7, 0.4, 0.2])
    sheet, around = starts(recording, rgb.expand(size[1], size[0], 3))
    pose = recording.world_to_camera.clone()
    pose[0, 3] += 0.5
    beside = Camera(recording.width, recording.height, recording.K, pose)
    alone = drawn(sheet, beside)
    both = drawn({name: torch.cat([sheet[name], around[name]]) for name in sheet}, beside)
    assert float(alone[..., 3].min()) < 0.01
    assert float(both[..., 3].min()) > 0.9
    colours = both[..., :3] / both[..., 3:]
    assert torch.allclose(colours, rgb.expand_as(colours), atol=0.01)


@pytest.mark.parametrize("width", range(128, 192, 3))
def test_pictures_of_any_size_go_on_in_colours_of_their_rim(width):
    """Where the last cell is cut by the border, its middle was a place outside."""
    height = 132
    recording = camera(width, height)
    beyond = margins(recording)
    wide = recording.widened(*beyond)
    picture = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(width))
    picture = 0.1 + 0.8 * picture
    around = surround(wide, picture, torch.full((wide.height, wide.width), 4.0), -2.0, None)
    assert all(value.isfinite().all() for value in around.values())
    colours = around["colour_logits"].sigmoid()
    assert 0.1 <= colours.min() and colours.max() <= 0.9
    # A picture that brightens evenly from left to right goes on dark to the left and bright beyond.
    slope = torch.linspace(0.1, 0.9, width).expand(3, height, width).permute(1, 2, 0)
    around = surround(wide, slope, torch.full((wide.height, wide.width), 4.0), -2.0, None)
    x = recording.project(around["means"])[0][:, 0]
    shown = around["colour_logits"].sigmoid()[:, 0]
    assert shown[x < 0].max() < 0.5 < shown[x > width].min()


@pytest.mark.parametrize("seed", range(2))
def test_the_recorded_picture_stays_and_its_rim_is_what_goes_on(seed):
    recording = camera()
    coarse = torch.rand(1, 3, 6, 8, generator=torch.Generator().manual_seed(seed))
    picture = torch.nn.functional.interpolate(coarse, (48, 64), mode="bicubic")[0]
    picture = picture.permute(1, 2, 0).clamp(0.02, 0.98)
    sheet, around = starts(recording, picture)
    alone = drawn(sheet, recording)[..., :3]
    both = drawn({name: torch.cat([sheet[name], around[name]]) for name in sheet}, recording)
    assert float((both[..., :3] - alone).abs().mean()) < 0.01
    # Every colour lies between the rim's.
    shown = around["colour_logits"].sigmoid()
    assert bool((shown.amin(0) >= picture.amin((0, 1)) - 1e-3).all())
    assert bool((shown.amax(0) <= picture.amax((0, 1)) + 1e-3).all())
    pixels, _ = recording.project(around["means"])
    inside = ((pixels > 0) & (pixels < torch.tensor([64.0, 48.0]))).all(-1)
    assert not inside.any()
