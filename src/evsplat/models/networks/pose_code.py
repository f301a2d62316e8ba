"""A pose in few numbers: where it lies among the poses of a recording."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from evsplat.body import BodyTrack

COMPONENTS = 8
"""Directions in which the poses of a recording vary; beyond them is mostly noise."""
_LEAST_SPREAD = 0.1
"""Of the matrices' entries along a direction: as much as training adds to them in noise. What
varies less is not made larger."""

_MOST_POSES = 4_096
"""That are looked at."""


class PoseCode(nn.Module):
    """Local joint rotations along the principal components of a recording's, in their spreads.

    About a dozen key poses tell how cloth and muscles follow; of what a network is told in a few
    hundred steps it learns what is of size one. Poses beyond the recorded ones are taken as the
    nearest in every component. The root's rotation is left out: the heading in the world must not
    enter.
    """

    middle: Tensor
    directions: Tensor
    low: Tensor
    high: Tensor

    def __init__(self, track: BodyTrack, times_us: Sequence[int]) -> None:
        """``times_us``: of the poses that count, the training frames'."""
        super().__init__()
        self.dim = COMPONENTS
        # Of more than `_MOST_POSES` some stand for all.
        times = torch.as_tensor(list(times_us)[:: -(-len(times_us) // _MOST_POSES)])
        entries = _entries(track.at(times)[0]).double().cpu()
        middle = entries.mean(0)
        _, sizes, rows = torch.linalg.svd(entries - middle, full_matrices=False)
        kept = min(COMPONENTS, len(sizes))
        spreads = (sizes[:kept] / len(entries) ** 0.5).clamp_min(_LEAST_SPREAD)
        directions = entries.new_zeros(entries.shape[1], COMPONENTS)
        directions[:, :kept] = rows[:kept].T / spreads
        recorded = (entries - middle) @ directions
        found = (middle, directions, recorded.amin(0), recorded.amax(0))
        # Part of the state: decompositions differ by signs from one machine to another.
        for name, value in zip(("middle", "directions", "low", "high"), found, strict=True):
            self.register_buffer(name, value.float())

    def forward(self, rotations: Float[Tensor, "T J 3 3"]) -> Float[Tensor, "T P"]:
        """Numbers of about -2 to 2."""
        code = (_entries(rotations) - self.middle) @ self.directions
        return code.clamp(self.low, self.high)


def _entries(rotations: Float[Tensor, "T J 3 3"]) -> Float[Tensor, "T E"]:
    """Of all joints' matrices but the root's, which is the first."""
    return rotations[:, 1:].flatten(1)
