"""What is kept of pictures of a model that nobody trains, and when it is not."""

import copy
from dataclasses import replace

import pytest
import torch
from torch import nn

from evsplat.capture import load_capture
from evsplat.models.kept import Kept
from evsplat.training.reconstruction import GaussianReconstruction

from ..small_model import built


def counted(kept, given, **asked):
    made = []
    kept.of(given, lambda: made.append(1), **asked)
    return len(made)


def test_it_is_made_anew_when_a_tensor_is_another_or_was_written_to():
    kept, values = Kept(), torch.arange(6.0)
    assert counted(kept, [values]) == 1
    assert counted(kept, [values]) == 0
    assert counted(kept, [values[:]]) == 0  # the same memory
    assert counted(kept, [values[:3]]) == 1
    assert counted(kept, [values.clone()]) == 1
    assert counted(kept, [values]) == 1
    values[2] = 7.0
    assert counted(kept, [values]) == 1
    assert counted(kept, [values, values]) == 1
    assert counted(kept, [values]) == 1


def test_it_is_made_anew_when_something_else_is_asked_for_or_it_was_not_made_to_the_end():
    kept, values = Kept(), torch.arange(6.0)
    assert [counted(kept, [values], asked=times) for times in ([1], [1], [2], [2])] == [1, 0, 1, 0]
    with pytest.raises(KeyboardInterrupt):
        kept.of([values], _stopped, asked=[3])
    assert kept.of([values], lambda: "made", asked=[2]) == "made"


def _stopped():
    raise KeyboardInterrupt


def test_nothing_is_kept_of_what_is_learned():
    """An optimiser in one kernel writes to its parameters without telling."""
    kept, learned = Kept(), nn.Parameter(torch.ones(3))
    assert [counted(kept, [learned]) for _ in range(2)] == [1, 1]
    learned.requires_grad_(False)
    assert [counted(kept, [learned]) for _ in range(2)] == [1, 0]


@pytest.mark.parametrize(
    "scene",
    [("scene.kind=median_backdrop",), ("scene.kind=random_cube", "scene.cube_count=300")],
    ids=["median_backdrop", "random_cube"],
)
def test_pictures_of_a_model_at_rest_are_those_of_one_that_keeps_nothing(tiny_capture, scene):
    capture = load_capture(tiny_capture())
    model = built("evsplat", capture, "lamps=2", *scene, "shade_start=0").model
    camera = capture.camera(capture.train_frames[0])
    times = [frame.mid_us for frame in capture.train_frames[:2]]

    def shown(model):
        with torch.no_grad():
            layers = model.at(times, camera.center(), hard_semantics=True)
        return [*vars(layers.human).values(), *vars(layers.scene).values()]

    def same(some, others):
        return all(
            a is b or torch.equal(a, b) for a, b in zip(some, others, strict=True) if a is not None
        )

    learning = shown(model)
    model.requires_grad_(False)
    for _ in range(2):
        assert same(shown(model), learning)
    with torch.no_grad():
        model.gaussians.means.add_(0.05)
        model.gaussians.opacity_logits.add_(0.5)
    moved = shown(model)
    assert not same(moved, learning)
    assert same(moved, shown(copy.deepcopy(model)))
    assert same(moved, shown(model.requires_grad_(True)))


@pytest.mark.parametrize("method", ["evsplat", "paper"])
def test_while_time_stands_still_a_moving_camera_sees_what_it_would_see_anew(tiny_capture, method):
    capture = load_capture(tiny_capture())
    model = built(method, capture).model.requires_grad_(False)
    keeping = GaussianReconstruction(method, model, posed=Kept())
    camera = capture.camera(capture.train_frames[0])
    one, other = (frame.mid_us for frame in capture.train_frames[:2])
    posed = []
    at = model.at
    model.at = lambda *given, **asked: (posed.append(1), at(*given, **asked))[1]
    for time, shift in [(one, 0.0), (one, 0.2), (other, 0.2), (one, 0.1), (one, 0.3)]:
        pose = camera.world_to_camera.clone()
        pose[0, 3] += shift
        moved = replace(camera, world_to_camera=pose)
        with_kept, anew = (
            made.render(moved, [time]).rgb for made in (keeping, replace(keeping, posed=None))
        )
        assert torch.equal(with_kept, anew)
    # Of `paper`, whose colours depend on the direction, nothing can be kept.
    assert len(posed) == (8 if method == "evsplat" else 10)
