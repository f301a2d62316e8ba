"""Non-rigid change of the person's Gaussians by the pose, in canonical space (paper eq. 1)."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from evsplat.body import Body, bounding_box
from evsplat.devices import send
from evsplat.models.networks.non_rigid import NonRigidNetwork
from evsplat.models.networks.pose_encoder import PoseEncoder, normalise_joints


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
        changes = self.network(self.normalise(means), self.pose_encoder(rotations))
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


_NOISE_PROBABILITY = 0.5
