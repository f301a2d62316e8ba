"""A scene that was trained before black looks nearly the same before any grey."""

from dataclasses import replace

import pytest
import torch
from torch.nn.functional import max_pool2d

from evsplat.camera import Camera
from evsplat.gaussians import GaussianSet
from evsplat.gaussians.initialise import gaussians_at, pixel_rays
from evsplat.models.discs.solid import solid
from evsplat.models.discs.still import Still
from evsplat.models.layers import Layers
from evsplat.models.solid_scene import SolidScene
from evsplat.render import Splats, render

LOW_PASS = 0.1
CAMERA = Camera(32, 32, torch.tensor([[32.0, 0, 16], [0, 32, 16], [0, 0, 1]]), torch.eye(4))
GREYS = (0.0, 0.3, 1.0)


def leaky(seed):
    """A wall of uneven opacities, and two Gaussians beside the picture."""
    generator = torch.Generator().manual_seed(seed)
    rays = pixel_rays(CAMERA)
    points = torch.cat([3.0 * rays.reshape(-1, 3), 3 * torch.tensor([[0.9, 0, 1], [0, -0.9, 1]])])
    colours = 0.2 + 0.6 * torch.rand(len(points), 3, generator=generator)
    scales = (0.5 * points[:, 2:] / 32).repeat(1, 3)
    scene = gaussians_at(
        points, scales, opacity=0.8, semantic_logit=-4.0, rgb_srgb=colours, feature_dim=None
    )
    scene["opacity_logits"] += torch.randn(len(points), generator=generator)
    return GaussianSet({name: value[:0] for name, value in scene.items()}, scene)


@torch.no_grad()
def drawn(scene, grey, camera=CAMERA):
    """By the reference rasteriser, which the fit does not use."""
    scene = replace(scene, channels=scene.channels[..., :3])
    behind = torch.full((3,), grey)
    return render(scene, camera, background=behind, low_pass=LOW_PASS, backend="reference")


def psnr(picture, other):
    return float(-10 * (picture - other).square().mean().log10())


def layers_of(gaussians):
    with torch.no_grad():
        still = Still.of(gaussians, None, hard_semantics=True)
    person = Splats(still.means[None], still.quaternions, still.scales, still.opacities, still.rgb)
    return Layers(person, still.scene, torch.empty(1, 0, 4, 4))


@pytest.mark.parametrize("seed", range(3))
def test_before_any_grey_it_looks_as_before_black(seed):
    gaussians = leaky(seed)
    learned = layers_of(gaussians)
    colours = learned.scene.channels[0, :, :3]
    made = solid(gaussians, [CAMERA], LOW_PASS, colours).stand_for(learned, CAMERA)
    wanted = drawn(learned.scene, 0.0).image
    before = [psnr(drawn(learned.scene, grey).image, wanted) for grey in GREYS]
    after = [psnr(drawn(made.scene, grey).image, wanted) for grey in GREYS]
    assert before[1] < 31 and before[2] < 21
    assert after[0] > 47 and after[1] > 36 and after[2] > 27
    through = [1 - float(drawn(layers.scene, 0.0).alpha.mean()) for layers in (learned, made)]
    assert through[1] < through[0] / 3
    # What the picture does not tell of stays, and all stay where they are.
    assert torch.equal(made.scene.means, learned.scene.means)
    for name in ("quaternions", "scales", "opacities"):
        kept, own = (getattr(layers.scene, name)[-2:] for layers in (made, learned))
        torch.testing.assert_close(kept, own)
    torch.testing.assert_close(made.scene.channels[:, -2:], learned.scene.channels[:, -2:])


@pytest.mark.parametrize("seed", range(3))
def test_of_several_cameras_each_sees_it_so_but_for_holes(seed):
    gaussians = leaky(seed)
    learned = layers_of(gaussians)
    pose = CAMERA.world_to_camera.clone()
    pose[0, 3] = 0.2
    cameras = [CAMERA, replace(CAMERA, world_to_camera=pose)]
    made = solid(gaussians, cameras, LOW_PASS, learned.scene.channels[0, :, :3])
    scene = made.stand_for(learned, CAMERA).scene
    for camera in cameras:
        before, after = drawn(learned.scene, 0.0, camera), drawn(scene, 1.0, camera)
        hole = before.alpha < 0.1
        assert bool(hole.any()) == (camera is not CAMERA)
        solid_there = max_pool2d(hole.float(), 5, 1, 2) == 0
        leaks = drawn(learned.scene, 1.0, camera).image
        assert psnr(leaks[solid_there], before.image[solid_there]) < 21
        assert psnr(after.image[solid_there], before.image[solid_there]) > 27
        assert not hole.any() or float(after.alpha[hole].mean()) < 0.15


def test_what_a_file_holds_is_checked():
    tensors = vars(solid(leaky(0), [CAMERA], LOW_PASS, torch.full((1026, 3), 0.5)))
    device = torch.device("cpu")
    read = SolidScene.of(tensors, 1026, device)
    assert read is not None and torch.equal(read.rgb, tensors["rgb"])
    assert SolidScene.of({}, 1026, device) is None
    with pytest.raises(ValueError, match="1025 Gaussians"):
        SolidScene.of(tensors, 1025, device)
    spoilt = tensors | {"scales": torch.full_like(tensors["scales"], torch.nan)}
    with pytest.raises(ValueError, match="not finite"):
        SolidScene.of(spoilt, 1026, device)
