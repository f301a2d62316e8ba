"""The paper's model put together: what moves, what stays, and where gradients reach."""

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from evsplat.body import BodyTrack, skin
from evsplat.capture import load_capture
from evsplat.config import override
from evsplat.models.drawing import draw
from evsplat.deform.human_scene import HumanSceneModel
from evsplat.models.pose_spline import PoseSpline
from evsplat.errors import ConfigError
from evsplat.gaussians import ATTRIBUTES
from evsplat.methods import PaperConfig, compose, method_config

from ...seen import seen

SMALL = ("human.count=150", "deform.width=16", "deform.colour_width=16")


def model_of(path, *settings: str):
    """Model, two frame times and a camera centre for a small capture."""
    config = method_config("paper", override({}, (*SMALL, *settings)), where="test")
    assert isinstance(config, PaperConfig)
    capture = load_capture(path)
    model = compose(config, seen(capture), 0, fit=False).model
    times = [frame.mid_us for frame in capture.train_frames[:2]]
    return model, times, capture.camera(capture.train_frames[0]).center()


def activate(model) -> None:
    """Past the start of every part, with deformations that can be seen."""
    model.nominal.fill_(10_000.0)
    with torch.no_grad():
        model.non_rigid.mlp.weights[-1].normal_(std=0.05)
        model.gaussians.features.normal_()
        model.latents.normal_()


def test_before_the_non_rigid_network_the_person_is_blend_skinned(tiny_capture):
    model, times, center = model_of(tiny_capture())
    posed = model.at(times, center)
    canonical = model.gaussians.means[model.gaussians.human]
    _, bones = model.pose(times)
    weights = model.skinning(model.normalise(canonical[None]))
    expected, transforms = skin(canonical[None], weights, bones)
    assert torch.allclose(posed.human.means, expected, atol=1e-6)
    assert torch.allclose(posed.human.transforms, transforms, atol=1e-6)
    assert torch.equal(posed.scene.means, model.gaussians.means[model.gaussians.scene])


def test_times_do_not_see_each_other(tiny_capture):
    model, times, center = model_of(tiny_capture())
    activate(model)
    together = model.at(times, center)
    for index, time in enumerate(times):
        alone = model.at([time], center)
        for name in ("means", "quaternions", "scales", "rgb", "transforms"):
            both, one = getattr(together.human, name)[index], getattr(alone.human, name)[0]
            assert torch.allclose(both, one, atol=1e-5), name


def test_shared_skinning_is_exact_for_one_time_and_near_for_neighbours(tiny_capture):
    model, times, center = model_of(tiny_capture())
    activate(model)

    def means(instants: list[int], share: bool) -> torch.Tensor:
        return model.at(instants, center, share_skinning=share).human.means.detach()

    assert torch.equal(means(times[:1], False), means(times[:1], True))
    # The error is of first order in how much the deformations differ.
    errors = []
    for factor in (10.0, 0.1):
        with torch.no_grad():
            model.non_rigid.mlp.weights[-1].mul_(factor)
        errors.append(float((means(times, False) - means(times, True)).norm(dim=-1).mean()))
    assert 0 < errors[1] < 0.2 * errors[0]


@pytest.mark.parametrize(("semantics", "reached"), [("fixed", False), ("ste", True)])
def test_placement_teaches_the_attribute_only_with_straight_through(
    tiny_capture, semantics, reached
):
    model, times, center = model_of(tiny_capture(), f"semantics={semantics}")
    posed = model.at(times, center)
    target = torch.randn(posed.human.means.shape, generator=torch.Generator().manual_seed(0))
    (posed.human.means * target).sum().backward()
    gradient = model.gaussians.semantic_logits.grad
    if not reached:
        assert gradient is None or not gradient.any()
        return
    rows = model.gaussians.human
    canonical = model.gaussians.means.detach()[rows]
    soft = model.gaussians.semantics().detach()[rows]
    # d/dl of m (deformed - canonical), summed over times: the closed form of A2 (ii).
    apart = posed.human.means.detach() - canonical
    expected = soft * (1 - soft) * (apart * target).sum((0, 2))
    assert torch.allclose(gradient[rows], expected, rtol=1e-3, atol=1e-5)


