"""Within the recorded picture colours are close to its own, and it looks as before."""

import pytest
import torch

from evsplat.camera import Camera
from evsplat.gaussians import GaussianSet
from evsplat.gaussians.initialise import gaussians_at, pixel_rays
from evsplat.models.discs.pictured import PRICE, pictured
from evsplat.models.discs.scene_pictures import ScenePictures

LOW_PASS = 0.1
CAMERA = Camera(32, 32, torch.tensor([[32.0, 0, 16], [0, 32, 16], [0, 0, 1]]), torch.eye(4))


def scene_of(points, scales, colours, *, opacity):
    scene = gaussians_at(
        points, scales, opacity=opacity, semantic_logit=-4.0, rgb_srgb=colours, feature_dim=None
    )
    return GaussianSet({name: value[:0] for name, value in scene.items()}, scene)


def speckled(seed):
    """A wall of a smooth picture, twice over: what one layer is too bright the other is too dark.

    Beside its Gaussians, their true colours.
    """
    generator = torch.Generator().manual_seed(seed)
    rays = pixel_rays(CAMERA)
    points = torch.cat([3.0 * rays.reshape(-1, 3), 3.3 * rays.reshape(-1, 3)])
    across = torch.linspace(0.3, 0.7, 32).expand(32, 32)
    true = torch.stack([across, across.T, 1 - across], -1).reshape(-1, 3).repeat(2, 1)
    noise = 0.2 * torch.rand(len(points) // 2, 3, generator=generator) - 0.1
    # A front of half the light leaves the other half to what is behind.
    colours = true + torch.cat([noise, -2 * noise])
    scales = (0.6 * points[:, 2:] / 32).repeat(1, 3)
    return scene_of(points, scales, colours, opacity=0.5), true


@pytest.mark.parametrize("seed", range(3))
def test_speckle_goes_and_the_picture_stays(seed):
    gaussians, true = speckled(seed)
    found = pictured(gaussians, CAMERA, LOW_PASS)
    pictures = ScenePictures(gaussians, [CAMERA], LOW_PASS)
    own, (before,) = pictures.colours, pictures.before
    changed = (pictures.draw(found[None], CAMERA) - before).square().mean()
    assert -10 * changed.log10() > 65
    assert (found - true).abs().mean() < 0.5 * (own - true).abs().mean()


@pytest.mark.parametrize("seed", range(3))
def test_they_are_the_least_squares_with_the_picture_s_own_colours(seed):
    """Against the normal equations of the whole matrix, channel by channel."""
    gaussians, _ = speckled(seed)
    pictures = ScenePictures(gaussians, [CAMERA], LOW_PASS)
    own, count = pictures.colours.double(), len(pictures.colours)
    inside = pictures.cells_beyond(CAMERA) < 0
    assert bool(inside.all())
    shares = torch.cat(
        [
            pictures.draw(torch.eye(count)[None, :, at : at + 256], CAMERA)[0].flatten(0, 1)
            for at in range(0, count, 256)
        ],
        -1,
    ).double()
    assert torch.allclose(
        shares @ own, pictures.before[0].flatten(0, 2).double().view(-1, 3), atol=1e-5
    )
    # Centres lie in the middles of pixels, each of which has two.
    told = pictures.before[0].reshape(-1, 3).double().repeat(2, 1)
    squares = shares.T @ shares + PRICE * torch.eye(count)
    best = torch.linalg.solve(squares, shares.T @ (shares @ own) + PRICE * told)

    def cost(colours):
        missed = (shares @ (colours - own)).square().sum()
        return float(missed + PRICE * (colours - told).square().sum())

    found = pictured(gaussians, CAMERA, LOW_PASS).double()
    assert cost(found) - cost(best) < 0.06 * (cost(own) - cost(best))


def test_what_is_outside_or_hidden_keeps_its_own():
    rays = pixel_rays(CAMERA)
    outside = 3 * torch.tensor([[0.7, 0, 1], [0, -0.8, 1], [0, 0, -1]])
    points = torch.cat([3 * rays.reshape(-1, 3), 5 * rays[8:24, 8:24].reshape(-1, 3), outside])
    colours = torch.rand(len(points), 3, generator=torch.Generator().manual_seed(0))
    scales = (0.8 * points[:, 2:].abs() / 32).repeat(1, 3)
    gaussians = scene_of(points, scales, colours, opacity=0.98)
    found = pictured(gaussians, CAMERA, LOW_PASS)
    own = ScenePictures(gaussians, [CAMERA], LOW_PASS).colours
    assert torch.equal(found[1024:], own[1024:])
    assert (found[:1024] != own[:1024]).any()
