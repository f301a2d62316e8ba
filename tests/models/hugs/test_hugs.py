"""Method `hugs` as a whole: its losses, its scene, a run saved and read back."""

import json

import pytest
import torch

from evsplat.body.rotations import six_to_matrix
from evsplat.capture import load_capture
from evsplat.errors import DataError
from evsplat.objectives.hugs import PATCH_PX, draw_squares, perceptual_distance
from evsplat.render import render
from evsplat.similarity.psnr_ssim import ssim
from evsplat.training import load_run, train
from evsplat.training.checkpoint import latest_checkpoint, load_checkpoint
from evsplat.training.clock import Clock
from evsplat.training.trainer import Trainer

from ...small_model import built, small


def composed(path, *settings: str):
    return built("hugs", path, *settings)


def step_of(composition, capture, frame):
    """The step that the losses see, and their terms."""
    trainer = Trainer(composition, capture, Clock(10))
    seen = []

    def keep(objective):
        loss = objective.loss
        return lambda step: seen.append((step, terms := loss(step))) or terms

    for objective in composition.objectives:
        objective.loss = keep(objective)
    trainer.queue = [capture.train_frames.index(frame)]
    trainer.step()
    return seen[0][0], {name: value.detach() for _, terms in seen for name, value in terms.items()}


def test_terms_are_those_of_the_description(tiny_capture):
    capture = load_capture(tiny_capture(frames=10))
    frame = capture.train_frames[3]
    composition = composed(capture.path)
    step, terms = step_of(composition, capture, frame)
    observed, mask = capture.image(frame), (capture.mask(frame) > 0.5)[..., None]
    drawn = step.rgb[0].detach().clamp(0, 1)
    torch.testing.assert_close(terms["l1"], (drawn - observed).abs().mean())
    torch.testing.assert_close(terms["dssim"], 1 - ssim(drawn, observed))

    # The same random numbers again: order of the frames, background, colour behind the person.
    generator = torch.Generator().manual_seed(0)
    generator.set_state(composed(capture.path).generator.get_state())
    background, colour = (torch.rand(3, generator=generator) for _ in range(2))
    assert not torch.equal(background, colour)
    person = step.layers.human
    alone = render(person, capture.camera(frame), background=torch.cat([colour, torch.zeros(1)]))
    alone = alone.image[0, ..., :3].detach().clamp(0, 1)
    expected = torch.where(mask, observed, colour)
    share = mask.float().mean()
    l1 = (alone - expected).abs().sum() / mask.sum()
    torch.testing.assert_close(terms["human_l1"], l1, rtol=1e-3, atol=1e-5)
    dssim = (1 - ssim(alone, expected)) * share
    torch.testing.assert_close(terms["human_dssim"], dssim, rtol=1e-3, atol=1e-5)
    weights = step.drawing.decoded.weights.detach()
    assert weights.shape[1] == len(step.model.track.body.parents)
    target = composition.objectives[-1].kept
    torch.testing.assert_close(terms["skinning"], (weights - target).square().mean())


def test_every_set_of_parameters_learns(tiny_capture):
    capture = load_capture(tiny_capture(frames=10))
    composition = composed(capture.path, "sh_degree=1")
    model = composition.model
    model.scene.directional.data += 0.01
    before = {n: p.detach().clone() for n, p in model.named_parameters()}
    trainer = Trainer(composition, capture, Clock(100, fraction=0.101))
    trainer.previous_nominal = trainer.clock.nominal
    trainer.step()
    kept = {n for n, p in model.named_parameters() if torch.equal(p, before[n])}
    assert kept == {"human.scales_log"}


def test_squares_lie_in_the_picture_and_mostly_on_the_person():
    mask = torch.zeros(200, 300, dtype=torch.bool)
    mask[20:60, 250:290] = True
    generator = torch.Generator().manual_seed(0)
    squares = [square for _ in range(100) for square in draw_squares(mask, generator)]
    for rows, columns in squares:
        assert rows.stop - rows.start == columns.stop - columns.start == PATCH_PX
        assert 0 <= rows.start and rows.stop <= 200
        assert 0 <= columns.start and columns.stop <= 300
    hits = sum(bool(mask[square].any()) for square in squares)
    assert 0.85 < hits / len(squares) < 1.0
    assert draw_squares(torch.zeros(40, 30, dtype=torch.bool), generator)[0][1] == slice(0, 30)


def test_the_perceptual_distance_sees_pictures_between_minus_one_and_one():
    seen = []

    def metric(image, reference):
        seen.extend([float(image.min()), float(image.max())])
        return (image - reference).abs().mean()

    pictures = torch.rand(2, 40, 40, 3).round()
    generator = torch.Generator().manual_seed(0)
    perceptual_distance(metric, *pictures, torch.ones(40, 40), generator)
    assert (min(seen), max(seen)) == (-1.0, 1.0)


def test_scene_harmonics_come_one_degree_at_a_time_and_poses_are_corrected(tiny_capture):
    composition = composed(tiny_capture(frames=10))
    model, learning = composition.model, composition.learning
    for nominal, degree in ((0, 0), (999, 0), (1_000, 1), (2_500, 2), (9_000, 3)):
        model.nominal.fill_(nominal)
        assert model.active_degree == degree
    learned = {id(p) for network in learning.networks for p in network.parameters}
    assert {id(model.turns), id(model.shifts)} <= learned
    # A static camera is no distance away from itself: lengths are those of the cube.
    assert learning.rows["scene"]["means"].rate.start > 0
    assert composition.densify["scene"].split_above_m > 0


