"""What a pose does to the brightness of the person's surface: folds, muscles, hollows."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from evsplat.body import BodyTrack
from evsplat.models.networks.body_box import BodyBox
from evsplat.models.networks.mlp import PointMLP
from evsplat.models.networks.non_rigid import OneBlobEncoding
from evsplat.models.networks.pose_code import PoseCode

_DEPTH = 3
_UNIT = 0.6
"""Logarithm of the factor that stands for one of the network's output: a step of Adam changes all
of its weights alike, and a tenth of a brightness is much."""


class PoseShade(BodyBox):
    """Factors on the person's colours by the place on the body and the pose; 1 at the start.

    The light knows normals and places of a body that bends like rubber. What cloth and muscles do
    to it beyond that, a network learns for each pose, not for each frame.
    """

    def __init__(self, track: BodyTrack, times_us: Sequence[int], width: int) -> None:
        """``times_us``: of the recorded poses, the training frames'."""
        super().__init__(track.body)
        self.code = PoseCode(track, times_us)
        self.encoding = OneBlobEncoding()
        self.network = PointMLP(self.encoding.dim, self.code.dim, 0, width, _DEPTH, 1, last_std=0.0)

    def forward(
        self, means: Float[Tensor, "N 3"], rotations: Float[Tensor, "T J 3 3"]
    ) -> Float[Tensor, "T N 1"]:
        """Factors at canonical places under the joints' local rotations.

        Neither gets a gradient: a colour must not be bought by moving or turning the body.
        """
        places = self.encoded(means, self.encoding).detach()
        logs: Tensor = self.network(places, self.code(rotations.detach()))
        return (_UNIT * logs).exp()
