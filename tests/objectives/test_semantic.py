"""Semantic targets from the posed body, and the cross-entropy against them."""

import math
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt

from evsplat.devices import DeviceCache
from evsplat.objectives.semantic import (
    PackedBounds,
    RenderedSemantics,
    membership_loss,
    silhouette_bounds,
)


def disc(radius: float) -> np.ndarray:
    y, x = np.mgrid[:40, :50]
    return (x - 25) ** 2 + (y - 20) ** 2 <= radius**2


def test_bounds_leave_a_band_of_the_given_width_undecided():
    inside, outside = silhouette_bounds(disc(8), 5)
    packed = PackedBounds.of(disc(8), 5).masks()
    assert torch.equal(packed[0], inside) and torch.equal(packed[1], outside)
    distance = distance_transform_edt(~disc(8))
    undecided = ~(inside | outside).numpy()
    assert not (inside & outside).any()
    assert np.array_equal(undecided, (distance > 0) & (distance <= 5))


def test_no_person_in_the_picture_makes_all_of_it_scene():
    inside, outside = silhouette_bounds(np.zeros((4, 5), dtype=bool), 3)
    assert not inside.any()
    assert outside.all()


@pytest.mark.parametrize("probability", [0.2, 0.5, 0.9])
def test_cross_entropy_is_the_closed_form(probability):
    bounds = silhouette_bounds(disc(8), 5)
    soft = torch.tensor([0.1, 0.5, 0.9])
    step = SimpleNamespace(
        frame=SimpleNamespace(camera="main"),
        times_us=(10, 20),
        data=DeviceCache("cpu", 0),
        semantic=torch.full((2, 40, 50), probability),
        model=SimpleNamespace(gaussians=SimpleNamespace(semantics=lambda: soft)),
    )
    # What another camera sees at a time says nothing of this one's pictures.
    places = {("main", 20): disc(8), ("aside", 20): disc(3), ("aside", 10): disc(8)}
    found = {place: partial(PackedBounds.of, mask, 5) for place, mask in places.items()}
    terms = RenderedSemantics(found).loss(step)
    inside, outside = (float(mask.float().mean()) for mask in bounds)
    expected = -inside * math.log(probability) - outside * math.log(1 - probability)
    assert float(terms["semantic"]) == pytest.approx(expected, rel=1e-5)
    assert float(terms["binarise"]) == pytest.approx((0.09 + 0.25 + 0.09) / 3, rel=1e-5)


def test_frames_without_bounds_say_nothing():
    step = SimpleNamespace(
        frame=SimpleNamespace(camera="main"),
        times_us=(10,),
        semantic=torch.zeros(1, 4, 5),
        model=SimpleNamespace(gaussians=SimpleNamespace(semantics=lambda: torch.tensor([0.5]))),
    )
    assert set(RenderedSemantics({}).loss(step)) == {"binarise"}


@pytest.mark.parametrize("seed,shape", [(0, (40, 50)), (1, (37, 29)), (2, (181, 203)), (3, (1, 3))])
def test_compiled_loss_and_its_gradient_equal_plain_torch_in_float64(seed, shape):
    rng = np.random.default_rng(seed)
    kind = rng.integers(3, size=shape)  # inside, outside, between
    packed = PackedBounds(np.packbits(np.stack([kind == 0, kind == 1]).reshape(2, -1), 1), *shape)
    share = rng.uniform(-0.1, 1.1, shape).astype(np.float32)
    share.flat[:2] = 1e-4, 1.0  # a bound of the range, and beyond it
    results = []
    for given, masks in (
        (torch.tensor(share), packed),
        (torch.tensor(share, dtype=torch.float64), packed.masks()),
    ):
        given = given.detach().requires_grad_()
        loss = membership_loss(given, masks)
        (3 * loss).backward()
        results.append((loss.detach().double(), given.grad.double()))
    (loss, gradient), (expected, expected_gradient) = results
    # One less the upper bound has four digits less in float32.
    assert float(loss) == pytest.approx(float(expected), rel=2e-5, abs=1e-7)
    # The bounds are not the same numbers in both precisions.
    inner = torch.from_numpy((np.abs(share - 1e-4) > 1e-6) & (np.abs(share - 1 + 1e-4) > 1e-6))
    torch.testing.assert_close(gradient[inner], expected_gradient[inner], rtol=1e-4, atol=1e-9)


def test_compiled_loss_of_no_number_is_none():
    packed = PackedBounds.of(disc(8), 5)
    share = torch.full((40, 50), 0.5)
    share[20, 25] = math.nan
    assert bool(membership_loss(share, packed).isnan())
