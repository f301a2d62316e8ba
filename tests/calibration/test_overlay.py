"""Pictures laid over each other against the affine maps that they were made with."""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from evsplat.calibration.overlay import back, carried, laid_over, one_after_the_other, unmoved


def scene(rng: np.random.Generator, height: int, width: int) -> torch.Tensor:
    """A smooth picture of logarithms."""
    values = gaussian_filter(rng.standard_normal((height, width)), 2.0)
    return torch.from_numpy(values / values.std()).float()


def some_ways(rng: np.random.Generator, count: int, size: float) -> torch.Tensor:
    return unmoved(count) + size * torch.from_numpy(rng.uniform(-1, 1, (count, 2, 3))).float()


@pytest.mark.parametrize("seed", range(4))
def test_ways_are_those_that_a_picture_was_carried_by(seed: int) -> None:
    rng = np.random.default_rng(seed)
    second = scene(rng, 36, 48).expand(5, 1, 36, 48)
    true = some_ways(rng, 5, 0.06)
    brighter = torch.from_numpy(rng.uniform(-1, 1, (5, 1, 1, 1))).float()
    first = carried(second, true) + brighter
    usable = carried(torch.ones_like(second), true) > 0.99
    # Somebody stands in one of both alone.
    first[:, :, 10:30, 20:28] = 2.0
    logs, seen = torch.cat([first, second], 1), torch.cat([usable, usable], 1)
    seen[:, 1] = True
    found = laid_over(logs, seen, unmoved(5))
    assert (found - true).abs().max() < 0.01


def test_back_and_forth_is_where_one_began() -> None:
    ways = some_ways(np.random.default_rng(3), 6, 0.2)
    assert torch.allclose(one_after_the_other(ways, back(ways)), unmoved(6), atol=1e-6)


def test_two_ways_one_after_the_other_carry_as_both_do() -> None:
    rng = np.random.default_rng(5)
    picture = scene(rng, 40, 40)[None, None]
    first, second = some_ways(rng, 1, 0.05), some_ways(rng, 1, 0.05)
    twice = carried(carried(picture, second), first)
    once = carried(picture, one_after_the_other(first, second))
    inner = (twice - once)[..., 8:-8, 8:-8]
    assert inner.abs().mean() < 0.05
