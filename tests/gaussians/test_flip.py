"""Changing class: places, labels, features and moments of what moves."""

import pytest
import torch

from evsplat.body import Body
from evsplat.gaussians import (
    FEATURE_DIM,
    BodyFrames,
    GaussianSet,
    RowAdam,
    flip_labels,
    step_together,
)
from evsplat.gaussians.flip import REACH_M
from evsplat.gaussians.initialise import gaussians_at


def frames_of(body: Body, seed: int) -> BodyFrames:
    """Three poses: small turns of all joints, and a walk away from the origin."""
    generator = torch.Generator().manual_seed(seed)
    joints = len(body.parents)
    angles = 0.2 * torch.randn(3, joints, 3, generator=generator)
    skew = torch.zeros(3, joints, 3, 3)
    skew[..., 0, 1], skew[..., 0, 2], skew[..., 1, 2] = (
        -angles[..., 2],
        angles[..., 1],
        -angles[..., 0],
    )
    skew = skew - skew.transpose(-1, -2)
    rotations = torch.linalg.matrix_exp(skew)
    translation = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.5, 0.0], [2.0, -0.5, 0.0]])
    return BodyFrames(body, body.canonical_to_world(rotations, translation))


def start(
    points: torch.Tensor, semantic: float, colour: float, feature_dim: int | None
) -> dict[str, torch.Tensor]:
    values = gaussians_at(
        points,
        torch.full_like(points, 0.01),
        opacity=0.5,
        semantic_logit=semantic,
        feature_dim=feature_dim,
    )
    name = "features" if feature_dim else "colour_logits"
    return values | {name: torch.full_like(values[name], colour)}


def make(
    human: torch.Tensor, scene: torch.Tensor, feature_dim: int | None = FEATURE_DIM
) -> tuple[GaussianSet, RowAdam]:
    gaussians = GaussianSet(
        start(human, 2.0, 1.0, feature_dim), start(scene, -2.0, -1.0, feature_dim)
    )
    names = gaussians.attributes
    adam = RowAdam({name: getattr(gaussians, name) for name in names}, dict.fromkeys(names, 1e-3))
    sum((getattr(gaussians, name) ** 2).sum() for name in names).backward()
    step_together([adam.adam])
    return gaussians, adam


@pytest.mark.parametrize("seed", range(3))
def test_there_and_back_again_is_the_same_place(body, seed):
    frames = frames_of(body, seed)
    generator = torch.Generator().manual_seed(seed)
    vertices = body.canonical_vertices()
    chosen = torch.randint(len(vertices), (30,), generator=generator)
    far = torch.tensor([[9.0, 9.0, 9.0]]).repeat(5, 1)
    gaussians, adam = make(vertices[chosen], far)
    with torch.no_grad():
        gaussians.semantic_logits[:10] = -0.5
    before = gaussians.means.detach()[:10].clone()

    assert flip_labels(gaussians, adam, frames) == 10
    assert (gaussians.human_count, gaussians.scene_count) == (20, 15)
    weights = body.weights[chosen[:10]]
    matrices = torch.einsum("mj,fjab->fmab", weights, frames.bones)
    places = (matrices[..., :3, :3] @ before[..., None])[..., 0] + matrices[..., :3, 3]
    # The frame at which a row is nearest to where it is on average.
    frame = (places - places.mean(0)).norm(dim=-1).argmin(0)
    posed = places[frame, torch.arange(10)]
    moved = torch.cdist(posed, gaussians.means.detach()[gaussians.scene]).amin(1)
    assert moved.max() < 1e-4

    with torch.no_grad():
        rows = torch.nonzero(gaussians.means[gaussians.scene].norm(dim=-1) < 8)[:, 0]
        gaussians.semantic_logits[rows + gaussians.human_count] = 0.5
    assert flip_labels(gaussians, adam, frames) == 10
    assert gaussians.human_count == 30
    back = torch.cdist(before, gaussians.means.detach()[gaussians.human]).amin(1)
    # The nearest posed vertex may be another one, whose weights differ a little.
    assert back.median() < 1e-3
    assert back.max() < 0.02


@pytest.mark.parametrize("feature_dim", [FEATURE_DIM, None])
def test_colours_are_those_of_the_nearest_row_of_the_new_class(body, feature_dim):
    frames = frames_of(body, 0)
    gaussians, adam = make(body.canonical_vertices()[::500], torch.randn(6, 3), feature_dim)
    name = gaussians.colour
    assert name == ("features" if feature_dim else "colour_logits")
    with torch.no_grad():
        gaussians.semantic_logits[0] = -1.0
        colours = gaussians.get_parameter(name)
        colours[gaussians.scene] = torch.arange(6.0)[:, None] * torch.ones(colours.shape[1])
    others = gaussians.means.detach()[gaussians.scene].clone()
    flip_labels(gaussians, adam, frames)
    (new,) = torch.nonzero(gaussians.semantic_logits[gaussians.scene] == -1.0)[:, 0].tolist()
    row = gaussians.human_count + new
    nearest = float(torch.cdist(gaussians.means.detach()[row][None], others).argmin())
    assert (gaussians.get_parameter(name)[row] == nearest).all()
    (group,) = [g for g in adam.adam.param_groups if g["name"] == name]
    assert (adam.adam.state[group["params"][0]]["exp_avg"][row] == 0).all()


def test_what_is_far_from_the_body_stays_in_the_scene(body):
    frames = frames_of(body, 1)
    posed = body.canonical_vertices()[:1] + torch.tensor([[0.0, 0.0, 50 * REACH_M]])
    gaussians, adam = make(body.canonical_vertices()[::500], posed)
    with torch.no_grad():
        gaussians.semantic_logits[-1] = 1.0
    assert flip_labels(gaussians, adam, frames) == 0
    assert gaussians.scene_count == 1
    assert gaussians.semantic_logits[-1] == 0.0


def test_what_joins_takes_no_colour_of_what_leaves_at_the_same_time(body, rng):
    """The body stands as in canonical space, so that one who leaves may be the nearest in it."""
    frames = BodyFrames(body, torch.eye(4).repeat(1, len(body.parents), 1, 1))
    vertices = body.canonical_vertices()
    chosen = vertices[rng.choice(len(vertices), 12, replace=False)]
    joins = chosen[:1] + 1e-4
    gaussians, adam = make(chosen, torch.cat([joins, chosen[:1] + 9]))
    with torch.no_grad():
        gaussians.semantic_logits[0] = -0.5
        gaussians.semantic_logits[gaussians.human_count] = 0.5
        colours = gaussians.get_parameter(gaussians.colour)
        colours[gaussians.human] = torch.arange(12.0)[:, None]
    assert flip_labels(gaussians, adam, frames) == 2
    row = int((gaussians.semantic_logits[gaussians.human] == 0.5).nonzero())
    nearest = 1 + int(torch.cdist(joins, chosen[1:]).argmin())
    assert (gaussians.get_parameter(gaussians.colour)[row] == nearest).all()
