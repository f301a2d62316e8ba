"""Lamps of a room, at learned places."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

START_DISTANCE_M = 3.0


class Lamps(nn.Module):
    """Points that light the person and that the person hides from the scene.

    Each has a direction from the middle of where the person goes and a distance along it; a lamp
    that moves far away is the sun.
    """

    center: Tensor

    def __init__(self, center: Float[Tensor, "3"], up: Float[Tensor, "3"], count: int) -> None:
        """They start around the zenith, 35 degrees from it, but the first which is there.

        ``center``: where the person goes, metres; ``up``: away from the floor.
        """
        super().__init__()
        self.register_buffer("center", center.clone())
        side = torch.linalg.cross(up, torch.eye(3)[int(up.abs().argmin())])
        side = nn.functional.normalize(side, dim=0)
        other = torch.linalg.cross(up, side)
        angles = torch.arange(count - 1) * (2 * torch.pi / max(count - 1, 1))
        around = angles.cos()[:, None] * side + angles.sin()[:, None] * other
        self.directions = nn.Parameter(torch.cat([up[None], up + 0.7 * around]))
        self.distances_log = nn.Parameter(torch.full((count,), START_DISTANCE_M).log())

    def distances(self) -> Float[Tensor, "L"]:
        """Distances from the middle of where the person goes, metres."""
        return self.distances_log.exp()

    def places(self) -> Float[Tensor, "L 3"]:
        """In the world, metres."""
        directions = nn.functional.normalize(self.directions, dim=-1)
        return self.center + self.distances()[:, None] * directions
