"""Non-rigid change of canonical Gaussians by the pose: clothes and muscles (paper eq. 1)."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from evsplat.body import Body
from evsplat.compiled import native, runs_native
from evsplat.devices import constant, send
from evsplat.models.networks.body_box import BodyBox
from evsplat.models.networks.mlp import PointMLP
from evsplat.models.networks.pose_encoder import PoseEncoder, normalise_joints

COLOUR_FEATURE_DIM = 16
"""Values for the network of the person's colour."""
_NOISE_PROBABILITY = 0.5


class OneBlobEncoding(nn.Module):
    """A smooth bump per axis, integrated over equal bins; no parameters.

    The bump is the quartic kernel ``15/16 (1 - u^2)^2`` with a radius of one bin, and what falls
    off one end comes in at the other, so that each axis sums to one (tiny-cuda-nn's one-blob). The
    released 3DGS-Avatar asks for a hash grid and most likely gets this: 16 bins, 48 values
    (3DGS-Avatar); the smooth one generalises better to held-out poses.
    """

    between: Tensor
    edges: Tensor
    rest: Tensor

    def __init__(self, bins: int = 16) -> None:
        super().__init__()
        if bins < 3:
            raise ValueError(f"bins is {bins}, expected at least 3: a bump touches three of them")
        self.bins = bins
        self.dim = 3 * bins
        # Each bin has what lies between its edges; the ends fall into the bins of the other side.
        between = torch.eye(bins + 1)[:, 1:] - torch.eye(bins + 1)[:, :-1]
        between[0, -1] += 1
        between[-1, 0] -= 1
        self.register_buffer("between", between, persistent=False)
        self.register_buffer("edges", torch.arange(bins + 1.0), persistent=False)
        # Of the constant halves of the integrals, and of the ends that meet, this is what stays.
        rest = torch.zeros(bins)
        rest[[0, -1]] = 0.5
        self.register_buffer("rest", rest, persistent=False)

    def forward(self, positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch D"]:
        """Encode positions in [0, 1]."""
        if runs_native(positions):
            encoded: Tensor = _NativeOneBlob.apply(positions, self.bins)
            return encoded
        constants = (part.to(positions.dtype) for part in (self.edges, self.between, self.rest))
        plain: Tensor = _PlainOneBlob.apply(positions, *constants)
        return plain


class _PlainOneBlob(torch.autograd.Function):
    """`OneBlobEncoding` in plain torch: few operations, each of all bins."""

    @staticmethod
    def forward(
        ctx: Any, positions: Tensor, edges: Tensor, between: Tensor, rest: Tensor
    ) -> Float[Tensor, "*batch D"]:
        bins = len(edges) - 1
        u = torch.sub(edges, positions.clamp(0, 1)[..., None], alpha=bins).clamp(-1, 1)
        square = u * u
        # The integral from 0 to u of 15/16 (1 - v^2)^2; that from -1 is a half more.
        least, middle = constant((-0.625, 0.9375), u).split(1)
        upto = u * torch.addcmul(middle, square, torch.add(least, square, alpha=0.1875))
        encoded = torch.nn.functional.linear(upto, between.mT, rest)
        ctx.save_for_backward(positions, square, between)
        return encoded.flatten(-2)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        positions, square, between = ctx.saved_tensors
        bins = between.shape[1]
        above = upstream[0].unflatten(-1, (-1, bins)) @ between.T
        slopes = (above * (1 - square).square()).sum(-1)
        inside = (positions - 0.5).abs() <= 0.5
        return slopes * inside * (-0.9375 * bins), None, None, None


class _NativeOneBlob(torch.autograd.Function):
    """`OneBlobEncoding` in the compiled module."""

    @staticmethod
    def forward(ctx: Any, positions: Tensor, bins: int) -> Float[Tensor, "*batch D"]:
        given = positions.detach().contiguous()
        encoded = torch.empty(*positions.shape[:-1], positions.shape[-1] * bins)
        native.one_blob(given, bins, encoded, torch.get_num_threads())
        ctx.bins = bins
        ctx.save_for_backward(given)
        return encoded

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None]:
        (positions,) = ctx.saved_tensors
        gradient = torch.empty_like(positions)
        above = upstream[0].contiguous()
        native.one_blob_backward(positions, ctx.bins, above, gradient, torch.get_num_threads())
        return gradient, None


