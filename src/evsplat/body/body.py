"""A small linear body: rest shape, kinematic tree, forward kinematics and linear blend skinning."""

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from evsplat.body.canonical import leg_spread_rotations
from evsplat.body.kinematics import Kinematics
from evsplat.body.surface import SurfaceSamples, sample_mesh
from evsplat.compiled import native, runs_native

_DERIVED = (
    "_kinematics",
    "_canonical_bones",
    "_to_rest",
    "_to_canonical",
    "_canonical_vertices",
)


@dataclass(frozen=True, eq=False)
class Body:
    """A subject's shaped body; metres, axes of the world."""

    rest_vertices: Float[Tensor, "V 3"]
    faces: Int[Tensor, "F 3"]
    weights: Float[Tensor, "V J"]
    """Skinning weights; rows sum to one."""
    parents: Int[Tensor, "J"]
    """Index of the parent joint, smaller than the own index; -1 for the root, which is joint 0."""
    rest_joints: Float[Tensor, "J 3"]
    joint_names: tuple[str, ...]

    def to(self, device: torch.device | str) -> "Body":
        """The same body with its arrays on ``device``."""
        tensors = (f.name for f in fields(self) if f.name != "joint_names")
        moved = replace(self, **{name: getattr(self, name).to(device) for name in tensors})
        # What follows from them moves along: to derive it anew would read the tree back.
        derived = {name: getattr(self, name).to(device) for name in _DERIVED}
        vars(moved).update(derived)
        return moved

    def joint_transforms(
        self, rotations: Float[Tensor, "*T J 3 3"], transl: Float[Tensor, "*T 3"]
    ) -> Float[Tensor, "*T J 4 4"]:
        """Posed joint frames [R_j | t_j] from rotations local to the parent.

        ``R_j = R_parent r_j``, ``t_j = t_parent + R_parent (rest_j - rest_parent)``; the root
        stands at ``rest_0 + transl``.
        """
        return self._kinematics.frames(rotations, transl)

    def bone_transforms(
        self, rotations: Float[Tensor, "*T J 3 3"], transl: Float[Tensor, "*T 3"]
    ) -> Float[Tensor, "*T J 4 4"]:
        """Transforms of each bone, rest pose to world: ``B_j = [R_j | t_j - R_j rest_j]``."""
        return self.joint_transforms(rotations, transl) @ self._to_rest.to(rotations.dtype)

    def canonical_bone_transforms(self) -> Float[Tensor, "J 4 4"]:
        """Transforms of each bone, rest pose to canonical pose (legs apart)."""
        return self._canonical_bones

    def canonical_vertices(self) -> Float[Tensor, "V 3"]:
        """Vertices in the canonical pose."""
        return self._canonical_vertices

    def canonical_to_world(
        self, rotations: Float[Tensor, "*T J 3 3"], transl: Float[Tensor, "*T 3"]
    ) -> Float[Tensor, "*T J 4 4"]:
        """Transforms of each bone, canonical pose to world (3DGS-Avatar)."""
        return self.joint_transforms(rotations, transl) @ self._to_canonical.to(rotations.dtype)

    def sample_surface(self, count: int, generator: torch.Generator) -> SurfaceSamples:
        """Points spread evenly by area over the canonical mesh, with normals and weights."""
        return sample_mesh(self._canonical_vertices, self.faces, self.weights, count, generator)

    @cached_property
    def _kinematics(self) -> Kinematics:
        return Kinematics.of(self.parents.tolist(), self.rest_joints)

    @cached_property
    def _to_rest(self) -> Float[Tensor, "J 4 4"]:
        """Rest pose to the joint's own frame: its place becomes the origin."""
        shifts = torch.eye(4).repeat(len(self.parents), 1, 1).to(self.rest_joints)
        shifts[:, :3, 3] = -self.rest_joints
        return shifts

    @cached_property
    def _canonical_bones(self) -> Float[Tensor, "J 4 4"]:
        local = leg_spread_rotations(self.parents.tolist(), self.rest_joints, self.joint_names)
        return self.bone_transforms(local, self.rest_joints.new_zeros(3))

    @cached_property
    def _to_canonical(self) -> Float[Tensor, "J 4 4"]:
        """Canonical pose to the joint's own frame."""
        canonical = torch.linalg.inv(self._canonical_bones.double())
        return (self._to_rest.double() @ canonical).to(self._canonical_bones.dtype)

    @cached_property
    def _canonical_vertices(self) -> Float[Tensor, "V 3"]:
        return skin(self.rest_vertices, self.weights, self._canonical_bones[None])[0][0]


def skin(
    points: Float[Tensor, "N 3"] | Float[Tensor, "T N 3"],
    weights: Float[Tensor, "N J"] | Float[Tensor, "T N J"],
    bones: Float[Tensor, "T J 4 4"],
) -> tuple[Float[Tensor, "T N 3"], Float[Tensor, "T N 4 4"]]:
    """Linear blend skinning: points moved by the weighted mean of the bone transforms.

    Returns the moved points and the blended matrices, whose 3x3 part is not a rotation where
    bones disagree (the shear is kept, as in 3DGS-Avatar).
    """
    moved, blended, _ = _skinned(points, weights, bones, linear=False)
    return moved, blended


