"""Places on a body as networks are told of them."""

from jaxtyping import Float
from torch import Tensor, nn

from evsplat.body import Body, bounding_box


class BodyBox(nn.Module):
    """Base of what is learned by the place on a body: places in its enlarged bounding box."""

    box_low: Tensor
    box_high: Tensor

    def __init__(self, body: Body) -> None:
        super().__init__()
        low, high = bounding_box(body)
        self.register_buffer("box_low", low.float())
        self.register_buffer("box_high", high.float())

    def normalise(self, positions: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
        """Canonical metres to [-1, 1] over the enlarged bounding box of the body."""
        return 2 * (positions - self.box_low) / (self.box_high - self.box_low) - 1