@dataclass(frozen=True)
class NonRigid:
    """Changes of each Gaussian at each time, to apply in canonical space before skinning."""

    changes: Float[Tensor, "T N 9+F"]
    """Offset of the centre (metres), change of the log-scale, vector part of a quaternion to
    multiply from the left whose first component is 1, and the feature for a colour network."""

    def shape(
        self,
        means: Float[Tensor, "N 3"],
        scales_log: Float[Tensor, "N 3"],
        quaternions: Float[Tensor, "N 4"],
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Changed centres, scales (metres) and quaternions, and the feature, all per time."""
        given = (self.changes, means, scales_log, quaternions)
        if all(map(runs_native, given)):
            moved, scales, rotations, feature = _NativeShape.apply(*given)
            return moved, scales, rotations, feature
        moved, scales, rotations, feature = _PlainShape.apply(*given)
        return moved, scales, rotations, feature


class _PlainShape(torch.autograd.Function):
    """`NonRigid.shape` in plain torch, with the gradient of a product of quaternions as products.

    The product p q is P q with the matrix P of p; its gradients are P^T and Q^T times what comes,
    with the matrix Q that multiplies from the right.
    """

    @staticmethod
    def forward(ctx: Any, *inputs: Tensor) -> tuple[Tensor, ...]:
        changes, means, scales_log, quaternions = (tensor.detach() for tensor in inputs)
        offset, scaled, turn, feature = changes.tensor_split((3, 6, 9), -1)
        length = quaternions.norm(dim=-1, keepdim=True).clamp_min(1e-12)
        unit, scales = quaternions / length, (scales_log + scaled).exp()
        matrix = _product_matrix(nn.functional.pad(turn, (1, 0), value=1.0), 1.0)
        ctx.save_for_backward(unit, length, scales, matrix)
        turned = (matrix * unit[..., None, :]).sum(-1)
        return means + offset, scales, turned, feature.contiguous()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, ...]:
        unit, length, scales, matrix = ctx.saved_tensors
        by_center, by_scale, by_rotation, by_feature = upstream
        by_log = by_scale * scales
        turned = (matrix * by_rotation[..., None]).sum(-2).sum(0)
        by_quaternion = (turned - unit * (unit * turned).sum(-1, keepdim=True)) / length
        by_turn = (_product_matrix(unit, -1.0) * by_rotation[..., None]).sum(-2)[..., 1:]
        by_changes = torch.cat([by_center, by_log, by_turn, by_feature], -1)
        return by_changes, by_center.sum(0), by_log.sum(0), by_quaternion


def _product_matrix(quaternions: Float[Tensor, "*N 4"], side: float) -> Float[Tensor, "*N 4 4"]:
    """What multiplies by ``quaternions`` (w, x, y, z) from the left (1) or from the right (-1)."""
    w, x, y, z = quaternions.unbind(-1)
    _, nx, ny, nz = quaternions.neg().unbind(-1)
    (a, b, c), (na, nb, nc) = ((x, y, z), (nx, ny, nz)) if side > 0 else ((nx, ny, nz), (x, y, z))
    rows = (w, nx, ny, nz, x, w, nc, b, y, c, w, na, z, nb, a, w)
    return torch.stack(rows, -1).unflatten(-1, (4, 4))


class _NativeShape(torch.autograd.Function):
    """`NonRigid.shape` in the compiled module, in one pass each way."""

    @staticmethod
    def forward(ctx: Any, *inputs: Tensor) -> tuple[Tensor, ...]:
        given = [tensor.detach().contiguous() for tensor in inputs]
        *leading, columns = given[0].shape
        results = [torch.empty(*leading, size) for size in (3, 3, 4, columns - 9)]
        native.change_shape(*given, *results, torch.get_num_threads())
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*given, results[1])
        return tuple(results)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None) -> tuple[Tensor, ...]:
        *given, scales = ctx.saved_tensors
        above = [None if grad is None else _even_rows(grad) for grad in upstream]
        grads = [torch.empty_like(tensor) for tensor in given]
        native.change_shape_backward(*given, scales, above, *grads, torch.get_num_threads())
        return tuple(grads)


def _even_rows(gradient: Tensor) -> Tensor:
    """As it is if all its rows are whole and evenly apart in memory, as a slice of columns is."""
    steps, size = gradient.stride(), gradient.shape
    even = steps[2] == 1 and (size[0] == 1 or steps[0] == steps[1] * size[1])
    return gradient if even else gradient.contiguous()


class NonRigidNetwork(nn.Module):
    """Encoded position and pose vector to deformation (A9).

    Defaults: 3 hidden layers of 128, 16 features. The first quaternion component is always 1, so
    the network gives three (the released code computes and overwrites a fourth).
    """

    def __init__(
        self,
        pose_dim: int,
        width: int = 128,
        depth: int = 3,
        feature_dim: int = COLOUR_FEATURE_DIM,
        last_layer_std: float | None = 1e-3,
        bins: int = 16,
    ) -> None:
        """``last_layer_std`` None starts the last layer as any other, as the released code does.

        Then a random deformation of centimetres appears when this network is switched on
        (3DGS-Avatar); a small value starts from almost none.
        """
        super().__init__()
        self.encoding = OneBlobEncoding(bins)
        self.mlp = PointMLP(
            self.encoding.dim,
            pose_dim,
            0,
            width,
            depth,
            9 + feature_dim,
            last_std=last_layer_std,
        )

    def forward(self, encoded: Float[Tensor, "N D"], pose: Float[Tensor, "T P"]) -> NonRigid:
        """Deformation of points, encoded by its `encoding`, under each pose."""
        return NonRigid(self.mlp(encoded, pose))


class PoseDeformation(BodyBox):
    """Pose encoder and non-rigid network over the body's box."""

    def __init__(self, body: Body, *, width: int, last_std: float | None) -> None:
        """``last_std`` as in `NonRigidNetwork`."""
        super().__init__(body)
        joints = normalise_joints(body.rest_joints, body.rest_vertices)
        self.pose_encoder = PoseEncoder(body.parents.tolist(), joints)
        dim = self.pose_encoder.dim
        self.network = NonRigidNetwork(dim, width=width, last_layer_std=last_std)

    def inside_box(self, positions: Float[Tensor, "N 3"]) -> Tensor:
        """Mask (N,) of positions, canonical metres, inside that box."""
        return ((positions > self.box_low) & (positions < self.box_high)).all(-1)

    def forward(
        self,
        means: Float[Tensor, "N 3"],
        scales_log: Float[Tensor, "N 3"],
        quaternions: Float[Tensor, "N 4"],
        rotations: Float[Tensor, "T J 3 3"],
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Centres, scales (metres), quaternions and colour feature under each pose, T leading."""
        places = self.encoded(means, self.network.encoding)
        changes = self.network(places, self.pose_encoder(rotations))
        return changes.shape(means, scales_log, quaternions)


def draw_pose_noise(
    joints: int, std: float, generator: torch.Generator, device: torch.device
) -> Float[Tensor, "1 J 3 3"] | float:
    """Noise of a training step on what the pose encoder sees, in half of the steps; else 0.

    3DGS-Avatar adds it to the rotation matrices, so that the network does not learn the training
    poses by heart. One draw serves all times of a step.
    """
    if float(torch.rand((), generator=generator)) >= _NOISE_PROBABILITY:
        return 0.0
    return send(std * torch.randn(1, joints, 3, 3, generator=generator), device)
