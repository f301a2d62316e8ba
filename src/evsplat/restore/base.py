"""The protocol of restorers, and all of them by name."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol

from jaxtyping import Float
from torch import Tensor

from evsplat.capture import Frame, TrainingCapture
from evsplat.restore.d2net import D2Net
from evsplat.restore.e2vid import E2Vid
from evsplat.restore.edi import Edi
from evsplat.restore.efnet import EfNet
from evsplat.restore.mprnet import MprNet
from evsplat.restore.nafnet import NafNet
from evsplat.restore.pienet import PieNet
from evsplat.weights import WeightFile


class Restorer(Protocol):
    """Makes sharp pictures of a capture's frames from its pictures and events alone."""

    name: str

    def restore(
        self, capture: TrainingCapture, frames: Sequence[Frame]
    ) -> Iterator[tuple[Frame, Float[Tensor, "H W 3"]]]:
        """Each of ``frames``, training frames of ``capture``, with its sharp picture at
        mid-exposure, in [0, 1] and coded as they are.
        """
        ...

    def provenance(self) -> dict[str, Any]:
        """Origin of the pictures, as JSON values."""
        ...


RESTORERS: dict[str, Callable[..., Restorer]] = {
    Edi.name: Edi,
    NafNet.name: NafNet,
    MprNet.name: MprNet,
    EfNet.name: EfNet,
    D2Net.name: D2Net,
    E2Vid.name: E2Vid,
    PieNet.name: PieNet,
}
"""Restorers by name; called with the capture and the restorer's own options as keywords."""

WEIGHT_FILES: dict[str, WeightFile] = {
    NafNet.name: NafNet.file,
    MprNet.name: MprNet.file,
    EfNet.name: EfNet.file,
    D2Net.name: D2Net.file,
    E2Vid.name: E2Vid.file,
}
"""Files that users bring for the restorers whose weights come with no package."""
