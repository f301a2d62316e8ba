"""Non-rigid deformation of canonical Gaussians by the pose (clothes, muscles)."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from evsplat.body.rotations import quaternion_multiply
from evsplat.compiled import native, runs_native
from evsplat.models.networks.mlp import PointMLP
from evsplat.models.networks.one_blob import OneBlobEncoding


@dataclass(frozen=True)
class NonRigid:
    """Changes of each Gaussian at each time, to apply in canonical space before skinning."""

    changes: Float[Tensor, "T N 9+F"]
    """Offset of the centre (metres), change of the log-scale, vector part of a quaternion whose
    first component is 1, and the feature."""

    @property
    def offset(self) -> Float[Tensor, "T N 3"]:
        """Added to the centre, metres."""
        return self.changes[..., :3]

    @property
    def log_scale(self) -> Float[Tensor, "T N 3"]:
        """Added to the logarithm of the scale."""
        return self.changes[..., 3:6]

    @property
    def rotation(self) -> Float[Tensor, "T N 4"]:
        """Quaternion (1, x, y, z), not normalised, to multiply from the left."""
        turn = self.changes[..., 6:9]
        return torch.cat((torch.ones_like(turn[..., :1]), turn), -1)

    @property
    def feature(self) -> Float[Tensor, "T N F"]:
        """For the colour network."""
        return self.changes[..., 9:]

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
        turned = quaternion_multiply(self.rotation, nn.functional.normalize(quaternions, dim=-1))
        return means + self.offset, (scales_log + self.log_scale).exp(), turned, self.feature


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

    def forward(self, positions: Float[Tensor, "N 3"], pose: Float[Tensor, "T P"]) -> NonRigid:
        """Deformation of points at normalised positions in [-1, 1] under each pose."""
        return NonRigid(self.mlp(self.encoding(0.5 * (positions + 1)), pose))
