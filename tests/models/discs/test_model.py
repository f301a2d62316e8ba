"""The disc model put together: who carries a disc, what lights it, and where gradients reach."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from evsplat.body import skin
from evsplat.capture import load_capture
from evsplat.models.pose_correction import PoseCorrection
from evsplat.training.clock import Clock
from evsplat.training.trainer import Trainer

from ...seen import seen
from ...small_model import built
from ..wild_poses import assert_posed, bend

ERRING = "pose.refine=always"
"""Poses that are not exact: the shape changes in time."""


def model_of(path, *settings: str):
    """Model, capture, the times of two frames and a camera centre."""
    capture = load_capture(path)
    lamps = () if any(each.startswith("lamps=") for each in settings) else ("lamps=2",)
    model = built("evsplat", capture, *lamps, *settings).model
    times = [frame.mid_us for frame in capture.train_frames[:2]]
    return model, capture, times, capture.camera(capture.train_frames[0]).center()


def activate(model) -> None:
    """Past the start of every part, with shades and light that can be seen."""
    model.nominal.fill_(10_000.0)
    with torch.no_grad():
        model.shade.network.weights[-1].normal_(std=0.5)
        model.gaussians.colour_logits.normal_()
        if model.shading is not None:
            model.shading.coefficients.normal_(std=0.03)
            model.shading.intensities.uniform_(0.2, 1.0)
        if model.residual is not None:
            for values in model.residual.parameters():
                values.normal_(std=0.1)
        if model.deformation is not None:
            model.deformation.handles.normal_()


def fields(splats) -> dict[str, torch.Tensor]:
    names = ("means", "quaternions", "scales", "channels", "linear")
    return {name: value for name in names if (value := getattr(splats, name)) is not None}


def nearest_weights(model) -> torch.Tensor:
    """The body's weights at the point of its surface that is nearest to each of the person's."""
    canonical = model.gaussians.means[model.gaussians.human].detach()
    samples = model.surface.surface
    return samples.weights[torch.cdist(canonical, samples.points).argmin(1)]


def deformed(model, times) -> torch.Tensor:
    """Canonical centres at given times."""
    canonical = model.gaussians.means[model.gaussians.human].detach()
    if model.deformation is None:
        return canonical[None]
    return canonical + model.deformation(model.surface.at(canonical), times).detach()


def test_a_disc_is_fifteen_floats(tiny_capture):
    gaussians = model_of(tiny_capture())[0].gaussians
    rows = [getattr(gaussians, name)[0].numel() for name in gaussians.attributes]
    assert sum(rows) == 15
    assert {name for name, _ in gaussians.named_parameters()} == set(gaussians.attributes)


@pytest.mark.parametrize("erring", [False, True])
def test_a_disc_on_the_body_has_its_own_colour_and_the_shade_of_the_pose(tiny_capture, erring):
    given = (ERRING,) if erring else ()
    model, _, times, center = model_of(tiny_capture(), "shading=false", *given)
    torch.manual_seed(int(erring))
    activate(model)
    gaussians = model.gaussians
    layers = model.at(times, center)
    canonical = gaussians.means[gaussians.human].detach()
    weights = nearest_weights(model)
    rotations, bones = model.pose(times)
    expected, _ = skin(deformed(model, times), weights, bones)
    assert torch.allclose(layers.human.means, expected, atol=1e-5)
    assert torch.equal(layers.human.scales[0], gaussians.scales_log.exp()[gaussians.human])
    assert torch.equal(layers.human.quaternions[0], gaussians.quaternions[gaussians.human])
    # Wherever the rows have been moved to, they are drawn with the weights they have.
    assert torch.equal(model.skinning_weights(canonical + 0.3), weights)
    colours = gaussians.colour_logits[gaussians.human].sigmoid() * model.shade(canonical, rotations)
    assert torch.allclose(layers.human.channels[..., :3], colours, atol=1e-6)
    colours = gaussians.colour_logits.sigmoid()[gaussians.scene]
    assert torch.equal(layers.scene.channels[0, :, :3], colours)
    assert torch.equal(layers.scene.means[0], gaussians.means[gaussians.scene])
    names = {name.partition(".")[0] for name, _ in model.named_parameters()}
    always = {"gaussians", "shade", "residual", "lamps", "shadow", "sensor", "relief"}
    assert names == always | ({"deformation"} if erring else set())


def test_the_person_is_blend_skinned_and_has_no_shade_before_more_starts(tiny_capture):
    model, _, times, center = model_of(tiny_capture(), "shading=false")
    activate(model)
    model.nominal.fill_(1_499.0)
    layers = model.at(times, center)
    canonical = model.gaussians.means[model.gaussians.human]
    expected, transforms = skin(canonical[None], nearest_weights(model), model.pose(times)[1])
    assert torch.allclose(layers.human.means, expected, atol=1e-6)
    assert torch.allclose(layers.transforms, transforms, atol=1e-6)
    assert torch.equal(layers.human.linear, layers.transforms[..., :3, :3])
    colours = model.gaussians.colour_logits[model.gaussians.human].sigmoid()
    assert torch.equal(layers.human.channels[..., :3], colours.expand(len(times), -1, -1))


def test_shape_that_times_give_belongs_to_no_other_motion(tiny_capture):
    model, _, times, center = model_of(tiny_capture(), "shading=false", ERRING)
    activate(model)
    other = model.following(model.track)
    expected, _ = skin(
        model.gaussians.means[model.gaussians.human][None],
        nearest_weights(model),
        model.track.bones(times),
    )
    assert torch.allclose(other.at(times, center).human.means, expected, atol=1e-5)
    assert not torch.allclose(model.at(times, center).human.means, expected, atol=1e-3)


def test_what_reaches_off_the_body_does_so_in_recorded_poses_alone(tiny_capture):
    model, _, times, center = model_of(tiny_capture())
    rows = model.gaussians.human
    with torch.no_grad():
        model.gaussians.scales_log[rows] = math.log(0.001)
        model.gaussians.scales_log[rows][3] = math.log(0.3)
    moving = model.following(model.track)
    moving.stay_together()
    recorded, new = (each.at(times, center).human.scales[0].detach() for each in (model, moving))
    assert torch.allclose(recorded[3], torch.tensor(0.3))
    assert float(new[3].max()) < 0.5 * 0.3
    others = torch.arange(len(new)) != 3
    assert torch.equal(new[others], recorded[others])


def test_times_do_not_see_each_other(tiny_capture):
    model, _, times, center = model_of(tiny_capture())
    activate(model)
    together = model.at(times, center)
    places = together.scene.means + 0.1
    shadows = together.shadow(places).detach()
    assert float(shadows.min()) < 0.99 and not torch.allclose(shadows[0], shadows[1], atol=1e-3)
    for index, time in enumerate(times):
        alone = model.at([time], center)
        others = fields(alone.human)
        for name, both in fields(together.human).items():
            own = both[index % len(both)]  # sizes and turns are the same at all times
            assert torch.allclose(own, others[name][0], atol=1e-5), name
        assert torch.allclose(together.transforms[index], alone.transforms[0], atol=1e-5)
        assert torch.allclose(shadows[index], alone.shadow(places)[0], atol=1e-5)


def test_nothing_depends_on_the_camera(tiny_capture):
    model, _, times, center = model_of(tiny_capture())
    activate(model)
    here, there = (model.at(times, place) for place in (center, center + torch.randn(3)))
    for one, other in ((here.human, there.human), (here.scene, there.scene)):
        others = fields(other)
        for name, value in fields(one).items():
            assert torch.equal(value, others[name]), name


def test_every_parameter_gets_a_gradient(tiny_capture, monkeypatch):
    """Of one training step with all that the method can learn; the prior keeps the residual."""
    capture = load_capture(tiny_capture())
    settings = ("pose.refine=always", "pose.smooth=always", "clock=always", "most_renders=3")
    # Errors so small that they do not explain all that the poses' spline misses between keys.
    small = ("pose.std_rad=0.002", "pose.std_m=0.002")
    composition = built("evsplat", capture, "lamps=2", *settings, *small, purpose="train")
    trainer = Trainer(composition, seen(capture), Clock(100, fraction=0.5))
    activate(trainer.model)
    trainer.previous_nominal = trainer.clock.nominal  # no new rows in this step
    monkeypatch.setattr(trainer.optimiser, "step", lambda *_: None)
    assert trainer.step() is not None
    learned = {name: p for name, p in trainer.model.named_parameters() if p.numel()}
    assert {"sensor.logs", "sensor.offset", "shadow.own_widths_log"} <= set(learned)
    silent = [name for name, p in learned.items() if p.grad is None or not p.grad.any()]
    assert silent == []
    rates = {id(p) for network in composition.learning.networks for p in network.parameters}
    rows = {f"gaussians.{name}" for name in composition.learning.rows["gaussians"]}
    assert {name for name, p in learned.items() if id(p) not in rates} == rows


@pytest.mark.parametrize("seed", range(2))
def test_what_the_body_hides_from_a_lamp_is_darker(tiny_capture, seed):
    model, capture, _, _ = model_of(tiny_capture())
    torch.manual_seed(seed)
    frames = capture.train_frames[:3]
    times, center = [frame.mid_us for frame in frames], torch.tensor([0.3, -2.0, 1.2])
    with torch.no_grad():
        dark = model.at(times, center).human.channels[..., :3]
        model.shading.intensities.copy_(0.2 + torch.rand(2, 3))
        lit = model.at(times, center)
        lamps = model.lamps.places()
        casters = model.shadow.place(model.pose(times)[1])
        shares = model.shadow.lit(casters, lit.human.means, lamps)
        light = model.surface_light()
        expected = light.factors(lit.transforms, lit.human.means, shares)
        assert torch.allclose(lit.human.channels[..., :3], dark * expected, atol=1e-5)
        assert (expected < light.factors(lit.transforms, lit.human.means) - 0.01).any()
        # A training step looks for shadows on the person at its middle alone.
        expected = light.factors(lit.transforms, lit.human.means, shares[:, 1:2])
        cameras, generator = (
            [capture.camera(frames[1])] * len(times),
            torch.Generator().manual_seed(0),
        )
        step = model.training_drawing(times, frames[1], cameras, generator).layers
    assert torch.allclose(step.human.channels[..., :3], dark * expected, atol=1e-5)


def test_the_person_does_not_shade_itself_where_that_is_not_asked_for(tiny_capture):
    model, _, times, center = model_of(tiny_capture(), "self_shadow=false")
    assert model.shadow is not None and not model.shadow.on_body
    activate(model)
    model.nominal.fill_(0.0)
    layers = model.at(times, center)
    gaussians = model.gaussians
    expected = model.surface_light().factors(layers.transforms, layers.human.means)
    colours = gaussians.colour_logits[gaussians.human].sigmoid()
    assert torch.allclose(layers.human.channels[..., :3], colours * expected, atol=1e-6)
    assert layers.shadow is not None


def test_without_lamps_there_is_no_shadow_and_light_is_the_polynomial(tiny_capture):
    path = tiny_capture()
    model, _, times, center = model_of(path, "lamps=0")
    assert model.lamps is None and model.shadow is None
    assert model.at(times, center).shadow is None
    assert len(model.shading.intensities) == 0
    bare = model_of(path, "lamps=0", "shading=false")[0]
    assert bare.shading is None and bare.surface_light() is None


@pytest.mark.parametrize("far_m", [0.2, 5.0])
def test_light_varies_with_the_place_by_how_far_the_person_goes(tiny_capture, far_m):
    """From the middle of their way, whose farthest place is 1 away, or a metre where they stay."""
    path = tiny_capture()
    with np.load(path / "body.npz") as file:
        body = dict(file)
    along = np.linspace(0, 1, len(body["transl"]))
    body["transl"] = far_m * along[:, None] * np.array([0.6, 0.8, 0]) + body["transl"][:1]
    np.savez(path / "body.npz", **body)
    model, capture, *_ = model_of(path)
    times = [frame.mid_us for frame in capture.train_frames]
    roots = np.stack([np.interp(times, body["times_us"], row) for row in body["transl"].T], 1)
    away = np.linalg.norm(roots - roots.mean(0), axis=1).max()
    assert float(model.shading.radius_m) == pytest.approx(max(1.0, away), rel=1e-3)
    assert (away > 1) == (far_m > 1)


@pytest.mark.parametrize("middle", range(3))
def test_a_training_step_shades_by_the_pose_at_the_middle_of_its_frame(tiny_capture, middle):
    model, capture, _, center = model_of(tiny_capture(), "pose_noise=0", "shading=false")
    activate(model)
    times = [frame.mid_us + 3_000 for frame in capture.train_frames[:3]]
    frame, generator = capture.train_frames[middle], torch.Generator().manual_seed(0)
    gaussians = model.gaussians
    canonical, logits = (
        value[gaussians.human].detach() for value in (gaussians.means, gaussians.colour_logits)
    )
    with torch.no_grad():
        cameras = [capture.camera(frame)] * len(times)
        step = model.training_drawing(times, frame, cameras, generator).layers
        each = model.at(times, center)
        shade = model.shade(canonical, model.pose([frame.mid_us])[0])
        placed = deformed(model, [frame.mid_us]).expand(len(times), -1, -1)
        expected, _ = skin(placed, nearest_weights(model), model.pose(times)[1])
    shown = step.human.channels[..., :3].expand(3, -1, -1)
    assert torch.allclose(shown, (logits.sigmoid() * shade).expand(3, -1, -1), atol=1e-6)
    assert torch.allclose(step.human.means, expected, atol=1e-5)
    # Evaluation asks at each time: another shade, under the same bones.
    assert not torch.allclose(each.human.channels[..., :3], shown, atol=1e-3)
    assert torch.allclose(each.transforms, step.transforms, atol=1e-6)


def test_half_of_the_training_steps_see_noise_on_the_pose(tiny_capture):
    model, capture, times, _ = model_of(tiny_capture(), "shading=false")
    activate(model)
    frame, generator = capture.train_frames[0], torch.Generator().manual_seed(0)
    camera = capture.camera(frame)
    with torch.no_grad():
        drawn = [
            model.training_drawing(times, frame, [camera] * 2, generator).layers.human.channels[0]
            for _ in range(40)
        ]
    clean = model.at([frame.mid_us], camera.center()).human.channels[0].detach()
    noisy = [not torch.allclose(one[..., :3], clean[..., :3], atol=1e-6) for one in drawn]
    assert 10 < sum(noisy) < 30


@pytest.mark.parametrize("seed", range(3))
def test_pose_residuals_turn_joints_about_their_own_axes(tiny_capture, seed):
    model, capture, _, _ = model_of(tiny_capture())
    rng, track = np.random.default_rng(seed), model.track
    keys, joints = track.poses.shape[:2]
    frames = [frame.mid_us for frame in capture.train_frames]
    model.residual = PoseCorrection(
        track,
        frames,
        joint_rad=np.tile(rng.uniform(0.3, 0.9, joints), (keys, 1)),
        root_m=np.full((keys, 3), 0.2),
        between=None,
        exact=False,
    )
    bend(model, frames, rng)
    times = rng.integers(frames[0], frames[-1] + 1, size=12).tolist()
    found = [value.detach().double().numpy() for value in model.residual.residual(times)]
    assert_posed(model, times, *found)


@pytest.mark.parametrize("seed", range(2))
def test_random_points_take_their_colours_from_a_network_that_sees_the_direction(
    tiny_capture, seed
):
    torch.manual_seed(seed)
    cube = ("scene.kind=random_cube", "scene.cube_count=800")
    model, capture, times, center = model_of(tiny_capture(), *cube)
    with torch.no_grad():
        model.gaussians.features.normal_()
    frame = capture.train_frames[0]
    whole = model.at(times, center)
    rows = model.gaussians.features[model.gaussians.human, :3].sigmoid()
    assert model.shading is not None and whole.human.channels.shape[:2] == (2, len(rows))
    assert not torch.allclose(whole.scene.channels, model.at(times, center + 1).scene.channels)
    # A step may leave rows out of view black, but none that the picture shows.
    hidden, black = set(), 0
    for draw_seed in range(8):
        model.nominal.zero_()  # the person as at the start
        generator = torch.Generator().manual_seed(draw_seed)
        camera = capture.camera(frame)
        step = model.training_drawing(times, frame, [camera] * 2, generator)
        scene = step.layers.scene.channels[0, :, :3]
        drawn = step.output.static_radii[0] > 0
        assert (scene[drawn] > 0).all()
        black = max(black, int((scene == 0).all(-1).sum()))
        known = torch.allclose(scene[drawn], whole.scene.channels[0, drawn, :3], atol=1e-5)
        hidden.add(not known)
    assert black > 100
    assert hidden == {True, False}  # the direction is shown in some steps and hidden in others
    sum(picture.square().mean() for picture in step.rgb).backward()
    silent = [
        name
        for name, value in model.scene_colour.named_parameters()
        if value.numel() and (value.grad is None or not value.grad.any())
    ]
    assert silent == []


def test_cameras_that_stand_in_one_place_see_the_shadows_that_one_camera_sees(tiny_capture):
    """Of a camera that moves, each time's picture lies in the shadow of its own time."""
    model, capture, _, _ = model_of(tiny_capture(frames=10))
    activate(model)
    with torch.no_grad():
        model.shadow.share_logits.fill_(1.0)
    frame = capture.train_frames[0]
    times = [each.mid_us for each in capture.train_frames[:5:2]]
    camera = capture.camera(frame)
    one, several = (
        model.training_drawing(times, frame, cameras, torch.Generator().manual_seed(0))
        for cameras in ([camera] * 3, [replace(camera) for _ in times])
    )
    pictures = torch.stack(one.rgb)
    torch.testing.assert_close(torch.stack(several.rgb), pictures, atol=1e-5, rtol=0)
    with torch.no_grad():
        model.shadow.share_logits.fill_(-50.0)
        light = model.training_drawing(times, frame, [camera] * 3, torch.Generator().manual_seed(0))
    assert (torch.stack(light.rgb) - pictures).abs().max() > 0.05
