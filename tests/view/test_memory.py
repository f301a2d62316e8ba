"""Networks that remember give the pictures of those that do not."""

import dataclasses

import pytest
import torch

from evsplat.capture import load_capture
from evsplat.config import override
from evsplat.methods import compose, method_config
from evsplat.view.memory import NETWORKS, Remembering, remembering, set_rough

SMALL = ("human.count=150", "deform.width=16", "deform.colour_width=16")


class Counting(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.calls = 0

    def forward(self, x, scale):
        self.calls += 1
        return x * scale


def test_the_same_question_is_asked_once():
    network = Counting()
    memory = Remembering(network)
    x = torch.rand(4, 3)
    assert torch.equal(memory(x, 2.0), x * 2)
    assert torch.equal(memory(x.clone(), 2.0), x * 2)
    assert network.calls == 1
    assert torch.equal(memory(x, 3.0), x * 3)
    assert torch.equal(memory(x + 1, 3.0), (x + 1) * 3)
    assert network.calls == 3


def test_rough_answers_are_of_as_many_points():
    memory = Remembering(Counting())
    x = torch.rand(4, 3)
    memory(x, torch.tensor(2.0))
    memory.rough = True
    assert torch.equal(memory(x + 1, torch.tensor(2.0)), x * 2)
    assert torch.equal(memory(x[:3] + 1, torch.tensor(2.0)), (x[:3] + 1) * 2)


@pytest.fixture
def model(tiny_capture):
    capture = load_capture(tiny_capture())
    values = override({}, (*SMALL, "deform.non_rigid_start=0"))
    composition = compose(method_config("paper", values, where="test"), capture, 0, fit=False)
    with torch.no_grad():
        for parameter in composition.model.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return composition.model, capture


@torch.no_grad()
def test_a_remembering_model_poses_and_colours_as_the_model_does(model):
    model, capture = model
    assert set(NETWORKS) <= set(model._modules)
    twin = remembering(model)
    cameras = list(capture.cameras.values())
    times = [frame.mid_us for frame in capture.frames[:3]]
    for time_us in (times[0], times[1], times[0]):
        for camera in (cameras[0], cameras[1], cameras[0]):
            seen = [m.at([time_us], camera.center()) for m in (model, twin)]
            for part in ("moving", "static"):
                expected, found = (getattr(posed, part)() for posed in seen)
                assert torch.equal(found.means, expected.means)
                assert torch.equal(found.channels, expected.channels)
    assert not any(isinstance(module, Remembering) for module in model.modules())


@torch.no_grad()
def test_a_model_in_its_first_steps_can_be_shown(model):
    model, capture = model
    model.config = dataclasses.replace(model.config, non_rigid_start=1_000)
    camera, time_us = next(iter(capture.cameras.values())), capture.frames[0].mid_us
    found = remembering(model).at([time_us], camera.center())
    expected = model.at([time_us], camera.center())
    assert torch.equal(found.moving().means, expected.moving().means)


@torch.no_grad()
def test_a_draft_asks_neither_skinning_nor_scene_again(model):
    model, capture = model
    twin = remembering(model)
    cameras = list(capture.cameras.values())
    first = twin.at([capture.frames[0].mid_us], cameras[0].center())
    set_rough(twin, True)
    draft = twin.at([capture.frames[3].mid_us], cameras[1].center())
    assert torch.equal(draft.scene.rgb, first.scene.rgb)
    set_rough(twin, False)
    sharp = twin.at([capture.frames[3].mid_us], cameras[1].center())
    expected = model.at([capture.frames[3].mid_us], cameras[1].center())
    assert torch.equal(sharp.human.means, expected.human.means)
    assert torch.equal(sharp.scene.rgb, expected.scene.rgb)
    # The person has moved in the draft all the same.
    away = (draft.human.means - expected.human.means).abs().max()
    assert float(away) < 0.25 * float((first.human.means - expected.human.means).abs().max())
