"""The nearest points of a set, and those that are spread over it."""

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from evsplat.compiled import native, runs_native

_ROWS_AT_ONCE = 2_048
"""Distances of so many points to all others are held at a time: 160 MB at 20,000 points."""


def nearest(
    points: Float[Tensor, "N 3"], k: int, queries: Float[Tensor, "M 3"] | None = None
) -> tuple[Float[Tensor, "M k"], Int[Tensor, "M k"]]:
    """Distances to the k nearest of ``points``, and their rows, nearest first.

    Without ``queries`` those of the points themselves, none of which is its own neighbour. On the
    CPU a k-d tree finds them, elsewhere all distances, without the host waiting; the result lies
    where the points do. A ValueError where there are too few points.
    """
    if len(points) < k + (queries is None):
        raise ValueError(f"{len(points)} points have no {k} neighbours each")
    if points.device.type != "cpu":
        return _by_all_distances(points.detach(), k, None if queries is None else queries.detach())
    places = points.detach().numpy()
    asked = places if queries is None else queries.detach().numpy()
    ranks, workers = range(1, k + 1 + (queries is None)), torch.get_num_threads()
    found = cKDTree(places).query(asked, k=ranks, workers=workers)
    distance, index = (torch.from_numpy(values) for values in found)
    if queries is None:
        # A point comes first among its own neighbours, unless others lie at the same place.
        itself = index == torch.arange(len(index))[:, None]
        order = itself.int().argsort(dim=1, stable=True)[:, :k]
        distance, index = distance.gather(1, order), index.gather(1, order)
    return distance.to(points), index


def median_around(points: Float[Tensor, "N 3"], values: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """Median of the values of each point's 16 nearest others, or of all where there are fewer."""
    return values[nearest(points, min(16, len(points) - 1))[1]].median(1).values


def _by_all_distances(
    points: Float[Tensor, "N 3"], k: int, queries: Float[Tensor, "M 3"] | None
) -> tuple[Float[Tensor, "M k"], Int[Tensor, "M k"]]:
    asked = points if queries is None else queries
    distances, rows = [], []
    for start in range(0, max(1, len(asked)), _ROWS_AT_ONCE):
        some = asked[start : start + _ROWS_AT_ONCE]
        # Differences, not products of matrices, whose rounding exceeds what neighbours differ by.
        all_of = torch.cdist(some, points, compute_mode="donot_use_mm_for_euclid_dist")
        if queries is None:
            own = torch.arange(start, start + len(some), device=points.device)
            all_of.scatter_(1, own[:, None], torch.inf)
        found = all_of.topk(k, largest=False)
        distances.append(found.values)
        rows.append(found.indices)
    return torch.cat(distances), torch.cat(rows)


def far_apart(points: Float[Tensor, "N 3"], count: int) -> Int[Tensor, "M"]:
    """Rows of ``count`` points, the first one and then each the farthest from those before it."""
    chosen = torch.zeros(count, dtype=torch.long)
    points = points.detach()
    if runs_native(points):
        native.spread_points(points.contiguous(), chosen)
        return chosen
    distance = (points - points[0]).square().sum(-1)
    for k in range(1, count):
        chosen[k] = distance.argmax()
        distance = torch.minimum(distance, (points - points[chosen[k]]).square().sum(-1))
    return chosen
