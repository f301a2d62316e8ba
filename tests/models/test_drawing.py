"""Pictures of one camera or several, and shadows in them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from evsplat.capture import load_capture
from evsplat.errors import ConfigError
from evsplat.models.drawing import (
    _enlarge,
    draw,
    draw_depth,
    draw_for_training,
    shadowed_scene,
)
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


def moved(camera, seed: int):
    """A camera a little beside another one."""
    rng = np.random.default_rng(seed)
    turn = torch.from_numpy(Rotation.from_rotvec(0.03 * rng.normal(size=3)).as_matrix()).float()
    pose = torch.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, torch.from_numpy(0.05 * rng.normal(size=3)).float()
    return replace(camera, world_to_camera=pose @ camera.world_to_camera)


@pytest.mark.parametrize("seed", range(3))
def test_each_time_of_a_step_is_drawn_from_its_own_camera(shadowed, seed):
    _, layers, camera = shadowed
    cameras = [camera, moved(camera, seed)]
    drawn = draw_for_training(layers, cameras)
    for time, (each, picture) in enumerate(zip(cameras, drawn.rgb, strict=True)):
        alone = draw(layers, each)
        assert torch.allclose(picture, alone.rgb[time], atol=2e-6)
        assert torch.allclose(drawn.semantic[time], alone.semantic[time], atol=2e-6)
        assert torch.equal(drawn.output.radii[time], alone.output.radii[time])
    both = torch.stack([draw(layers, each).output.static_radii for each in cameras])
    assert torch.equal(drawn.output.static_radii, both.amax(0))
    assert (drawn.rgb[1] - draw(layers, camera).rgb[1]).abs().max() > 0.01


@pytest.mark.parametrize("seed", range(2))
def test_its_gradients_are_those_of_the_times_drawn_one_by_one(shadowed, seed):
    model, layers, camera = shadowed
    cameras = [camera, moved(camera, seed)]
    wanted = [name for name, _ in model.gaussians.named_parameters() if "feature" not in name]
    weights = [torch.randn(camera.height, camera.width, 3) for _ in cameras]

    def gradients(pictures):
        loss = sum((w * p).sum() for w, p in zip(weights, pictures, strict=True))
        parameters = [model.gaussians.get_parameter(name) for name in wanted]
        return torch.autograd.grad(loss, parameters, retain_graph=True)

    alone = [draw(layers, each).rgb[time] for time, each in enumerate(cameras)]
    drawn = draw_for_training(layers, cameras)
    for one, other in zip(gradients(drawn.rgb), gradients(alone), strict=True):
        assert torch.allclose(one, other, rtol=1e-3, atol=1e-5 * float(other.abs().max()))
    sum((w * p).sum() for w, p in zip(weights, drawn.rgb, strict=True)).backward()
    human, scene = drawn.center_gradients()
    assert human.shape[0] == 2 and scene.shape[0] == 1
    assert human.abs().sum() > 0 and scene.abs().sum() > 0


def test_of_a_camera_at_rest_the_pictures_are_bit_for_bit_those_of_one(shadowed):
    _, layers, camera = shadowed
    drawn, one = draw_for_training(layers, [camera, camera]), draw(layers, camera)
    assert torch.equal(drawn.output.image, one.output.image)


@pytest.mark.parametrize("seed", range(3))
def test_a_point_of_the_scene_moves_in_the_pictures_as_the_camera_does(shadowed, seed):
    _, layers, camera = shadowed
    cameras = [camera, moved(camera, seed)]
    place = torch.linalg.inv(camera.world_to_camera) @ torch.tensor([0.1, -0.1, 4.0, 1.0])
    point = Splats(
        place[None, None, :3],
        torch.tensor([[[1.0, 0, 0, 0]]]),
        torch.full((1, 1, 3), 0.1),
        torch.full((1, 1), 0.9),
        torch.ones(1, 1, 4),
    )
    nobody = replace(layers.human, opacities=torch.zeros_like(layers.human.opacities))
    layers = replace(layers, human=nobody, scene=point, shadow=None, shaded=None)
    for each, picture in zip(cameras, draw_for_training(layers, cameras).rgb, strict=True):
        light = picture.detach()[..., 0]
        y, x = torch.meshgrid(
            torch.arange(each.height) + 0.5, torch.arange(each.width) + 0.5, indexing="ij"
        )
        found = torch.stack([(x * light).sum(), (y * light).sum()]) / light.sum()
        assert (found - each.project(place[:3])[0]).abs().max() < 0.05
    ways = [each.project(place[:3])[0] for each in cameras]
    assert (ways[1] - ways[0]).norm() > 0.2


def large(depth_m: float, opacity: float, camera) -> Splats:
    """A Gaussian on the camera's axis that fills its picture."""
    pose = camera.world_to_camera
    means = (torch.tensor([0.0, 0.0, depth_m]) - pose[:3, 3]) @ pose[:3, :3]
    return Splats(
        means=means[None, None],
        quaternions=torch.tensor([[[1.0, 0, 0, 0]]]),
        scales=torch.full((1, 1, 3), 50.0),
        opacities=torch.tensor([[opacity]]),
        channels=torch.rand(1, 1, 4),
    )


def test_depth_is_the_mean_of_what_is_shown_however_little_covers_the_pixel(shadowed):
    _, layers, camera = shadowed
    person, wall = large(2.0, 0.4, camera), large(5.0, 0.5, camera)
    layers = replace(layers, human=person, scene=wall)
    middle = camera.height // 2, camera.width // 2
    shares = 0.4, 0.6 * 0.5
    both = (2 * shares[0] + 5 * shares[1]) / sum(shares)
    for parts, expected in (("human", 2.0), ("scene", 5.0), ("all", both)):
        found = draw_depth(layers, camera, parts=parts)
        assert float(found[0][middle]) == pytest.approx(expected, rel=1e-3), parts
    nothing = replace(layers, human=large(2.0, 0.0, camera))
    assert not draw_depth(nothing, camera, parts="human").any()
