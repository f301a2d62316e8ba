"""Starts: the backdrop must look like the median before any fit, the cube must be a cube."""

import pytest
import torch

from evsplat.body.rotations import quaternion_to_matrix
from evsplat.capture import Camera
from evsplat.gaussians.initialise import (
    backdrop_depth,
    extremes,
    facing,
    gaussians_at,
    median_backdrop,
    nearest_spacing,
    random_cube,
)
from evsplat.render import Splats, render


def camera(width: int = 64, height: int = 48) -> Camera:
    """At 1.5 m above the floor z = 0, looking along +y, slightly down."""
    tilt = torch.tensor(0.15)
    forward = torch.stack([torch.tensor(0.0), tilt.cos(), -tilt.sin()])
    right = torch.tensor([1.0, 0.0, 0.0])
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    pose = torch.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ torch.tensor([0.0, 0.0, 1.5])
    K = torch.tensor([[60.0, 0.0, width / 2], [0.0, 60.0, height / 2], [0.0, 0.0, 1.0]])
    return Camera(width, height, K, pose)


def body_points() -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    box = torch.rand(3_000, 3, generator=generator)
    return torch.tensor([-0.4, 3.0, 0.0]) + box * torch.tensor([0.8, 0.8, 1.8])


def test_backdrop_is_a_floor_below_the_feet_and_a_wall_behind():
    depth = backdrop_depth(camera(), [body_points()], up=torch.tensor([0.0, 0.0, 1.0]), margin=0.15)
    _, behind = camera().project(body_points())
    wall = float(behind.max()) * 1.15
    assert float(depth.max()) == pytest.approx(wall, rel=1e-5)
    assert torch.allclose(depth[0], torch.tensor(wall))
    # The lowest row looks steeply at the floor: follow the ray by hand.
    tilt, below = 0.15, torch.atan(torch.tensor((47.5 - 24) / 60))
    along = 1.5 / torch.sin(below + tilt) * torch.cos(below)
    assert float(depth[-1, 32]) == pytest.approx(float(along), rel=0.02)


@pytest.mark.parametrize("kept", [200_000, 7])
def test_a_backdrop_is_the_same_by_pieces_of_any_size(kept, monkeypatch):
    monkeypatch.setattr("evsplat.gaussians.initialise._MOST_LOW", kept)
    up, points = torch.tensor([0.0, 0.0, 1.0]), body_points()
    deepest, floor = extremes(camera(), points.split(41), up)
    assert deepest == float(camera().project(points)[1].max())
    assert floor == pytest.approx(float(torch.quantile(points @ up, 0.002)), rel=1e-6)


@pytest.mark.parametrize("seed", range(2))
def test_backdrop_looks_like_the_median_from_the_camera_before_any_fit(seed):
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 3, 6, 8, generator=generator)
    picture = torch.nn.functional.interpolate(coarse, (48, 64), mode="bilinear")[0].permute(1, 2, 0)
    depth = backdrop_depth(camera(), [body_points()], up=torch.tensor([0.0, 0.0, 1.0]), margin=0.15)
    points, scales, colours = median_backdrop(camera(), picture, depth, stride=2, edge_points=500)
    values = gaussians_at(
        points, scales, opacity=0.9, semantic_logit=-2.0, rgb_srgb=colours, feature_dim=None
    )
    shown = torch.sigmoid(values["colour_logits"])
    assert torch.allclose(shown, colours.clamp(0.01, 0.99), atol=1e-5)
    drawn = render(
        Splats(points[None], values["quaternions"], scales, torch.full((len(points),), 0.9), shown),
        camera(),
    )
    error = (drawn.image[0] - picture)[2:-2, 2:-2].abs()
    assert float(error.mean()) < 0.03


@pytest.mark.parametrize("feature_dim", [32, None])
def test_a_colour_is_told_to_networks_or_is_the_gaussians_own(feature_dim):
    points, rgb = torch.randn(5, 3), 0.1 + 0.8 * torch.rand(5, 3)
    given, grey = (
        gaussians_at(
            points,
            torch.ones(5, 3),
            opacity=0.5,
            semantic_logit=1.0,
            rgb_srgb=colours,
            feature_dim=feature_dim,
        )
        for colours in (rgb, None)
    )
    assert ("features" in given, "colour_logits" in given) == (bool(feature_dim), not feature_dim)
    name = "features" if feature_dim else "colour_logits"
    assert given[name].shape == (5, feature_dim or 3)
    assert torch.allclose(given[name][:, :3].sigmoid(), rgb, atol=1e-6)
    assert not given[name][:, 3:].any() and not grey[name].any()


def test_cube_is_uniform_and_spacing_is_that_of_a_lattice():
    center = torch.tensor([1.0, 2.0, 3.0])
    points, colours = random_cube(center, 2.0, 20_000, torch.Generator().manual_seed(0))
    assert float((points - center).abs().max()) <= 2.0
    assert torch.allclose(points.mean(0), center, atol=0.05)
    assert torch.allclose(points.std(0), torch.full((3,), 2.0 / 3**0.5), atol=0.02)
    assert 0 <= float(colours.min()) and float(colours.max()) <= 1
    lattice = torch.cartesian_prod(*(torch.arange(6.0) * 0.1 for _ in range(3)))
    assert torch.allclose(nearest_spacing(lattice), torch.full((216,), 0.1), atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_facing_turns_the_third_axis_to_the_normal_the_short_way(seed):
    generator = torch.Generator().manual_seed(seed)
    normals = torch.nn.functional.normalize(torch.randn(500, 3, generator=generator), dim=-1)
    poles = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    normals = torch.cat([normals, poles])
    rotations = quaternion_to_matrix(facing(normals))
    assert torch.allclose(rotations[..., 2], normals, atol=1e-5)
    # By no more than the angle between both: the trace is 1 + 2 cos of the angle turned.
    turned = (rotations.diagonal(dim1=1, dim2=2).sum(-1) - 1) / 2
    assert torch.allclose(turned, normals[:, 2], atol=1e-4)