def test_every_network_and_attribute_gets_a_gradient(tiny_capture):
    model, times, center = model_of(tiny_capture())
    activate(model)
    posed = model.at(times, center)
    fields = [
        value
        for splats in (posed.moving(), posed.static())
        for value in (
            splats.means,
            splats.quaternions,
            splats.scales,
            splats.opacities,
            splats.channels,
        )
    ]
    generator = torch.Generator().manual_seed(0)
    sum((f * torch.randn(f.shape, generator=generator)).sum() for f in fields).backward()
    silent = [
        name
        for name, value in model.named_parameters()
        if value.numel() and (value.grad is None or not value.grad.any())
    ]
    # Residuals of the pose are learned only on demand.
    assert [name for name in silent if not name.endswith("residuals")] == []


@pytest.mark.parametrize("seed", range(2))
def test_own_colours_on_the_body_surface_need_no_network(tiny_capture, seed):
    settings = ("deform.skinning=surface", "deform.human_colour=own")
    model, times, center = model_of(tiny_capture(), *settings)
    torch.manual_seed(seed)
    activate(model)
    posed = model.at(times, center)
    canonical = model.gaussians.means[model.gaussians.human].detach()
    samples = model.surface.surface
    weights = samples.weights[torch.cdist(canonical, samples.points).argmin(1)]
    rotations, bones = model.pose(times)
    deformed, *_ = model._non_rigid(model._moving(_parts(model)), rotations, None)
    expected, _ = skin(deformed, weights, bones)
    assert torch.allclose(posed.human.means, expected, atol=1e-5)
    # Wherever the rows have been moved to, they are drawn with the weights they have.
    assert torch.equal(model.skinning_weights(canonical + 0.3), weights)
    colours = model.gaussians.features[model.gaussians.human][:, :3].sigmoid()
    assert torch.equal(posed.human.rgb, colours.expand(len(times), -1, -1))
    names = {name.partition(".")[0] for name, _ in model.named_parameters()}
    assert not {"skinning", "human_colour"} & names


@pytest.mark.parametrize("seed", range(2))
def test_what_the_body_hides_from_a_lamp_is_darker(tiny_capture, seed):
    settings = "deform.shading=true deform.shadow_lights=2 deform.self_shadow=true"
    settings += " deform.human_colour=own"
    model = model_of(tiny_capture(), *settings.split())[0]
    times = model.frame_times[:3].long().tolist()
    center = torch.tensor([0.3, -2.0, 1.2])
    with torch.no_grad():
        dark = model.at(times, center).human
        model.shading.intensities.copy_(0.2 + torch.rand(2, 3))
        lit = model.at(times, center).human
        lamps = model.lamps.places()
        casters = model.shadow.place(model.pose(times)[1])
        shares = model.shadow.lit(casters, lit.means, lamps)
        light = model.surface_light()
        expected = light.factors(lit.transforms, lit.means, shares)
        assert torch.allclose(lit.rgb, dark.rgb * expected, atol=1e-5)
        assert (expected < light.factors(lit.transforms, lit.means) - 0.01).any()
        # A training step looks at its middle alone.
        step = model.at(times, center, networks_at_us=times[1]).human
        shares = shares[:, 1:2]
        expected = light.factors(lit.transforms, lit.means, shares)
    assert torch.allclose(step.rgb, dark.rgb * expected, atol=1e-5)


def test_weights_of_the_surface_and_points_far_from_it_exclude_each_other(tiny_capture):
    with pytest.raises(ConfigError, match="deform.skinning=network"):
        model_of(tiny_capture(), "semantics=ste", "deform.skinning=surface")


def _parts(model):
    gaussians = model.gaussians
    return {name: gaussians.of_parts(getattr(gaussians, name)) for name in ATTRIBUTES}


@pytest.mark.parametrize("seed", range(2))
def test_colours_of_rows_out_of_view_are_not_missed(seed, tiny_capture):
    torch.manual_seed(seed)
    path = tiny_capture()
    model, times, center = model_of(path, "scene.kind=random_cube", "scene.cube_count=800")
    activate(model)
    capture = load_capture(path)
    camera = capture.camera(capture.train_frames[0])
    black, found = [], []
    for shown in (None, camera):
        posed = model.at(times, center, shown=shown)
        black.append(int((posed.scene.rgb == 0).all(-1).sum()))
        drawing = draw(model, posed, camera)
        loss = torch.stack([picture.square().mean() for picture in drawing.rgb]).sum()
        names, leaves = zip(*model.named_parameters(), strict=True)
        gradients = torch.autograd.grad(loss, leaves, allow_unused=True)
        found.append((drawing.rgb, dict(zip(names, gradients, strict=True))))
    (pictures, expected), (fewer, gradients) = found
    assert black[0] == 0 and black[1] > 100
    for whole, part in zip(pictures, fewer, strict=True):
        assert torch.allclose(whole, part, atol=1e-6)
    for name, value in expected.items():
        if value is None:
            assert gradients[name] is None
        elif value.numel():
            # Single entries may be what is left of sums that cancel; of a row that was missed the
            # whole gradient would be.
            assert (gradients[name] - value).norm() <= 2e-5 * value.norm(), name