def skin_with_linear(
    points: Float[Tensor, "N 3"] | Float[Tensor, "T N 3"],
    weights: Float[Tensor, "N J"] | Float[Tensor, "T N J"],
    bones: Float[Tensor, "T J 4 4"],
) -> tuple[Float[Tensor, "T N 3"], Float[Tensor, "T N 4 4"], Float[Tensor, "T N 3 3"]]:
    """`skin`, and the 3x3 part of the matrices for itself, as a rasteriser takes it."""
    return _skinned(points, weights, bones, linear=True)


def _skinned(
    points: Tensor, weights: Tensor, bones: Tensor, *, linear: bool
) -> tuple[Tensor, Tensor, Tensor]:
    if all(map(runs_native, (points, weights, bones))):
        skinned: tuple[Tensor, Tensor, Tensor] = _NativeSkin.apply(
            points.expand(1, -1, -1) if points.dim() == 2 else points,
            weights.expand(1, -1, -1) if weights.dim() == 2 else weights,
            bones,
            linear,
        )
        return skinned
    plain: tuple[Tensor, Tensor, Tensor] = _PlainSkin.apply(points, weights, bones)
    return plain


class _PlainSkin(torch.autograd.Function):
    """`skin` in plain torch; all results' gradients are one of the matrices before they go on."""

    @staticmethod
    def forward(
        ctx: Any, points: Tensor, weights: Tensor, bones: Tensor
    ) -> tuple[Float[Tensor, "T N 3"], Float[Tensor, "T N 4 4"], Float[Tensor, "T N 3 3"]]:
        blended = (weights @ bones.flatten(-2)).unflatten(-1, (4, 4))
        linear = blended[..., :3, :3]
        moved = (linear * points[..., None, :]).sum(-1) + blended[..., :3, 3]
        _without_gradient_of_points(ctx, blended, linear)
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(points, weights, bones, blended)
        return moved, blended, linear

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        points, weights, bones, blended = ctx.saved_tensors
        pad, (by_moved, by_blended, by_linear) = torch.nn.functional.pad, upstream
        if by_moved is None:
            by_moved = blended.new_zeros(*blended.shape[:2], 3)
        moving = by_moved[..., None] * pad(points, (0, 1), value=1.0)[..., None, :]
        if by_linear is not None:
            moving[..., :3].add_(by_linear)
        whole = pad(moving, (0, 0, 0, 1))
        flat = (whole if by_blended is None else whole + by_blended).flatten(-2)
        to_points, to_weights, to_bones = ctx.needs_input_grad
        given = [
            (blended[..., :3, :3] * by_moved[..., None]).sum(-2) if to_points else None,
            flat @ bones.flatten(-2).mT if to_weights else None,
            (weights.mT @ flat).unflatten(-1, (4, 4)) if to_bones else None,
        ]
        return tuple(
            None if grad is None else grad.sum_to_size(like.shape)
            for grad, like in zip(given, (points, weights, bones), strict=True)
        )


def _without_gradient_of_points(ctx: Any, *matrices: Tensor) -> None:
    """Points move the points alone: nobody then works out what the matrices' gradients are."""
    _, to_weights, to_bones, *_ = ctx.needs_input_grad
    if not (to_weights or to_bones):
        ctx.mark_non_differentiable(*matrices)


class _NativeSkin(torch.autograd.Function):
    """`skin` in the compiled module; points and weights have a leading axis of T or 1."""

    @staticmethod
    def forward(
        ctx: Any, points: Tensor, weights: Tensor, bones: Tensor, with_linear: bool
    ) -> tuple[Float[Tensor, "T N 3"], Float[Tensor, "T N 4 4"], Float[Tensor, "T N 3 3"] | None]:
        given = [tensor.detach().contiguous() for tensor in (points, weights, bones)]
        times, count = len(bones), points.shape[1]
        moved, blended = bones.new_empty(times, count, 3), bones.new_empty(times, count, 4, 4)
        linear = bones.new_empty(times, count, 3, 3) if with_linear else None
        native.skin(*given, moved, blended, linear, torch.get_num_threads())
        _without_gradient_of_points(ctx, blended, *(() if linear is None else (linear,)))
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*given, blended)
        return moved, blended, linear

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None) -> tuple[Tensor | None, ...]:
        *given, blended = ctx.saved_tensors
        grads = [
            torch.empty_like(tensor) if needed else None
            for tensor, needed in zip(given, ctx.needs_input_grad[:3], strict=True)
        ]
        above = [None if grad is None else grad.contiguous() for grad in upstream]
        native.skin_backward(*given, blended, *above, *grads, torch.get_num_threads())
        return *grads, None


def bounding_box(body: Body, margin: float = 0.1) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Corners (low, high) of the canonical body, enlarged per side by ``margin`` of the extent."""
    vertices = body.canonical_vertices()
    low, high = vertices.amin(0), vertices.amax(0)
    extent = high - low
    return low - margin * extent, high + margin * extent
