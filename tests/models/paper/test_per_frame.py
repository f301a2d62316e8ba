"""Which training frames speak for an instant, against the rules in closed form."""

import numpy as np
import pytest
import torch

from evsplat.models.paper.per_frame import (
    FrameLatents,
    FramePoses,
    interpolated,
    seen,
    seen_or_last,
)

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


@pytest.mark.parametrize("unseen", ["interpolated", "released"])
def test_frames_of_several_cameras_share_what_is_learned_of_a_time(rng, unseen):
    """Whether all of one camera come first or both have one trigger."""
    once = np.unique(rng.integers(0, 10_000, size=6)).tolist()
    for times in (once + once, [time for time in once for _ in range(2)]):
        latents, poses = FrameLatents(times, 3, unseen), FramePoses(times, 2, unseen)
        assert latents.frame_times.tolist() == poses.frame_times.tolist() == once
        values = torch.from_numpy(rng.normal(size=(len(once), 3))).float()
        with torch.no_grad():
            latents.values.copy_(values)
        assert torch.allclose(latents(times), values[[once.index(time) for time in times]])
        assert poses.residual(times)[0].isfinite().all()
