"""Neighbours along a person's surface and across its middle, and values that follow from them."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from scipy import sparse
from scipy.sparse.linalg import splu
from torch import Tensor
from torch.nn.functional import normalize

from evsplat.body import Body
from evsplat.body.canonical import side_and_core
from evsplat.neighbours import nearest

Plane = tuple[Float[Tensor, "3"], Float[Tensor, "3"]]
"""A point of a plane and its unit normal."""

_NEIGHBOURS = 8
_MIRRORED = 4
_MIRROR = 0.3
"""A link to the other side, against one to a neighbour."""
_LEAST_FACING = 0.02
_LEAST_LINK = 1e-6
"""Of each neighbour, so that none is without any."""
_LEAST_DIAGONAL = 1e-6


def mirror_plane(body: Body) -> Plane | None:
    """The plane between left and right in the canonical pose; None where no joints are paired."""
    bones = body.canonical_bone_transforms()
    joints = (bones[:, :3, :3] @ body.rest_joints[:, :, None])[..., 0] + bones[:, :3, 3]
    sides: dict[str, dict[str, Tensor]] = {}
    for joint, name in zip(joints, body.joint_names, strict=False):
        side, core = side_and_core(name)
        if side is not None:
            sides.setdefault(core, {})[side] = joint
    pairs = [(pair["left"], pair["right"]) for pair in sides.values() if len(pair) == 2]
    if not pairs:
        return None
    left, right = (torch.stack(joints) for joints in zip(*pairs, strict=True))
    return ((left + right) / 2).mean(0), normalize((left - right).mean(0), dim=0)


def laplacian(
    points: Float[Tensor, "N 3"],
    normals: Float[Tensor, "N 3"],
    bones: Float[Tensor, "N J"],
    plane: Plane | None,
) -> sparse.csr_matrix:
    """Symmetric Laplacian of the graph of a surface's points, N x N; its rows sum to 0.

    Linked are the eight nearest in space, the weaker the farther they are, the less their
    ``normals`` agree and the less the skinning weights of their ``bones``, so that nothing jumps
    through the air from limb to limb; and weakly what lies at the place reflected by ``plane``.
    """
    points, normals = points.detach().cpu(), normals.detach().cpu()
    hung = normalize(bones.detach().cpu(), dim=-1)
    distances, index = nearest(points, min(_NEIGHBOURS, len(points) - 1))
    width = 2 * float(distances.median().clamp_min(1e-9))
    facing = (normals[:, None] * normals[index]).sum(-1).clamp_min(_LEAST_FACING)
    alike = (hung[:, None] * hung[index]).sum(-1)
    links = (-(distances / width).square()).exp() * facing * alike + _LEAST_LINK
    graph = _links(links, index)
    if plane is not None:
        place, across = plane[0].cpu(), plane[1].cpu()
        reflected = points - 2 * ((points - place) @ across)[:, None] * across
        turned = normals - 2 * (normals @ across)[:, None] * across
        distances, index = nearest(points, min(_MIRRORED, len(points)), reflected)
        facing = (turned[:, None] * normals[index]).sum(-1).clamp_min(0)
        graph = graph + _links(_MIRROR * (-(distances / width).square()).exp() * facing, index)
    graph = (graph + graph.T) / 2
    return sparse.diags(np.asarray(graph.sum(1)).ravel()) - graph


def _links(weights: Float[Tensor, "N k"], index: Tensor) -> sparse.csr_matrix:
    rows = torch.arange(len(index))[:, None].expand_as(index).reshape(-1).numpy()
    values = weights.double().reshape(-1).numpy()
    shape = (len(index), len(index))
    return sparse.coo_matrix((values, (rows, index.reshape(-1).numpy())), shape=shape).tocsr()


def harmonic(
    values: Float[Tensor, "N C"], sure: Float[Tensor, " N"], rough: sparse.csr_matrix
) -> Float[Tensor, "N C"]:
    """Values x that minimise ``sum sure (x - values)^2 + x^T rough x``.

    Where nothing is sure they are harmonic: each is the mean of its neighbours by their links.
    """
    known = sure.detach().cpu().double().clamp_min(_LEAST_DIAGONAL).numpy()
    solve = splu((sparse.diags(known) + rough).tocsc()).solve
    return torch.from_numpy(solve(known[:, None] * values.detach().cpu().double().numpy())).to(
        values
    )


def closest(
    prior: Float[Tensor, "N C"],
    pull: Float[Tensor, "N C"],
    seen: Callable[[Float[Tensor, "N C"]], Float[Tensor, "N C"]],
    diagonal: Float[Tensor, " N"],
    strength: Float[Tensor, " N"],
    hue: Float[Tensor, " N"],
    steps: int,
    start: Float[Tensor, "N C"] | None = None,
) -> Float[Tensor, "N C"]:
    """Values x that minimise ``|J x - b|^2 + sum strength d^2 + hue (d - mean of d over C)^2``.

    d is ``x - prior``: what all C columns have in common is brightness, the rest hue. ``pull``:
    ``J^T (b - J prior)``; ``seen`` applies ``J^T J``, whose ``diagonal`` is known more or less:
    ``steps`` of conjugate gradients conditioned by it, one being enough where there is nothing but
    it. ``start``: where they begin, otherwise at ``prior``.
    """
    held, tinted = strength.double()[:, None], hue.double()[:, None]
    scale = diagonal.double()[:, None] + held
    change = torch.zeros_like(prior, dtype=torch.float64)
    left = pull.double()
    if start is not None:
        change = start.double() - prior.double()
        left = left - seen(change.to(prior)).double() - _by_parts(change, held, held + tinted)
    ahead = _by_parts(left, 1 / scale, 1 / (scale + tinted))
    direction, size = ahead, (left * ahead).sum()
    least = torch.finfo(size.dtype).tiny
    for _ in range(steps):
        image = seen(direction.to(prior)).double() + _by_parts(direction, held, held + tinted)
        way = size / (direction * image).sum().clamp_min(least)
        change = change + way * direction
        left = left - way * image
        ahead = _by_parts(left, 1 / scale, 1 / (scale + tinted))
        before, size = size, (left * ahead).sum()
        direction = ahead + size / before.clamp_min(least) * direction
    return prior + change.to(prior)


def _by_parts(values: Tensor, brightness: Tensor, hue: Tensor) -> Tensor:
    """Each row's mean times one factor, and what differs from it times the other."""
    mean = values.mean(1, keepdim=True)
    return brightness * mean + hue * (values - mean)
