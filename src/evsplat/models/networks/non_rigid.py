"""Non-rigid change of canonical Gaussians by the pose: clothes and muscles (paper eq. 1)."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from evsplat.body import Body, bounding_box
from evsplat.body.rotations import quaternion_multiply
from evsplat.compiled import native, runs_native
from evsplat.devices import send
from evsplat.models.kept import Kept
from evsplat.models.networks.mlp import PointMLP
from evsplat.models.networks.pose_encoder import PoseEncoder, normalise_joints

_NOISE_PROBABILITY = 0.5


class OneBlobEncoding(nn.Module):
    """A smooth bump per axis, integrated over equal bins; no parameters.

    The bump is the quartic kernel ``15/16 (1 - u^2)^2`` with a radius of one bin, and what falls
    off one end comes in at the other, so that each axis sums to one (tiny-cuda-nn's one-blob). The
    released 3DGS-Avatar asks for a hash grid and most likely gets this: 16 bins, 48 values
    (reference 1.5); the smooth one generalises better to held-out poses.
    """

    def __init__(self, bins: int = 16) -> None:
        super().__init__()
        if bins < 3:
            raise ValueError(f"bins is {bins}, expected at least 3: a bump touches three of them")
        self.bins = bins
        self.dim = 3 * bins

    def forward(self, positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch D"]:
        """Encode positions in [0, 1]."""
        if runs_native(positions):
            encoded: Tensor = _NativeOneBlob.apply(positions, self.bins)
            return encoded
        scaled = positions.clamp(0, 1) * self.bins
        cell = scaled.detach().floor().clamp_max(self.bins - 1)
        # The bump's centre lies in `cell`, its ends in the two neighbours: three bins are not zero.
        below = _quartic_cdf(cell - scaled)
        upto = _quartic_cdf(cell + 1 - scaled)
        shares = torch.stack((below, upto - below, 1 - upto), -1)
        index = cell.long()[..., None] + torch.arange(-1, 2, device=cell.device)
        empty = shares.new_zeros(*positions.shape, self.bins)
        return empty.scatter(-1, index % self.bins, shares).flatten(-2)


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


def _quartic_cdf(u: Tensor) -> Tensor:
    """Integral from -1 to u of ``15/16 (1 - v^2)^2``, for u in [-1, 1]."""
    square = u * u
    return 0.5 + u * (0.9375 + square * (0.1875 * square - 0.625))


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
        offset, scaled, turn, feature = self.changes.tensor_split((3, 6, 9), -1)
        turn = torch.cat((torch.ones_like(turn[..., :1]), turn), -1)
        turned = quaternion_multiply(turn, nn.functional.normalize(quaternions, dim=-1))
        return means + offset, (scales_log + scaled).exp(), turned, feature


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
    """Encoded position and pose vector to deformation (method.md 1.5, A9).

    Defaults: 3 hidden layers of 128, 16 features. The first quaternion component is always 1, so
    the network gives three (the released code computes and overwrites a fourth).
    """

    def __init__(
        self,
        pose_dim: int,
        width: int = 128,
        depth: int = 3,
        feature_dim: int = 16,
        last_layer_std: float | None = 1e-3,
        bins: int = 16,
    ) -> None:
        """``last_layer_std`` None starts the last layer as any other, as the released code does.

        Then a random deformation of centimetres appears when this network is switched on
        (method.md 1.5); a small value starts from almost none.
        """
        super().__init__()
        self.encoding = OneBlobEncoding(bins)
        self.feature_dim = feature_dim
        self.mlp = PointMLP(
            self.encoding.dim,
            pose_dim,
            0,
            width,
            depth,
            9 + feature_dim,
            last_std=last_layer_std,
        )

    def encode(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N D"]:
        """What the network is told of points at normalised positions in [-1, 1]."""
        encoded: Tensor = self.encoding(0.5 * (positions + 1))
        return encoded

    def forward(self, encoded: Float[Tensor, "N D"], pose: Float[Tensor, "T P"]) -> NonRigid:
        """Deformation of encoded points under each pose."""
        return NonRigid(self.mlp(encoded, pose))


class PoseDeformation(nn.Module):
    """Pose encoder and non-rigid network over the body's box."""

    box_low: Tensor
    box_high: Tensor

    def __init__(
        self,
        body: Body,
        *,
        width: int,
        feature_dim: int,
        last_std: float | None = 1e-3,
    ) -> None:
        """``feature_dim`` values for a colour network; ``last_std`` as in `NonRigidNetwork`."""
        super().__init__()
        joints = normalise_joints(body.rest_joints, body.rest_vertices)
        self.pose_encoder = PoseEncoder(body.parents.tolist(), joints)
        self.network = NonRigidNetwork(
            self.pose_encoder.dim,
            width=width,
            feature_dim=feature_dim,
            last_layer_std=last_std,
        )
        low, high = bounding_box(body)
        self._encoded = Kept()
        self.register_buffer("box_low", low.float())
        self.register_buffer("box_high", high.float())

    def normalise(self, positions: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
        """Canonical metres to [-1, 1] over the enlarged bounding box of the body."""
        return 2 * (positions - self.box_low) / (self.box_high - self.box_low) - 1

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
        encode: Callable[[], Tensor] = lambda: self.network.encode(self.normalise(means))  # noqa: E731
        changes = self.network(self._encoded.of([means], encode), self.pose_encoder(rotations))
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
