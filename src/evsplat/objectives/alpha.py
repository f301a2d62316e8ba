"""The mask term: where the person covers a pixel, and where it does not."""

from collections.abc import Sequence
from functools import partial

from torch import Tensor

from evsplat.capture import Frame
from evsplat.capture.masked import MaskedCapture
from evsplat.devices import DeviceCache
from evsplat.objectives.base import Stateless, Step


class Alpha(Stateless):
    """L1 between the person's alpha picture and the mask (3DGS-Avatar; reference 1.9).

    The alpha picture is the channel of the semantic attribute, for a set that is nothing but the
    person: the released code draws it as a second picture with all colours white.
    """

    def __init__(self, capture: MaskedCapture) -> None:
        """Masks are those of ``capture``."""
        self.capture = capture

    def times(self, frame: Frame, nominal: float) -> Sequence[int]:
        """The middle of the drawn frame's exposure."""
        return (frame.mid_us,)

    def prefetch(self, frame: Frame, nominal: float, data: DeviceCache) -> None:
        """The mask."""
        data.prefetch(("person", frame.name), partial(self.capture.human, frame))

    def loss(self, step: Step) -> dict[str, Tensor]:
        """``alpha``: mean absolute difference over all pixels."""
        frame = step.frame
        mask = step.data.get(("person", frame.name), partial(self.capture.human, frame))
        drawn = step.semantic[step.index(frame.mid_us)]
        return {"alpha": (drawn - mask.to(drawn.dtype)).abs().mean()}
