"""Nearest points against every distance in float64, and points that are spread."""

import pytest
import torch

from evsplat import neighbours
from evsplat.body import default_body
from evsplat.neighbours import far_apart, nearest


def clouds(seed: int):
    """A filled box, a sheet, a line with a far outlier, and points that coincide."""
    generator = torch.Generator().manual_seed(seed)
    box = torch.randn(700, 3, generator=generator)
    sheet = box * torch.tensor([1.0, 1.0, 1e-3])
    line = box * torch.tensor([1.0, 0.0, 0.0])
    line[7] = torch.tensor([1e3, -1e3, 5.0])
    twice = torch.cat([box[:150], box[:150]])
    return box, sheet, line, twice, box[:17]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("other", [False, True])
@pytest.mark.parametrize("find", [nearest, neighbours._by_all_distances])
def test_distances_are_the_smallest_of_all(seed, dtype, other, find, monkeypatch):
    monkeypatch.setattr(neighbours, "_ROWS_AT_ONCE", 250)
    for points in clouds(seed):
        k = 4
        points = points.to(dtype)
        queries = points[::3] + 0.1 if other else None
        distance, index = find(points, k, queries)
        every = torch.cdist((points if queries is None else queries).double(), points.double())
        if queries is None:
            every.fill_diagonal_(torch.inf)
            assert (index != torch.arange(len(points))[:, None]).all()
        expected = every.sort(dim=1).values[:, :k]
        assert torch.allclose(distance.double(), expected, rtol=1e-5, atol=1e-6)
        assert torch.allclose(every.gather(1, index), expected, rtol=1e-5, atol=1e-6)
        assert all(len(set(row)) == k for row in index.tolist())


def test_no_queries_have_no_neighbours():
    distance, index = nearest(torch.rand(20, 3), 2, torch.zeros(0, 3))
    assert distance.shape == index.shape == (0, 2)


def test_too_few_points_are_refused():
    with pytest.raises(ValueError, match="4 points have no 4 neighbours"):
        nearest(torch.zeros(4, 3), 4)


def test_points_are_spread_the_same_without_the_compiled_module(monkeypatch):
    points = default_body().sample_surface(700, torch.Generator().manual_seed(0)).points
    rows = far_apart(points, 150)
    assert len(rows.unique()) == 150
    monkeypatch.setattr(neighbours, "runs_native", lambda tensor: False)
    assert torch.equal(rows, far_apart(points, 150))