def corrected(path, seed: int, knot_us: float | None):
    """A model with large random poses and residuals, its frame times, and the number generator.

    ``knot_us``: the residuals are the control points of a spline with such knots.
    """
    base, _, _ = model_of(path, "deform.pose_correction_start=0")
    rng = np.random.default_rng(seed)
    times, joints = base.frame_times.long().tolist(), len(base.track.body.parents)
    track = BodyTrack(
        base.track.body,
        np.array(times),
        0.8 * rng.normal(size=(len(times), joints, 3)),
        rng.normal(size=(len(times), 3)),
    )
    spline = None
    if knot_us is not None:
        units = torch.tensor(rng.uniform(0.3, 0.9, joints))
        span = (times[0], times[-1])
        spline = PoseSpline(span, knot_us, times, joint_rad=units, root_m=0.2)
    model = HumanSceneModel(base.config, "fixed", track, times, base.gaussians, spline)
    with torch.no_grad():
        for residuals in (model.rotation_residuals, model.translation_residuals):
            residuals.copy_(torch.from_numpy(0.8 * rng.normal(size=residuals.shape)))
    return model, times, rng


def assert_posed(model, times: list[int], turns: np.ndarray, shifts: np.ndarray) -> None:
    """Each joint turns by the residual about its own axes, and then as the track says."""
    given, place = model.track.at(times)
    matrices = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(*turns.shape, 3)
    expected = given.double().numpy() @ matrices
    other = matrices @ given.double().numpy()
    assert np.abs(expected - other).max(axis=(2, 3)).min() > 0.01
    rotations, bones = model.pose(times)
    assert np.allclose(rotations.detach(), expected, atol=1e-5)
    placed = model.track.body.canonical_to_world(
        torch.from_numpy(expected).float(), place + torch.from_numpy(shifts).float()
    )
    assert torch.allclose(bones, placed, atol=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_pose_residuals_of_frames_turn_joints_about_their_own_axes(tiny_capture, seed):
    model, frames, rng = corrected(tiny_capture(), seed, None)
    turns = model.rotation_residuals.detach().double().numpy()
    shifts = model.translation_residuals.detach().double().numpy()
    # At the middles of the frames the key poses are those of the track itself.
    poses = Rotation.from_rotvec(model.track.poses.reshape(-1, 3)).as_matrix()
    given = model.track.at(frames)[0]
    assert np.allclose(given, poses.reshape(given.shape), atol=1e-5)
    assert_posed(model, frames, turns, shifts)
    share = rng.uniform(0.2, 0.8, len(frames) - 1)
    between = [
        round(before + part * (after - before))
        for before, after, part in zip(frames, frames[1:], share, strict=False)
    ]
    parts = (np.array(between) - frames[:-1]) / np.diff(frames)
    mixed = [
        (1 - weight) * values[:-1] + weight * values[1:]
        for values, weight in ((turns, parts[:, None, None]), (shifts, parts[:, None]))
    ]
    assert_posed(model, between, *mixed)


@pytest.mark.parametrize("seed", range(3))
def test_pose_residuals_of_a_spline_turn_joints_about_their_own_axes(tiny_capture, seed):
    knot_us = [70_000.0, 40_000.0, 110_000.0][seed]
    model, frames, rng = corrected(tiny_capture(), seed, knot_us)
    spline = model.pose_spline
    knots = 1e-6 * (frames[0] + knot_us * np.arange(-3, spline.count + 1))
    times = rng.integers(frames[0], frames[-1] + 1, size=12).tolist()
    units = spline.joint_rad.double().numpy()[:, None]
    found = []
    for points, unit in (
        (model.rotation_residuals, units),
        (model.translation_residuals, spline.root_m),
    ):
        curve = BSpline(knots, points.detach().double().numpy(), 3)
        mean = curve(1e-6 * np.array(frames)).mean(0)
        found.append(unit * (curve(1e-6 * np.array(times)) - mean))
    assert_posed(model, times, *found)
