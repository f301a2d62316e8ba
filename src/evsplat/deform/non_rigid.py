"""Non-rigid deformation of canonical Gaussians by the pose (clothes, muscles)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from evsplat.deform.encodings import HashGridEncoding, OneBlobEncoding
from evsplat.deform.mlp import PointMLP


@dataclass(frozen=True)
class NonRigid:
    """Changes of each Gaussian at each time, to apply in canonical space before skinning."""

    offset: Float[Tensor, "T N 3"]
    """Added to the centre, metres."""
    log_scale: Float[Tensor, "T N 3"]
    """Added to the logarithm of the scale."""
    rotation: Float[Tensor, "T N 4"]
    """Quaternion (1, x, y, z), not normalised, to multiply from the left."""
    feature: Float[Tensor, "T N F"]
    """For the colour network."""


class NonRigidNetwork(nn.Module):
    """Encoded position and pose vector to deformation (method.md 1.5, A9).

    Defaults: 3 hidden layers of 128, 16 features. The first quaternion component is always 1, so
    the network gives three (the released code computes and overwrites a fourth).
    """

    def __init__(
        self,
        encoding: OneBlobEncoding | HashGridEncoding,
        pose_dim: int,
        width: int = 128,
        depth: int = 3,
        feature_dim: int = 16,
        last_layer_std: float | None = 1e-3,
    ) -> None:
        """``last_layer_std`` None starts the last layer as any other, as the released code does.

        Then a random deformation of centimetres appears when this network is switched on
        (method.md 1.5); a small value starts from almost none.
        """
        super().__init__()
        self.encoding = encoding
        self.feature_dim = feature_dim
        self.mlp = PointMLP(
            encoding.dim,
            pose_dim,
            0,
            width,
            depth,
            9 + feature_dim,
            last_std=last_layer_std,
        )

    def forward(self, positions: Float[Tensor, "N 3"], pose: Float[Tensor, "T P"]) -> NonRigid:
        """Deformation of points at normalised positions in [-1, 1] under each pose."""
        output = self.mlp(self.encoding(0.5 * (positions + 1)), pose)
        offset, log_scale, turn, feature = output.split((3, 3, 3, self.feature_dim), -1)
        rotation = torch.cat((torch.ones_like(turn[..., :1]), turn), -1)
        return NonRigid(offset, log_scale, rotation, feature)
