"""Rows left out of a picture, against those that the rasteriser draws."""

from types import SimpleNamespace

import pytest
import torch

from evsplat.render import Splats, render, rows_in_view


def camera_at(generator, *, shifted):
    turn = torch.linalg.qr(torch.randn(3, 3, generator=generator)).Q
    pose = torch.eye(4)
    pose[:3, :3], pose[:3, 3] = turn * turn.det().sign(), torch.randn(3, generator=generator)
    # Shifted: the optical axis meets no pixel.
    K = torch.tensor([[70.0, 0, -40.0 if shifted else 30.0], [0, 65.0, 26.0], [0, 0, 1]])
    return SimpleNamespace(width=64, height=48, K=K, world_to_camera=pose)


@pytest.mark.parametrize("shifted", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_no_row_is_left_out_that_is_drawn(seed, shifted):
    generator = torch.Generator().manual_seed(seed)
    camera, count = camera_at(generator, shifted=shifted), 4_000
    means = 3 * torch.randn(count, 3, generator=generator)
    scales = (1.5 * torch.randn(count, 3, generator=generator) - 3).exp()
    means[7] = float("nan")
    splats = Splats(
        means,
        torch.randn(count, 4, generator=generator),
        scales,
        torch.ones(count),
        torch.ones(count, 1),
    )
    drawn = set(torch.nonzero(render(splats, camera).radii[0])[:, 0].tolist())
    rows = rows_in_view(means, scales, camera).tolist()
    assert rows == sorted(set(rows)) and drawn <= set(rows)
    # The bound is that of a ball, so that it holds not many others.
    assert 50 < len(drawn) and len(rows) < 4 * len(drawn)


def test_all_rows_in_view_need_no_list():
    camera = camera_at(torch.Generator().manual_seed(0), shifted=False)
    ahead = torch.linalg.inv(camera.world_to_camera)[:3] @ torch.tensor([0.0, 0, 2, 1])
    assert rows_in_view(ahead.expand(5, 3), torch.full((5, 3), 0.1), camera) is None
    assert rows_in_view(ahead.double().expand(5, 3), torch.ones(5, 3).double(), camera) is None
