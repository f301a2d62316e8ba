"""Changing class: a Gaussian whose learned attribute crosses 0.5 moves to the other space (A6)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from evsplat.body import Body, skin
from evsplat.body.rotations import matrix_to_quaternion, quaternion_multiply
from evsplat.gaussians.densify import rebuild
from evsplat.gaussians.gaussian_set import ATTRIBUTES, GaussianSet
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


def flip_labels(gaussians: GaussianSet, optimiser: RowAdam, frames: BodyFrames, drawn: int) -> int:
    """Move every row whose soft label disagrees with its class; how many moved.

    Person to scene: placed where the body carries it at frame ``drawn``, the one rendered last.
    Scene to person: carried back by the nearest body vertex over all frames; beyond `REACH_M` of
    all of them the row stays in the scene and its logit returns to the boundary. The two classes
    have separate colour networks, to which the other's features mean nothing: a moved row takes
    those of the nearest row of its new class.
    """
    wants_human = gaussians.semantic_logits.detach() > 0
    human = gaussians.human_mask()
    leaving = torch.nonzero(human & ~wants_human)[:, 0]
    joining = torch.nonzero(~human & wants_human)[:, 0]
    if len(leaving) + len(joining) == 0:
        return 0
    values = {name: getattr(gaussians, name).detach().clone() for name in ATTRIBUTES}

    if len(leaving):
        vertices = frames.body.canonical_vertices()
        vertex = _nearest(vertices, values["means"][leaving])[1]
        transforms = _blend(frames, vertex, torch.full_like(vertex, drawn))
        carry(values, leaving, transforms)
        _take_features(values, leaving, torch.nonzero(~human)[:, 0])
    if len(joining):
        distance, frame, vertex = _nearest_over_frames(frames, values["means"][joining])
        near = distance <= REACH_M
        values["semantic_logits"][joining[~near]] = 0.0
        joining = joining[near]
        transforms = torch.linalg.inv(_blend(frames, vertex[near], frame[near]))
        carry(values, joining, transforms)
        _take_features(values, joining, torch.nonzero(human)[:, 0])

    moved = torch.zeros_like(human)
    moved[leaving] = True
    moved[joining] = True
    source = torch.arange(len(gaussians), device=human.device)
    rebuild(gaussians, optimiser, values, source, moved, human ^ moved)
    return int(moved.sum())


def carry(values: dict[str, Tensor], rows: Tensor, transforms: Float[Tensor, "M 4 4"]) -> None:
    """Apply rigid-like transforms to centres and rotations of some rows, in place."""
    rotation, translation = transforms[:, :3, :3], transforms[:, :3, 3]
    values["means"][rows] = (rotation @ values["means"][rows][..., None])[..., 0] + translation
    turn = matrix_to_quaternion(rotation)
    values["quaternions"][rows] = quaternion_multiply(turn, values["quaternions"][rows])


def _take_features(values: dict[str, Tensor], rows: Tensor, others: Tensor) -> None:
    """Copy the colour features of the nearest of ``others`` to ``rows``, in place."""
    if len(others):
        source = _nearest(values["means"][others], values["means"][rows])[1]
        values["features"][rows] = values["features"][others[source]]


def _blend(
    frames: BodyFrames, vertex: Int[Tensor, " M"], frame: Int[Tensor, " M"]
) -> Float[Tensor, "M 4 4"]:
    """Skinning transform of body vertices at given frames."""
    return torch.einsum("mj,mjab->mab", frames.body.weights[vertex], frames.bones[frame])


def _nearest(
    vertices: Float[Tensor, "V 3"], points: Float[Tensor, "M 3"]
) -> tuple[Float[Tensor, " M"], Int[Tensor, " M"]]:
    distance, index = nearest(vertices, 1, points)
    return distance[:, 0], index[:, 0]


def _nearest_over_frames(
    frames: BodyFrames, points: Float[Tensor, "M 3"]
) -> tuple[Float[Tensor, " M"], Int[Tensor, " M"], Int[Tensor, " M"]]:
    """Distance, frame and vertex of the nearest posed body vertex over all frames."""
    canonical = frames.body.canonical_vertices()
    best = torch.full((len(points),), torch.inf, device=points.device)
    best_frame = torch.zeros(len(points), dtype=torch.long, device=points.device)
    best_vertex = torch.zeros_like(best_frame)
    for number in range(len(frames.bones)):
        posed, _ = skin(canonical, frames.body.weights, frames.bones[number : number + 1])
        distance, vertex = _nearest(posed[0], points)
        better = distance < best
        best = torch.where(better, distance, best)
        best_frame[better] = number
        best_vertex = torch.where(better, vertex, best_vertex)
    return best, best_frame, best_vertex
