"""Rows of an open class: drawn both ways, taught by what explains the pixels, moved by a flip."""

from dataclasses import replace

import pytest
import torch

from evsplat.capture import load_capture
from evsplat.config import override
from evsplat.gaussians import ATTRIBUTES, RowAdam, flip_labels
from evsplat.methods import compose, method_config
from evsplat.render import render
from evsplat.training.checkpoint import load_checkpoint, save_checkpoint
from evsplat.training.clock import Clock
from evsplat.training.trainer import Trainer

from ..seen import seen
from ..small_model import SMALL_MODEL

IN_WINDOW = 5_000.0
OPEN = 6
"""Rows of each class that are open in these tests."""


def make(path, *settings: str):
    """A composition in the window in which labels are learned, and its capture."""
    capture = load_capture(path)
    given = override({}, (*SMALL_MODEL, "semantics=two_branch", *settings))
    composition = compose(method_config("paper", given, where="test"), seen(capture), 0, fit=False)
    composition.model.nominal.fill_(IN_WINDOW)
    return composition, capture


def leave_open(model, seed: int = 0) -> None:
    """Some rows of each class are undecided, those of the scene at the body; others are sure."""
    generator = torch.Generator().manual_seed(seed)
    gaussians, things = model.gaussians, model.gaussians.human_count
    with torch.no_grad():
        gaussians.semantic_logits[:things] = 4.0
        gaussians.semantic_logits[things:] = -4.0
        gaussians.semantic_logits[:OPEN] = torch.rand(OPEN, generator=generator)
        gaussians.semantic_logits[things : things + OPEN] = -torch.rand(OPEN, generator=generator)
        vertices = model.track.vertices(int(model.frame_times[0]))
        chosen = torch.randint(len(vertices), (OPEN,), generator=generator)
        gaussians.means[things : things + OPEN] = vertices[chosen]
        gaussians.opacity_logits.fill_(0.0)
        gaussians.features.normal_(generator=generator)
        gaussians.quaternions.normal_(generator=generator)


def times_of(capture) -> list[int]:
    return [frame.mid_us for frame in capture.train_frames[:2]]


@pytest.mark.parametrize("seed", range(2))
def test_the_gradient_of_the_attribute_is_that_of_finite_differences(tiny_capture, seed):
    composition, capture = make(
        tiny_capture(), "deform.human_colour=own", "deform.skinning=surface"
    )
    model = composition.model
    leave_open(model, seed)
    found = model.branches.of(model.gaussians, IN_WINDOW)
    assert len(found) == 2 * OPEN
    posed_as_given = model.pose
    model.double()
    model.pose = lambda times: tuple(value.double() for value in posed_as_given(times))
    model.surface.surface = replace(
        model.surface.surface, weights=model.surface.surface.weights.double()
    )
    model.surface._found = None
    exact = {k: v.double() if v.is_floating_point() else v for k, v in vars(found).items()}
    model.branches._open = replace(found, **exact)
    camera = capture.camera(capture.train_frames[0])
    camera = replace(camera, K=camera.K.double(), world_to_camera=camera.world_to_camera.double())
    generator = torch.Generator().manual_seed(seed)
    shape = (2, camera.height, camera.width, 4)
    target = torch.randn(shape, dtype=torch.float64, generator=generator)

    def loss() -> torch.Tensor:
        posed = model.at(times_of(capture), camera.center(), both_branches=True)
        drawn = render(posed.moving(), camera, static=posed.static(), backend="reference")
        return (drawn.image * target).sum()

    loss().backward()
    logits = model.gaussians.semantic_logits
    things = model.gaussians.human_count
    for row in (0, 1, things, things + 1):
        values, step = [], 1e-6
        for side in (step, -step):
            with torch.no_grad():
                logits[row] += side
                values.append(float(loss()))
                logits[row] -= side
        expected = (values[0] - values[1]) / (2 * step)
        assert abs(expected) > 1e-4
        assert float(logits.grad[row]) == pytest.approx(expected, rel=1e-4, abs=1e-6)


def test_sure_rows_are_drawn_once_and_open_ones_twice(tiny_capture):
    composition, capture = make(tiny_capture())
    model = composition.model
    leave_open(model)
    center = capture.camera(capture.train_frames[0]).center()
    posed = model.at(times_of(capture), center, both_branches=True)
    gaussians = model.gaussians
    moving, static = posed.moving(), posed.static()
    assert moving.means.shape[1] == gaussians.human_count + OPEN
    assert static.means.shape[1] == gaussians.scene_count + OPEN

    soft, alpha = gaussians.semantics().detach(), gaussians.opacities().detach()
    people, things = gaussians.of_parts(alpha)
    of_people, of_things = (part[:OPEN] for part in gaussians.of_parts(soft))
    expected = torch.cat([people[:OPEN] * of_people, people[OPEN:], things[:OPEN] * of_things])
    assert torch.allclose(moving.opacities, expected)
    expected = torch.cat(
        [things[:OPEN] * (1 - of_things), things[OPEN:], people[:OPEN] * (1 - of_people)]
    )
    assert torch.allclose(static.opacities, expected)
    # What is drawn twice tells its share by its opacity.
    person = moving.channels[0, :, 3].detach()
    assert (torch.cat([person[:OPEN], person[-OPEN:]]) == 1).all()
    assert torch.equal(person[OPEN:-OPEN], soft[OPEN : gaussians.human_count])
    assert (static.channels[0, :OPEN, 3] == 0).all() and (static.channels[0, -OPEN:, 3] == 0).all()


