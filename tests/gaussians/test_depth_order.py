"""Before a camera at rest the scene moves across the picture, and its order of depth stays."""

import pytest
import torch
from tests.gaussians.test_initialise import camera

from evsplat.capture import load_capture
from evsplat.gaussians import GaussianSet
from evsplat.gaussians.depth_order import SPREAD, depths_kept, set_apart
from evsplat.gaussians.initialise import gaussians_at, pixel_rays
from evsplat.training.clock import Clock
from evsplat.training.trainer import Trainer

from ..seen import seen
from ..small_model import built

HUMAN = 20


def before_a_wall() -> GaussianSet:
    """A wall of one depth, a Gaussian a pixel, and some of a person before it."""
    recording = camera()
    wall = recording.center() + 5.0 * pixel_rays(recording).reshape(-1, 3)
    points = torch.cat([wall[:HUMAN] * 0.8, wall])
    values = gaussians_at(
        points, torch.full((len(points), 3), 0.04), opacity=0.9, semantic_logit=-2.0
    )
    human = {name: value[:HUMAN] for name, value in values.items()}
    return GaussianSet(human, {name: value[HUMAN:] for name, value in values.items()})


def covers(depth: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Which of two neighbours of the wall is nearer, in lines and in columns."""
    lines = depth.view(camera().height, camera().width)
    return lines.diff(dim=0) > 0, lines.diff(dim=1) > 0


@pytest.mark.parametrize("seed", range(3))
def test_a_step_moves_the_scene_across_the_picture_alone(seed):
    gaussians, recording = before_a_wall(), camera()
    set_apart(gaussians, recording)
    _, before = recording.project(gaussians.means.detach()[gaussians.scene])
    step = 2e-3 * torch.randn(gaussians.means.shape, generator=torch.Generator().manual_seed(seed))
    aimed = gaussians.means.detach() + step
    with depths_kept([gaussians], recording):
        gaussians.means.add_(step)
    pixels, depth = recording.project(gaussians.means.detach()[gaussians.scene])
    expected, elsewhere = recording.project(aimed[gaussians.scene])
    assert torch.allclose(pixels, expected, atol=1e-3)
    assert torch.allclose(depth, before, rtol=1e-6)
    assert not all(map(torch.equal, covers(elsewhere), covers(before)))
    assert all(map(torch.equal, covers(depth), covers(before)))
    assert torch.equal(gaussians.means[gaussians.human], aimed[gaussians.human])


def test_without_a_camera_at_rest_everything_moves():
    gaussians = before_a_wall()
    step = torch.full(gaussians.means.shape, 0.01)
    aimed = gaussians.means.detach() + step
    with depths_kept([gaussians], None), torch.no_grad():
        gaussians.means.add_(step)
    assert torch.equal(gaussians.means, aimed)


def test_a_wall_is_set_apart_and_looks_the_same():
    gaussians, recording = before_a_wall(), camera()
    means = gaussians.means.detach().clone()
    at, depth = recording.project(means[gaussians.scene])
    set_apart(gaussians, recording)
    pixels, apart = recording.project(gaussians.means.detach()[gaussians.scene])
    assert torch.allclose(pixels, at, atol=1e-3)
    assert torch.equal(gaussians.means[gaussians.human], means[gaussians.human])
    assert float((apart / depth - 1).abs().max()) <= 1.001 * SPREAD
    # Those beside each other, in lines and in columns, by far more than a step's rounding.
    lines = apart.view(recording.height, recording.width)
    for neighbours in (lines.diff(dim=0), lines.diff(dim=1)):
        assert float(neighbours.abs().min()) > 20 * 1e-7 * 5.0


def test_training_keeps_the_order(tiny_capture):
    capture = load_capture(tiny_capture(frames=10))
    composition = built("evsplat", capture, purpose="train")
    assert composition.recording is not None
    gaussians = composition.model.gaussians

    def depths() -> torch.Tensor:
        _, depth = composition.recording.project(gaussians.means.detach()[gaussians.scene])
        return depth

    before, start = depths(), gaussians.means.detach()[gaussians.scene].clone()
    trainer = Trainer(composition, seen(capture), Clock(100))
    for _ in range(6):
        assert trainer.step() is not None
    assert not torch.allclose(gaussians.means[gaussians.scene], start, atol=1e-4)
    assert torch.allclose(depths(), before, rtol=2e-6)
