"""A recording as a human-only method sees it: black outside of the person."""

from jaxtyping import Bool, Float
from torch import Tensor

from evsplat.capture.capture import Capture
from evsplat.capture.metadata import Frame
from evsplat.errors import DataError

PERSON_ABOVE = 0.5
"""Share of a pixel above which it is the person's."""


class MaskedCapture(Capture):
    """The same capture with pictures that are black where the mask says that nobody is.

    The released 3DGS-Avatar cuts pictures hard, so a pixel is taken whole or not at all.
    """

    def __init__(self, capture: Capture) -> None:
        """A `DataError` where a training frame has no mask."""
        without = [frame.name for frame in capture.train_frames if frame.mask is None]
        if without:
            every = len(without) == len(capture.train_frames)
            found = "no training frame has a mask" if every else f"frame {without[0]!r} has no mask"
            raise DataError(
                f"{capture.path / 'capture.json'}: {found}, and this method learns the person from "
                f"masked pictures; make masks with: evsplat masks {capture.path}"
            )
        super().__init__(capture.metadata)

    def image(self, frame: Frame | str) -> Float[Tensor, "H W 3"]:
        """The blurry picture, black outside of the person."""
        return super().image(frame) * self.person(frame)[..., None]

    def person(self, frame: Frame | str) -> Bool[Tensor, "H W"]:
        """The person's pixels in a frame that has a mask."""
        mask = self.mask(frame)
        assert mask is not None
        return mask > PERSON_ABOVE