@pytest.mark.parametrize(("nominal", "hard"), [(IN_WINDOW, True), (0.0, False), (12_000.0, False)])
def test_trained_models_and_other_phases_draw_by_the_label(tiny_capture, nominal, hard):
    composition, capture = make(tiny_capture())
    model = composition.model
    leave_open(model)
    model.nominal.fill_(nominal)
    center = capture.camera(capture.train_frames[0]).center()
    options = {"hard_semantics": True} if hard else {"both_branches": True}
    posed = model.at(times_of(capture), center, **options)
    assert posed.copies is None
    assert torch.equal(
        posed.moving().opacities, model.gaussians.opacities()[: len(posed.human_opacities)]
    )


def test_with_all_labels_sure_pictures_and_gradients_are_those_of_fixed(tiny_capture):
    path, results = tiny_capture(), []
    for semantics in ("two_branch", "fixed"):
        composition, capture = make(path, f"semantics={semantics}", "semantic_start=4")
        model = composition.model
        frame = capture.train_frames[0]
        drawing = model.training_drawing(
            times_of(capture), frame, capture.camera(frame), torch.Generator().manual_seed(1)
        )
        torch.stack(drawing.rgb).square().sum().backward()
        pictures = torch.stack([*drawing.rgb, drawing.semantic[0][..., None].expand(-1, -1, 3)])
        gradients = {name: value.grad for name, value in model.named_parameters()}
        results.append((pictures.detach(), gradients, drawing.center_gradients()))
    (picture, gradients, centers), (expected, of_fixed, centers_of_fixed) = results
    assert torch.equal(picture, expected)
    assert gradients.keys() == of_fixed.keys()
    for name, value in gradients.items():
        other = of_fixed[name]
        assert (value is None) == (other is None), name
        assert value is None or torch.equal(value, other), name
    assert all(torch.equal(a, b) for a, b in zip(centers, centers_of_fixed, strict=True))


def test_a_flip_puts_a_row_where_its_copy_stood(tiny_capture):
    composition, capture = make(tiny_capture())
    model, gaussians = composition.model, composition.model.gaussians
    leave_open(model)
    times, center = times_of(capture), capture.camera(capture.train_frames[0]).center()
    before = model.at(times, center, both_branches=True)
    with torch.no_grad():
        gaussians.semantic_logits[:OPEN] *= -1
        gaussians.semantic_logits[gaussians.human_count :][:OPEN] *= -1
    optimiser = RowAdam(
        {name: getattr(gaussians, name) for name in ATTRIBUTES}, dict.fromkeys(ATTRIBUTES, 1e-3)
    )
    assert flip_labels(gaussians, optimiser, composition.body_frames) == 2 * OPEN
    for cache in model.row_caches.values():
        cache.rows_changed()
    after = model.at(times, center, hard_semantics=True)

    copies = before.copies
    # Rows keep their order within a class: those from the scene come last among the person's.
    people, things = after.human.means[:, -OPEN:], after.scene.means[:OPEN]
    assert torch.allclose(people, copies.human.means, atol=1e-5)
    assert torch.allclose(things, copies.scene.means, atol=1e-5)
    assert torch.allclose(after.scene.quaternions[:OPEN], copies.scene.quaternions, atol=1e-5)
    assert torch.allclose(after.human.quaternions[:, -OPEN:], copies.human.quaternions, atol=1e-5)
    assert torch.allclose(after.scene.scales[:OPEN], copies.scene.scales)


def test_a_resumed_training_is_that_without_a_break_bit_for_bit(tiny_capture, tmp_path):
    path = tiny_capture()

    def trainer() -> Trainer:
        # Few edits, so that the break falls where what is open is kept and not found again.
        settings = ("deform.skinning_turns=2", "densify_human.every=2000")
        composition, capture = make(path, *settings)
        return Trainer(composition, capture, Clock(60, iteration=20, fraction=20 / 60))

    def run(trainer: Trainer, steps: int) -> None:
        for _ in range(steps):
            trainer.step()
            trainer.clock.advance(0.0)

    whole = trainer()
    run(whole, 3)
    assert len(whole.model.branches.state()["human_rows"]) > 0
    file = save_checkpoint(tmp_path, 3, *whole.state())
    resumed = trainer()
    resumed.load_state(*load_checkpoint(file))
    for one in (whole, resumed):
        run(one, 6)
    expected, found = whole.state()[0], resumed.state()[0]
    assert expected.keys() == found.keys()
    assert [name for name in expected if not torch.equal(expected[name], found[name])] == []