def test_a_backdrop_is_not_densified_and_hardly_moves(tiny_capture):
    path = tiny_capture(frames=10)
    cube, backdrop = (
        composed(path, f"scene.kind={kind}") for kind in ("random_cube", "median_backdrop")
    )
    assert {*cube.densify} == {"human", "scene"}
    assert {*backdrop.densify} == {"human"}
    rates = [c.learning.rows["scene"]["means"].rate.start for c in (cube, backdrop)]
    assert rates[1] == pytest.approx(0.1 * rates[0])


def test_a_scene_colour_has_the_harmonics_that_are_asked_for(tiny_capture):
    path = tiny_capture()
    assert composed(path).model.scene.directional.shape[1] == 0  # one static camera
    scene = composed(path, "sh_degree=3").model.scene
    center = torch.tensor([0.1, 0.2, -3.0])
    constant = scene.rgb(center, 3)
    torch.nn.init.normal_(scene.directional)
    assert torch.equal(scene.rgb(center, 0), constant)
    assert not torch.allclose(scene.rgb(center, 3), scene.rgb(center, 1))


def test_points_that_no_camera_sees_are_left_out(tiny_capture):
    path = tiny_capture()
    scene = composed(path).model.scene
    capture = load_capture(path)
    camera = capture.camera(capture.frames[0])
    pixels, depth = camera.project(scene.means.detach())
    assert 0 < len(scene) < 600
    assert (depth > 0).all()
    assert (pixels[:, 0].abs() < 1.2 * camera.width).all()


def test_training_frames_have_their_correction_and_others_the_recorded_pose(tiny_capture):
    capture = load_capture(tiny_capture(frames=10))
    model = composed(capture.path).model
    recorded, unseen = capture.train_frames[2].mid_us, capture.train_frames[2].mid_us + 1
    before = model.pose([recorded, unseen])[1].detach()
    torch.testing.assert_close(before, model.track.bones([recorded, unseen]))
    with torch.no_grad():
        model.shifts[2] += torch.tensor([0.0, 0.5, 0.0])
        model.turns[2] += 0.1 * torch.randn_like(model.turns[2])
    rotations, after = (part.detach() for part in model.pose([recorded, unseen]))
    # the correction turns a joint about its own axes
    given, turn = model.track.at([recorded])[0], six_to_matrix(model.turns[2].detach())
    torch.testing.assert_close(rotations[:1], given @ turn)
    assert not torch.allclose(given @ turn, turn @ given, atol=1e-3)
    assert not torch.allclose(after[0, :, :3, :3], before[0, :, :3, :3])
    assert float(after[0, 0, 1, 3] - before[0, 0, 1, 3]) != 0
    torch.testing.assert_close(after[1], before[1])


def test_a_resumed_run_goes_on_as_the_uninterrupted_one(tiny_capture):
    capture = load_capture(tiny_capture(frames=10))

    def trainer():
        return Trainer(composed(capture.path), capture, Clock(40))

    def steps(trainer, count):
        for _ in range(count):
            trainer.step()
            trainer.clock.advance(0.01)
        return trainer

    # Densification takes place in between, of both sets.
    whole, first, second = steps(trainer(), 12), steps(trainer(), 7), trainer()
    second.load_state(*first.state())
    expected, found = whole.state()[0], steps(second, 5).state()[0]
    assert expected.keys() == found.keys()
    assert [name for name in expected if not torch.equal(expected[name], found[name])] == []


def test_a_run_is_drawn_after_loading_and_its_sets_densify(tiny_capture, tmp_path):
    path = tiny_capture(frames=10)
    settings = small("hugs", "fit_steps=5", "densify.gradient=1e-7")
    out = train(path, method="hugs", out=tmp_path / "run", iterations=12, overrides=settings)
    run = load_run(out)
    assert run.gaussians["human"] > 80
    tensors, _ = load_checkpoint(latest_checkpoint(out / "checkpoints"))
    assert len(tensors["model.scene.means"]) == run.gaussians["scene"]
    frame = run.capture.test_frames[0]
    camera = run.capture.camera(frame)
    pictures = run.reconstruction.render(camera, [frame.mid_us, frame.mid_us + 500])
    assert pictures.rgb.shape == (2, camera.height, camera.width, 3)
    assert bool(pictures.rgb.isfinite().all()) and float(pictures.rgb.std()) > 0
    human = run.reconstruction.render(camera, [frame.mid_us], parts="human")
    assert 0 < float(human.human.mean()) < 1


def test_without_masks_it_says_what_to_run(tiny_capture):
    path = tiny_capture(frames=10)
    document = json.loads((path / "capture.json").read_text())
    for entry in document["frames"]:
        entry.pop("mask", None)
    (path / "capture.json").write_text(json.dumps(document))
    with pytest.raises(DataError, match=r"no mask .* evsplat masks"):
        composed(path)


def test_gaussians_are_drawn_with_the_sizes_that_densification_reads(tiny_capture):
    capture = load_capture(tiny_capture(frames=10))
    model = composed(capture.path).model
    with torch.no_grad():
        model.human.scales_log += 0.5 * torch.randn_like(model.human.scales_log)
    frame = capture.train_frames[0]
    layers = model.at([frame.mid_us], capture.camera(frame).center())
    torch.testing.assert_close(layers.human.scales[0].abs(), model.human.shape().scales)
