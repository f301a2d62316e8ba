"""What a pose does to the person's brightness: nothing at first, then what it is taught."""

import numpy as np
import pytest
import torch

from evsplat.body import BodyTrack, default_body
from evsplat.models.discs.pose_shade import PoseShade

TIMES = [50_000 * k for k in range(10)]


def made(seed: int = 0) -> tuple[PoseShade, torch.Tensor, torch.Tensor]:
    """The network, places on the body, and the rotations of ten poses."""
    body, rng = default_body(), np.random.default_rng(seed)
    poses = 0.2 * rng.normal(size=(len(TIMES), len(body.parents), 3))
    track = BodyTrack(body, np.array(TIMES), poses, np.zeros((len(TIMES), 3)))
    torch.manual_seed(seed)
    places = body.canonical_vertices()[:: len(body.canonical_vertices()) // 500]
    return PoseShade(track, TIMES, 64), places, track.at(TIMES)[0]


def test_at_the_start_every_factor_is_one():
    shade, places, rotations = made()
    assert torch.equal(shade(places, rotations), torch.ones(len(TIMES), len(places), 1))


def test_no_place_and_no_pose_is_bought_by_a_shade():
    shade, places, rotations = made()
    torch.nn.init.normal_(shade.network.weights[-1])
    places.requires_grad_()
    rotations.requires_grad_()
    shade(places, rotations).square().sum().backward()
    assert places.grad is None and rotations.grad is None
    assert all(p.grad.any() for p in shade.parameters() if p.numel())


@pytest.mark.parametrize("seed", range(3))
def test_three_hundred_steps_teach_it_a_shade_that_depends_on_place_and_pose(seed):
    """One pose a step, as in training; a network that sees no pose would be left with all of it."""
    shade, places, rotations = made(seed)
    lean = shade.code(rotations)[:, :1]
    truth = (0.1 * lean[:, None] * (places[None, :, 1:2] > places[:, 1].median())).exp()
    optimiser = torch.optim.Adam(shade.parameters(), 1e-3)
    for step in range(300):
        pose = step % len(TIMES)
        loss = (shade(places, rotations[pose : pose + 1]) - truth[pose]).abs().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    with torch.no_grad():
        left = (shade(places, rotations) - truth).square().mean()
    # Of what varies by the pose less than a quarter is left.
    assert left < 0.25 * (truth - truth.mean(0)).square().mean()


def test_what_was_kept_is_made_anew_where_places_move():
    shade, places, rotations = made()
    torch.nn.init.normal_(shade.network.weights[-1])
    with torch.no_grad():
        first = shade(places, rotations)
        assert torch.equal(shade(places, rotations), first)
        places += 0.05
        moved = shade(places, rotations)
        assert not torch.equal(moved, first)
        assert torch.equal(moved, shade(places.clone(), rotations))
