"""The protocol of maskers, which find the person in frames, and all of them by name."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol

from jaxtyping import Float
from torch import Tensor

from evsplat.capture import Frame, TrainingCapture
from evsplat.masks.background import BackgroundDifference
from evsplat.masks.rvm import RobustVideoMatting
from evsplat.masks.silhouette import PosedBody


class Masker(Protocol):
    """Finds the person from a capture's training frames and poses."""

    name: str

    def masks(
        self, capture: TrainingCapture, frames: Sequence[Frame]
    ) -> Iterator[tuple[Frame, Float[Tensor, "H W"]]]:
        """Each of ``frames``, training frames of ``capture`` in its order, with the share of the
        person per pixel, in [0, 1].
        """
        ...

    def provenance(self) -> dict[str, Any]:
        """Origin of the masks, as JSON values."""
        ...


MASKERS: dict[str, Callable[..., Masker]] = {
    "background": BackgroundDifference,
    "silhouette": PosedBody,
    "rvm": RobustVideoMatting,
}
"""Maskers by name; called with the capture and the masker's own options as keywords."""
