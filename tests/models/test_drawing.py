"""Shadows in pictures: which part they darken, and where the scene's places are."""

from dataclasses import replace

import pytest
import torch

from evsplat.capture import load_capture
from evsplat.config import override
from evsplat.models.drawing import _places, draw
from evsplat.errors import ConfigError
from evsplat.methods import compose, method_config
from evsplat.render import render

from ..seen import seen

SMALL = ("human.count=150", "deform.width=16", "deform.colour_width=16", "deform.shadow_lights=2")


@pytest.fixture
def posed(tiny_capture):
    """A model with shadows, posed at two times, and the camera."""
    capture = load_capture(tiny_capture())
    config = method_config("paper", override({}, SMALL), where="test")
    model = compose(config, seen(capture), 0, fit=False).model
    camera = capture.camera(capture.train_frames[0])
    times = [frame.mid_us for frame in capture.train_frames[:2]]
    return model, model.at(times, camera.center()), camera


@pytest.mark.parametrize("low_pass", [0.3, 0.1])
def test_pictures_have_the_low_pass_of_the_model(tiny_capture, low_pass):
    capture = load_capture(tiny_capture())
    settings = override({}, ("human.count=150", f"deform.low_pass={low_pass}"))
    config = method_config("paper", settings, where="test")
    model = compose(config, seen(capture), 0, fit=False).model
    frame = capture.train_frames[0]
    camera = capture.camera(frame)
    with torch.no_grad():
        posed = model.at([frame.mid_us], camera.center())
        drawn = draw(model, posed, camera).output.image
        layers = posed.moving(), posed.static()
        wanted, other = (
            render(layers[0], camera, static=layers[1], low_pass=px2).image
            for px2 in (low_pass, 0.2)
        )
    assert torch.equal(drawn, wanted) and not torch.allclose(drawn, other, atol=1e-3)


def test_a_low_pass_wider_than_the_usual_is_refused(tiny_capture):
    config = method_config("paper", override({}, ("deform.low_pass=0.4",)), where="test")
    with pytest.raises(ConfigError, match="low_pass is 0.4; it takes px.2 above 0 and up to 0.3"):
        compose(config, seen(tiny_capture()), 0, fit=False)


def test_without_any_share_of_the_light_nothing_changes(posed):
    model, gaussians, camera = posed
    with torch.no_grad():
        model.shadow.share_logits.fill_(-50.0)
        dark = draw(model, gaussians, camera)
        plain = render(gaussians.moving(), camera, static=gaussians.static())
    for time in range(2):
        assert torch.allclose(dark.rgb[time], plain.image[time, ..., :3], atol=2e-6)
        assert torch.allclose(dark.semantic[time], plain.image[time, ..., 3], atol=2e-6)
    assert torch.equal(dark.output.radii, plain.radii)


def test_a_shadow_darkens_the_scene_and_leaves_the_person(posed, monkeypatch):
    model, gaussians, camera = posed
    factors = torch.tensor([0.25, 0.75])[:, None, None]
    monkeypatch.setattr(
        model.shadow, "forward", lambda body, places, lamps: factors.expand(-1, *places.shape[:2])
    )
    with torch.no_grad():
        drawn = draw(model, gaussians, camera)
        for time, factor in enumerate((0.25, 0.75)):
            scene = replace(gaussians.scene, rgb=factor * gaussians.scene.rgb)
            darker = replace(gaussians, scene=scene)
            want = render(darker.moving(), camera, static=darker.static()).image[time, ..., :3]
            assert torch.allclose(drawn.rgb[time], want, atol=2e-6)


def test_places_of_a_slanted_plane_are_on_it(posed):
    _, _, camera = posed
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
    places = _places(torch.stack([z * share, share], -1), camera, 2)
    local = places @ turn.T + pose[:3, 3]
    # The mean over two by two pixels is the depth in their middle, up to the plane's curvature.
    assert (local @ normal - distance).abs().max() < 0.01
    back, _ = camera.project(places.reshape(-1, 3))
    assert torch.allclose(back[0], torch.tensor([1.0, 1.0]), atol=1e-3)


def test_lights_get_a_gradient_from_the_picture(posed):
    model, gaussians, camera = posed
    torch.stack(draw(model, gaussians, camera).rgb).sum().backward()
    for name, parameter in model.shadow.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name
