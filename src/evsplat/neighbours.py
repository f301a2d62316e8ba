"""The nearest points of a set."""

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from evsplat.compiled import native, runs_native


def nearest(
    points: Float[Tensor, "N 3"], k: int, queries: Float[Tensor, "M 3"] | None = None
) -> tuple[Float[Tensor, "M k"], Int[Tensor, "M k"]]:
    """Distances to the k nearest of ``points``, and their rows, nearest first.

    Without ``queries`` those of the points themselves, none of which is its own neighbour. Found on
    the CPU whatever the device; the result lies where the points do. A ValueError where there are
    too few points.
    """
    if len(points) < k + (queries is None):
        raise ValueError(f"{len(points)} points have no {k} neighbours each")
    places = points.detach().cpu().contiguous()
    asked = places if queries is None else queries.detach().cpu().contiguous()
    if runs_native(places) and runs_native(asked):
        index, square = torch.empty(len(asked), k, dtype=torch.long), torch.empty(len(asked), k)
        others = None if queries is None else asked
        native.nearest(places, others, index, square, torch.get_num_threads())
        return square.sqrt().to(points.device), index.to(points.device)
    found = cKDTree(places.numpy()).query(asked.numpy(), k=range(1, k + 1 + (queries is None)))
    distance, index = (torch.from_numpy(values) for values in found)
    if queries is None:
        # A point comes first among its own neighbours, unless others lie at the same place.
        itself = index == torch.arange(len(index))[:, None]
        order = itself.int().argsort(dim=1, stable=True)[:, :k]
        distance, index = distance.gather(1, order), index.gather(1, order)
    return distance.to(points), index.to(points.device)
