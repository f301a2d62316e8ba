"""Changing class: a Gaussian whose learned attribute crosses 0.5 moves to the other space (A6)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from evsplat.body import Body, skin
from evsplat.body.rotations import matrix_to_quaternion, quaternion_multiply
from evsplat.gaussians.densify import rebuild
from evsplat.gaussians.gaussian_set import GaussianSet
from evsplat.gaussians.row_adam import RowAdam
from evsplat.neighbours import nearest

REACH_M = 0.15
"""A scene Gaussian farther than this from the posed body in every frame cannot be the person's."""


@dataclass(frozen=True)
class BodyFrames:
    """The body at training frames, to carry Gaussians between canonical and world space."""

    body: Body
    bones: Float[Tensor, "T J 4 4"]
    """Canonical to world, one set per frame."""


def flip_labels(gaussians: GaussianSet, optimiser: RowAdam, frames: BodyFrames) -> int:
    """Move every row whose soft label disagrees with its class; returns their number.

    Person to scene: see `to_world`. Scene to person: see `to_canonical`; beyond `REACH_M` the row
    stays in the scene and its logit returns to the boundary. The two classes have separate colour
    networks, to which the other's features mean nothing, or a different light in their colours: a
    moved row takes the colour of the nearest row of its new class.
    """
    wants_human = gaussians.semantic_logits.detach() > 0
    human = gaussians.human_mask()
    leaving = torch.nonzero(human & ~wants_human)[:, 0]
    joining = torch.nonzero(~human & wants_human)[:, 0]
    if len(leaving) + len(joining) == 0:
        return 0
    values = {name: getattr(gaussians, name).detach().clone() for name in gaussians.attributes}

    if len(leaving):
        carry(values, leaving, to_world(frames, values["means"][leaving]))
        _take_colour(gaussians.colour, values, leaving, torch.nonzero(~human)[:, 0])
    if len(joining):
        near, transforms = to_canonical(frames, values["means"][joining])
        values["semantic_logits"][joining[~near]] = 0.0
        joining = joining[near]
        carry(values, joining, transforms)
        # Those that leave are in the scene already, place and colour.
        staying = torch.nonzero(human & wants_human)[:, 0]
        _take_colour(gaussians.colour, values, joining, staying)

    moved = torch.zeros_like(human)
    moved[leaving] = True
    moved[joining] = True
    source = torch.arange(len(gaussians), device=human.device)
    rebuild(gaussians, optimiser, values, source, moved, human ^ moved)
    return int(moved.sum())


def carry(values: dict[str, Tensor], rows: Tensor, transforms: Float[Tensor, "M 4 4"]) -> None:
    """Apply rigid-like transforms to centres and rotations of some rows, in place."""
    turn = matrix_to_quaternion(transforms[:, :3, :3])
    values["means"][rows] = applied(transforms, values["means"][rows])
    values["quaternions"][rows] = quaternion_multiply(turn, values["quaternions"][rows])


def to_world(frames: BodyFrames, means: Float[Tensor, "M 3"]) -> Float[Tensor, "M 4 4"]:
    """Transforms that place the person's rows, by canonical centres, in the scene.

    The nearest body vertex carries them, at the frame that brings them nearest to the mean of their
    places over all frames: what does not move with the body is best explained where it dwells.
    """
    if len(means) == 0:
        return means.new_zeros(0, 4, 4)
    vertex = nearest_row(frames.body.canonical_vertices(), means)[1]
    places = torch.stack(
        [applied(_blend(frames, vertex, number), means) for number in range(len(frames.bones))]
    )
    dwelling = (places - places.mean(0)).square().sum(-1).argmin(0)
    return _blend(frames, vertex, dwelling)


def to_canonical(
    frames: BodyFrames, points: Float[Tensor, "M 3"]
) -> tuple[Bool[Tensor, " M"], Float[Tensor, "K 4 4"]]:
    """Mask of the scene rows that can be the person's, and transforms that place these K on it.

    The nearest posed body vertex over all frames carries a row back; it lies within `REACH_M`.
    """
    distance, frame, vertex = _nearest_over_frames(frames, points)
    near = distance <= REACH_M
    return near, torch.linalg.inv(_blend(frames, vertex[near], frame[near]))


def _take_colour(name: str, values: dict[str, Tensor], rows: Tensor, others: Tensor) -> None:
    """Copy attribute ``name`` of the nearest of ``others`` to ``rows``, in place."""
    if len(others):
        source = nearest_row(values["means"][others], values["means"][rows])[1]
        values[name][rows] = values[name][others[source]]


def _blend(
    frames: BodyFrames, vertex: Int[Tensor, " M"], frame: Int[Tensor, " M"] | int
) -> Float[Tensor, "M 4 4"]:
    """Skinning transform of body vertices at given frames."""
    weights = frames.body.weights[vertex]
    if isinstance(frame, int):
        return torch.einsum("mj,jab->mab", weights, frames.bones[frame])
    return torch.einsum("mj,mjab->mab", weights, frames.bones[frame])


def applied(
    transforms: Float[Tensor, "M 4 4"], points: Float[Tensor, "M 3"]
) -> Float[Tensor, "M 3"]:
    """Points after transforms, one each."""
    return (transforms[:, :3, :3] @ points[..., None])[..., 0] + transforms[:, :3, 3]


def nearest_row(
    points: Float[Tensor, "V 3"], queries: Float[Tensor, "M 3"]
) -> tuple[Float[Tensor, " M"], Int[Tensor, " M"]]:
    """Distance to the nearest of ``points`` and its row, per query."""
    distance, index = nearest(points, 1, queries)
    return distance[:, 0], index[:, 0]


def _nearest_over_frames(
    frames: BodyFrames, points: Float[Tensor, "M 3"]
) -> tuple[Float[Tensor, " M"], Int[Tensor, " M"], Int[Tensor, " M"]]:
    """Distance, frame and vertex of the nearest posed body vertex over all frames.

    Points farther than `REACH_M` from the body's box in every frame are at an infinite distance.
    """
    canonical = frames.body.canonical_vertices()
    best = torch.full((len(points),), torch.inf, device=points.device)
    best_frame = torch.zeros(len(points), dtype=torch.long, device=points.device)
    best_vertex = torch.zeros_like(best_frame)
    for number in range(len(frames.bones)):
        posed, _ = skin(canonical, frames.body.weights, frames.bones[number : number + 1])
        low, high = posed[0].amin(0) - REACH_M, posed[0].amax(0) + REACH_M
        rows = torch.nonzero(((points >= low) & (points <= high)).all(-1))[:, 0]
        if len(rows) == 0:
            continue
        distance, vertex = nearest_row(posed[0], points[rows])
        better = distance < best[rows]
        rows = rows[better]
        best[rows], best_frame[rows], best_vertex[rows] = distance[better], number, vertex[better]
    return best, best_frame, best_vertex
