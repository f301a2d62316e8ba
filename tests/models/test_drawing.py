"""Shadows in pictures: which part they darken, and where the scene's places are."""

from dataclasses import replace

import pytest
import torch

from evsplat.capture import load_capture
from evsplat.errors import ConfigError
from evsplat.models.drawing import _enlarge, draw, shadowed_scene
from evsplat.models.scene_places import places_of
from evsplat.render import LOW_PASS, Splats, render

from ..small_model import built, small_config


@pytest.fixture
def shadowed(tiny_capture):
    """A model with shadows, its layers at two times, and the camera."""
    capture = load_capture(tiny_capture())
    model = built("evsplat", capture, "lamps=2").model
    camera = capture.camera(capture.train_frames[0])
    times = [frame.mid_us for frame in capture.train_frames[:2]]
    return model, model.at(times, camera.center()), camera


@pytest.mark.parametrize("low_pass", [0.3, 0.1])
def test_pictures_have_the_low_pass_of_the_model(tiny_capture, low_pass):
    capture = load_capture(tiny_capture())
    model = built("evsplat", capture, "lamps=0", f"low_pass={low_pass}").model
    frame = capture.train_frames[0]
    camera = capture.camera(frame)
    with torch.no_grad():
        layers = model.at([frame.mid_us], camera.center())
        drawn = draw(layers, camera).output.image
        wanted, other = (
            render(layers.human, camera, static=layers.scene, low_pass=px2).image
            for px2 in (low_pass, 0.2)
        )
    assert torch.equal(drawn, wanted) and not torch.allclose(drawn, other, atol=1e-3)


@pytest.mark.parametrize("method", ["avatar3dgs", "avatar3dgs_semantic", "hugs", "paper"])
def test_other_methods_have_the_low_pass_of_3dgs(tiny_capture, method):
    capture = load_capture(tiny_capture())
    model = built(method, capture).model
    frame = capture.train_frames[0]
    layers = model.at([frame.mid_us], capture.camera(frame).center(), hard_semantics=True)
    assert model.low_pass == layers.low_pass == LOW_PASS == 0.3


def test_a_low_pass_wider_than_the_usual_is_refused():
    with pytest.raises(ConfigError, match="low_pass is 0.4; expected a number above 0 and .* 0.3"):
        small_config("evsplat", "low_pass=0.4")


def test_without_any_share_of_the_light_nothing_changes(shadowed):
    model, layers, camera = shadowed
    with torch.no_grad():
        model.shadow.share_logits.fill_(-50.0)
        dark = draw(layers, camera)
        plain = render(layers.human, camera, static=layers.scene, low_pass=layers.low_pass)
    for time in range(2):
        assert torch.allclose(dark.rgb[time], plain.image[time, ..., :3], atol=2e-6)
        assert torch.allclose(dark.semantic[time], plain.image[time, ..., 3], atol=2e-6)
    assert torch.equal(dark.output.radii, plain.radii)


def darker(scene: Splats, factor: float) -> Splats:
    """The scene with its colours times ``factor``."""
    rgb, semantic = scene.channels.split((3, 1), -1)
    return replace(scene, channels=torch.cat([factor * rgb, semantic], -1))


def test_a_shadow_darkens_the_scene_and_leaves_the_person(shadowed):
    _, layers, camera = shadowed
    factors = torch.tensor([0.25, 0.75])[:, None, None]
    layers = replace(layers, shadow=lambda places: factors.expand(-1, *places.shape[:2]))
    with torch.no_grad():
        drawn = draw(layers, camera)
        files = shadowed_scene(layers)
        for time, factor in enumerate((0.25, 0.75)):
            scene = darker(layers.scene, factor)
            want = render(layers.human, camera, static=scene, low_pass=layers.low_pass).image[time]
            assert torch.allclose(drawn.rgb[time], want[..., :3], atol=2e-6)
            assert torch.allclose(drawn.semantic[time], want[..., 3], atol=2e-6)
            # For files each Gaussian has the shadow in its colour.
            assert torch.allclose(files.channels[time], scene.channels[0])


def test_a_picture_does_not_depend_on_who_stands_where_in_the_one_before(shadowed):
    model, _, camera = shadowed
    times = [0, 40_000]
    with torch.no_grad():
        model.shadow.share_logits.fill_(1.0)
        together = draw(model.at(times, camera.center()), camera).rgb
        for time, picture in zip(times, together, strict=True):
            alone = draw(model.at([time], camera.center()), camera).rgb[0]
            assert (picture - alone).abs().max() < 1e-5


def test_places_of_a_slanted_plane_are_on_it(shadowed):
    _, _, camera = shadowed
    turn = torch.linalg.qr(torch.randn(3, 3))[0]
    turn = turn * torch.linalg.det(turn)
    pose = torch.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, torch.randn(3)
    camera = replace(camera, world_to_camera=pose)
    # n . X = d in camera coordinates, seen at pixel centres.
    normal, distance = torch.tensor([0.1, -0.2, 1.0]), 3.0
    y, x = torch.meshgrid(
        torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij"
    )
    K = camera.K
    rays = torch.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones_like(x)], -1)
    z = distance / (rays @ normal)
    share = torch.rand_like(z) * 0.01 + 0.5
    places = places_of(torch.stack([z * share, share], -1), camera, 2)
    local = places @ turn.T + pose[:3, 3]
    # The mean over two by two pixels is the depth in their middle, up to the plane's curvature.
    assert (local @ normal - distance).abs().max() < 0.01
    back, _ = camera.project(places.reshape(-1, 3))
    assert torch.allclose(back[0], torch.tensor([1.0, 1.0]), atol=1e-3)


@pytest.mark.parametrize(("size", "step"), [((7, 9), 2), ((8, 10), 2), ((5, 11), 3), ((4, 6), 1)])
def test_the_compiled_enlargement_is_torchs_and_so_is_its_gradient(shadowed, size, step):
    camera = replace(shadowed[2], height=size[0], width=size[1])
    small = torch.rand(3, -(-size[0] // step), -(-size[1] // step))
    results = []
    for dtype in (torch.float32, torch.float64):
        leaf = small.to(dtype, copy=True).requires_grad_()
        large = _enlarge(leaf, camera, step)
        weights = torch.arange(large.numel(), dtype=dtype).view(large.shape).cos()
        results.append((large, *torch.autograd.grad((large * weights).sum(), leaf)))
    for compiled, plain in zip(*results, strict=True):
        assert compiled.shape == plain.shape and (compiled - plain).abs().max() < 2e-6


def test_lights_get_a_gradient_from_the_picture(shadowed):
    model, layers, camera = shadowed
    torch.stack(draw(layers, camera).rgb).sum().backward()
    for part in (model.shadow, model.lamps):
        for name, parameter in part.named_parameters():
            if not name.startswith("own"):  # of shadows on the person, which is not lit yet
                assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name
