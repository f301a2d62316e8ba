"""What no training picture shows of the person: colours from around, light that stays calm.

A Gaussian that hardly any pixel depends on has the colour that Adam made of noise, and light at
normals that no picture shows is what a polynomial does beyond its data. After training both give
way to a prior where little was seen; what was seen well stays.
"""

import numpy as np
import torch
from jaxtyping import Float
from scipy import sparse
from scipy.sparse.linalg import splu
from torch import Tensor, nn

from evsplat.models.discs.model import DiscModel
from evsplat.models.discs.shading import Shading
from evsplat.neighbours import nearest

LEAST_SEEN_PX = 0.3
"""Squares of transmittance times alpha (`evsplat.models.seen`) below which a colour is unknown."""
_TRUST = 10.0
"""Weight of one pixel's worth of a colour that is known, against that of a neighbour."""
_NEIGHBOURS = 8
_LEAST_ALIKE = 0.02
"""Of surfaces that turn away from each other, or hang on other bones."""
_LIGHT_PRIOR = 0.03
"""Weight of the mean light at normals of all directions, against what was seen."""


@torch.no_grad()
def fill_unseen(model: DiscModel, squares: Float[Tensor, "H"], strength: float) -> None:
    """Give the little-seen Gaussians of a trained person the colours of those around them.

    The three logits x of all colours minimise ``sum C (x - x0)^2 + strength x' L x``: C is what was
    seen of each, 0 below `LEAST_SEEN_PX`; L the Laplacian of the graph of nearest neighbours in
    canonical space, whose edges are weak where normals differ or other bones pull.
    """
    gaussians = model.gaussians
    rows = gaussians.human
    colours = gaussians.get_parameter(gaussians.colour)
    if gaussians.human_count <= _NEIGHBOURS or not bool((squares > LEAST_SEEN_PX).any()):
        return
    known = torch.where(squares > LEAST_SEEN_PX, _TRUST * squares, 0.0)
    means = gaussians.means[rows].detach()
    laplacian = _laplacian(means, model.surface.normals(means), model.surface.weights(means))
    found = harmonic(colours[rows, :3], known, strength, laplacian)
    colours[rows, :3] = found.to(colours)


def harmonic(
    values: Float[Tensor, "N C"],
    known: Float[Tensor, "N"],
    strength: float,
    laplacian: sparse.csr_array,
) -> Float[Tensor, "N C"]:
    """Solve ``(K + strength L) x = K values`` with K the diagonal of ``known``."""
    # Islands of which nothing is known stay as they are.
    weights = known.double().cpu().numpy() + 1e-9
    system = sparse.diags_array(weights) + strength * laplacian
    solved = splu(system.tocsc()).solve(weights[:, None] * values.double().cpu().numpy())
    return torch.from_numpy(solved)


def _laplacian(
    means: Float[Tensor, "N 3"], normals: Float[Tensor, "N 3"], bones: Float[Tensor, "N J"]
) -> sparse.csr_array:
    """Graph of neighbours on one surface: near, turned alike, moved by the same bones."""
    distances, index = nearest(means, _NEIGHBOURS)
    scale = 2 * distances.median()
    bones = nn.functional.normalize(bones, dim=-1)
    weights = torch.exp(-((distances / scale) ** 2))
    for values in (normals, bones):
        weights = weights * (values[:, None] * values[index]).sum(-1).clamp_min(_LEAST_ALIKE)
    count = len(means)
    rows = np.repeat(np.arange(count), _NEIGHBOURS)
    edges = (weights.double().cpu().numpy().ravel(), (rows, index.cpu().numpy().ravel()))
    graph = sparse.coo_array(edges, shape=(count, count)).tocsr()
    graph = (graph + graph.T) / 2
    return sparse.csr_array(sparse.diags_array(graph.sum(1)) - graph)


@torch.no_grad()
def calm_light(
    shading: Shading,
    normals: list[Float[Tensor, "H 3"]],
    places: list[Float[Tensor, "H 3"]],
    squares: Float[Tensor, "H"],
) -> None:
    """Let the light at normals that no picture shows be the mean of what was seen.

    Ridge regression of the polynomial of `Shading` on its own values at the world normals and
    places of the training times, weighted by what was seen, and, much weaker, on their mean at the
    same places for normals of all directions.
    """
    generator = torch.Generator().manual_seed(0)
    learned = shading.coefficients.double().flatten(0, 1)
    size = len(learned)
    seen, everywhere = learned.new_zeros(size, size), learned.new_zeros(size, size)
    toward, anywhere = learned.new_zeros(size, 3), learned.new_zeros(size)
    total, mean = learned.new_zeros(()), learned.new_zeros(3)
    weights = squares.double()[:, None]
    for turned, moved in zip(normals, places, strict=True):
        design = shading.polynomial(turned, moved).double()
        light = design @ learned
        seen += design.T @ (weights * design)
        toward += design.T @ (weights * light)
        mean += (weights * light).sum(0)
        total += weights.sum()
        drawn = torch.randn(turned.shape, generator=generator).to(turned)
        free = shading.polynomial(nn.functional.normalize(drawn, dim=-1), moved).double()
        everywhere += free.T @ free / len(free)
        anywhere += free.mean(0)
    if float(total) <= 0:
        return
    weight = _LIGHT_PRIOR * total / len(normals)
    goal = toward + weight * anywhere[:, None] * (mean / total)
    found = torch.linalg.solve(seen + weight * everywhere, goal)
    shading.coefficients.copy_(found.view_as(shading.coefficients))
