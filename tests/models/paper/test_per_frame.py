"""Which training frames speak for an instant, against the rules in closed form."""

import numpy as np
import pytest
import torch

from evsplat.models.paper.per_frame import interpolated, seen, seen_or_last

ANCHORS = torch.tensor([100.0, 200.0, 400.0], dtype=torch.float64)


@pytest.mark.parametrize("seed", range(3))
def test_interpolation_is_that_of_numpy_and_holds_the_ends(seed):
    times = np.random.default_rng(seed).integers(0, 600, size=20)
    values = np.random.default_rng(seed + 9).normal(size=3)
    found = interpolated(ANCHORS, times.tolist()).numpy() @ values
    assert np.allclose(found, np.interp(times, ANCHORS.numpy(), values), atol=1e-6)


def test_one_frame_speaks_for_all_times():
    assert interpolated(ANCHORS[:1], [0, 500]).tolist() == [[1.0], [1.0]]


def test_as_released_only_middles_are_seen_and_all_else_has_the_last_latent():
    times = [100, 200, 201, 400, 999]
    nothing, last = [0.0] * 3, [0.0, 0.0, 1.0]
    first, second = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]
    assert seen(ANCHORS, times).tolist() == [first, second, nothing, last, nothing]
    assert seen_or_last(ANCHORS, times).tolist() == [first, second, last, last, last]
