"""Cached networks give the pictures of those that are not."""

import pytest
import torch

from evsplat.capture import load_capture
from evsplat.view.network_cache import (
    NETWORKS,
    CachedNetwork,
    Interleave,
    set_draft,
    with_cached_networks,
)

from ..small_model import built


class Counting(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.calls = 0

    def forward(self, x, scale):
        self.calls += 1
        return x * scale


def test_the_same_inputs_are_computed_once():
    network = Counting()
    cached = CachedNetwork(network, Interleave(4, (0, None)))
    x = torch.rand(4, 3)
    assert torch.equal(cached(x, 2.0), x * 2)
    assert torch.equal(cached(x.clone(), 2.0), x * 2)
    assert network.calls == 1
    assert torch.equal(cached(x, 3.0), x * 3)
    assert torch.equal(cached(x + 1, 3.0), (x + 1) * 3)
    assert network.calls == 3


@pytest.mark.parametrize("count", [8, 10])
def test_draft_outputs_are_renewed_in_phases_and_then_exact(count):
    network = Counting()
    cached = CachedNetwork(network, Interleave(4, (0, None)))
    x, scale = torch.rand(count, 3), torch.tensor(2.0)
    first = cached(x, scale)
    kept = first.clone()
    cached.draft = True
    for phase in range(4):
        output = cached(x + 1, scale)
        renewed = torch.arange(count) % 4 <= phase
        assert torch.equal(output, torch.where(renewed[:, None], (x + 1) * 2, x * 2))
    # An output handed out before is not changed by later updates.
    assert torch.equal(first, kept)
    assert network.calls == 5
    assert torch.equal(cached(x + 1, scale), (x + 1) * 2)
    assert network.calls == 5
    # Parts are rounded otherwise: final outputs are computed in one go.
    cached.draft = False
    assert torch.equal(cached(x + 1, scale), (x + 1) * 2)
    assert network.calls == 6


def test_an_exact_output_has_nothing_of_older_inputs():
    cached = CachedNetwork(Counting(), Interleave(4, (0, None)))
    x, scale = torch.rand(8, 3), torch.tensor(2.0)
    cached(x, scale)
    cached.draft = True
    cached(x + 1, scale)
    cached(x + 2, scale)
    cached.draft = False
    assert torch.equal(cached(x + 2, scale), (x + 2) * 2)
    cached.draft = True
    # Another number of points cannot be computed in part.
    assert torch.equal(cached(x[:3] + 1, scale), (x[:3] + 1) * 2)


@pytest.fixture
def model(tiny_capture):
    capture = load_capture(tiny_capture())
    composition = built("paper", capture, "networks.non_rigid_start=0")
    with torch.no_grad():
        for parameter in composition.model.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return composition.model, capture


@torch.no_grad()
def test_a_model_with_cached_networks_poses_and_colours_as_the_model_does(model):
    model, capture = model
    assert set(NETWORKS) - {"shade.network"} <= {name for name, _ in model.named_modules()}
    twin = with_cached_networks(model)
    cameras = list(capture.cameras.values())
    times = [frame.mid_us for frame in capture.frames[:3]]
    for time_us in (times[0], times[1], times[0]):
        for camera in (cameras[0], cameras[1], cameras[0]):
            seen = [m.at([time_us], camera.center()) for m in (model, twin)]
            for part in ("human", "scene"):
                expected, found = (getattr(layers, part) for layers in seen)
                assert torch.equal(found.means, expected.means)
                assert torch.equal(found.channels, expected.channels)
    assert not any(isinstance(module, CachedNetwork) for module in model.modules())


@torch.no_grad()
def test_a_model_in_its_first_steps_can_be_shown(model):
    model, capture = model
    model.non_rigid_start = 1_000
    camera, time_us = next(iter(capture.cameras.values())), capture.frames[0].mid_us
    found = with_cached_networks(model).at([time_us], camera.center())
    expected = model.at([time_us], camera.center())
    assert torch.equal(found.human.means, expected.human.means)


@torch.no_grad()
def test_drafts_come_to_be_exact_and_are_near_it_before(model):
    model, capture = model
    twin = with_cached_networks(model)
    cameras = list(capture.cameras.values())
    first = twin.at([capture.frames[0].mid_us], cameras[0].center())
    time_us, centre = capture.frames[3].mid_us, cameras[1].center()
    expected = model.at([time_us], centre)
    set_draft(twin, True)
    draft = twin.at([time_us], centre)
    # The person has moved in the first draft already.
    away = (draft.human.means - expected.human.means).abs().max()
    assert float(away) < 0.25 * float((first.human.means - expected.human.means).abs().max())
    renewed = slice(0, None, NETWORKS["scene_colour"].every)
    found, wanted = draft.scene.channels[0], expected.scene.channels[0]
    assert_close(found[renewed], wanted[renewed])
    assert (found - wanted).abs().max() > 1e-3
    # Each network waits for those whose outputs are its inputs.
    for _ in range(sum(interleave.every for interleave in NETWORKS.values())):
        draft = twin.at([time_us], centre)
    for name in ("means", "quaternions", "scales", "channels"):
        assert_close(getattr(draft.human, name), getattr(expected.human, name))
    assert_close(draft.scene.channels, expected.scene.channels)
    set_draft(twin, False)
    sharp = twin.at([time_us], centre)
    for part in ("human", "scene"):
        found, wanted = (vars(getattr(layers, part)) for layers in (sharp, expected))
        assert all(v is None or torch.equal(found[name], v) for name, v in wanted.items())


def assert_close(found, expected):
    """Up to float32's rounding, which depends on what is computed together."""
    torch.testing.assert_close(found, expected, atol=2e-5, rtol=1e-4)
