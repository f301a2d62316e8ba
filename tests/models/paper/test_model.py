"""The paper's model put together: what moves, what stays, and where gradients reach."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from evsplat.body import skin
from evsplat.capture import load_capture
from evsplat.models.drawing import draw

from ...small_model import built
from ..wild_poses import assert_posed, bend


def model_of(path, *settings: str):
    """Model, two frame times and a camera centre for a small capture."""
    capture = load_capture(path)
    model = built("paper", capture, *settings).model
    times = [frame.mid_us for frame in capture.train_frames[:2]]
    return model, times, capture.camera(capture.train_frames[0]).center()


def activate(model) -> None:
    """Past the start of every part, with deformations that can be seen."""
    model.nominal.fill_(10_000.0)
    with torch.no_grad():
        model.deformation.network.mlp.weights[-1].normal_(std=0.05)
        model.gaussians.features.normal_()
        model.latents.values.normal_()


def test_before_the_non_rigid_network_the_person_is_blend_skinned(tiny_capture):
    model, times, center = model_of(tiny_capture())
    layers = model.at(times, center)
    canonical = model.gaussians.means[model.gaussians.human]
    _, bones = model.pose(times)
    weights = model.skinning(model.deformation.normalise(canonical[None]))
    expected, transforms = skin(canonical[None], weights, bones)
    assert torch.allclose(layers.human.means, expected, atol=1e-6)
    assert torch.allclose(layers.transforms, transforms, atol=1e-6)
    assert torch.equal(layers.human.linear, layers.transforms[..., :3, :3])
    assert torch.equal(layers.scene.means[0], model.gaussians.means[model.gaussians.scene])


def test_times_do_not_see_each_other(tiny_capture):
    model, times, center = model_of(tiny_capture())
    activate(model)
    together = model.at(times, center)
    for index, time in enumerate(times):
        alone = model.at([time], center)
        for name in ("means", "quaternions", "scales", "channels", "linear"):
            both, one = getattr(together.human, name)[index], getattr(alone.human, name)[0]
            assert torch.allclose(both, one, atol=1e-5), name
        assert torch.allclose(together.transforms[index], alone.transforms[0], atol=1e-5)


def test_shared_skinning_is_exact_for_one_time_and_near_for_neighbours(tiny_capture):
    model, times, center = model_of(tiny_capture())
    activate(model)

    def means(instants: list[int], share: bool) -> torch.Tensor:
        model.skinning_turns.rows_changed()
        weights = model._shared_weights if share else model.skinning_weights
        return model._layers(instants, center, weights).human.means.detach()

    assert torch.equal(means(times, False), model.at(times, center).human.means)
    assert torch.equal(means(times[:1], False), means(times[:1], True))
    # The error is of first order in how much the deformations differ.
    errors = []
    for factor in (10.0, 0.1):
        with torch.no_grad():
            model.deformation.network.mlp.weights[-1].mul_(factor)
        errors.append(float((means(times, False) - means(times, True)).norm(dim=-1).mean()))
    assert 0 < errors[1] < 0.2 * errors[0]


@pytest.mark.parametrize(("semantics", "reached"), [("fixed", False), ("ste", True)])
def test_placement_teaches_the_attribute_only_with_straight_through(
    tiny_capture, semantics, reached
):
    model, times, center = model_of(tiny_capture(), f"semantics={semantics}")
    layers = model.at(times, center)
    target = torch.randn(layers.human.means.shape, generator=torch.Generator().manual_seed(0))
    (layers.human.means * target).sum().backward()
    gradient = model.gaussians.semantic_logits.grad
    if not reached:
        assert gradient is None or not gradient.any()
        return
    rows = model.gaussians.human
    canonical = model.gaussians.means.detach()[rows]
    soft = model.gaussians.semantics().detach()[rows]
    # d/dl of m (deformed - canonical), summed over times: the closed form of A2 (ii).
    apart = layers.human.means.detach() - canonical
    expected = soft * (1 - soft) * (apart * target).sum((0, 2))
    assert torch.allclose(gradient[rows], expected, rtol=1e-3, atol=1e-5)


def test_every_network_and_attribute_gets_a_gradient(tiny_capture):
    model, times, center = model_of(tiny_capture(), "networks.pose_start=0")
    activate(model)
    layers = model.at(times, center)
    fields = [
        value
        for splats in (layers.human, layers.scene)
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
    assert silent == []


@pytest.mark.parametrize("seed", range(2))
def test_colours_of_rows_out_of_view_are_not_missed(seed, tiny_capture):
    torch.manual_seed(seed)
    path = tiny_capture()
    model, times, center = model_of(path, "scene.kind=random_cube", "scene.cube_count=800")
    activate(model)
    capture = load_capture(path)
    camera = capture.camera(capture.train_frames[0])
    black, found = [], []
    for shown in ((), (camera,)):
        layers = model._layers(times, center, model.skinning_weights, shown=shown)
        black.append(int((layers.scene.channels[0, :, :3] == 0).all(-1).sum()))
        drawing = draw(layers, camera)
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


@pytest.mark.parametrize("rate", [0.3, 1.0])
def test_training_hides_the_direction_from_the_scene_at_its_rate(tiny_capture, rate):
    model, times, center = model_of(tiny_capture(), f"scene_direction_dropout={rate}")
    activate(model)
    generator = torch.Generator().manual_seed(0)
    noises = [model._draw_noise(generator) for _ in range(2_000)]
    assert abs(np.mean([noise.hide_scene_direction for noise in noises]) - rate) < 0.03
    gaussians = model.gaussians
    features = gaussians.features[gaussians.scene].detach()
    blind = model.scene_colour(features, torch.zeros(len(features), 3)).detach()
    shown = model.at(times, center).scene.channels[0, :, :3].detach()
    for noise in noises[:5]:
        layers = model._layers(times, center, model.skinning_weights, noise=noise)
        expected = blind if noise.hide_scene_direction else shown
        assert torch.allclose(layers.scene.channels[0, :, :3], expected, atol=1e-6)
    assert not torch.allclose(blind, shown, atol=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_pose_residuals_of_frames_turn_joints_about_their_own_axes(tiny_capture, seed):
    model, _, _ = model_of(tiny_capture())
    frames, rng = model.residual.frame_times.long().tolist(), np.random.default_rng(seed)
    bend(model, frames, rng)
    turns = model.residual.rotations.detach().double().numpy()
    shifts = model.residual.translations.detach().double().numpy()
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
