"""Places on a body as networks are told of them."""

from collections.abc import Callable

from jaxtyping import Float
from torch import Tensor, nn

from evsplat.body import Body, bounding_box
from evsplat.models.kept import Kept


class BodyBox(nn.Module):
    """Base of what is learned by the place on a body: places in its enlarged bounding box."""

    box_low: Tensor
    box_high: Tensor

    def __init__(self, body: Body) -> None:
        super().__init__()
        low, high = bounding_box(body)
        self.register_buffer("box_low", low.float())
        self.register_buffer("box_high", high.float())
        self._encoded = Kept()

    def normalise(self, positions: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
        """Canonical metres to [-1, 1] over the enlarged bounding box of the body."""
        return 2 * (positions - self.box_low) / (self.box_high - self.box_low) - 1

    def encoded(
        self, places: Float[Tensor, "N 3"], encoding: Callable[[Tensor], Tensor]
    ) -> Float[Tensor, "N D"]:
        """``encoding`` of canonical places, [0, 1] over that box; kept where nobody learns them."""

        def encode() -> Tensor:
            return encoding((places - self.box_low) / (self.box_high - self.box_low))

        return self._encoded.of([places], encode)
