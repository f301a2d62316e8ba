"""What a restorer is, and which there are."""

from collections.abc import Callable, Iterator
from typing import Any, Protocol

from jaxtyping import Float
from torch import Tensor

from evsplat.capture import Capture, Frame
from evsplat.restore.edi import Edi
from evsplat.restore.pienet import PieNet


class Restorer(Protocol):
    """Makes sharp pictures of a capture's frames from its pictures and events alone."""

    name: str

    def restore(self, capture: Capture) -> Iterator[tuple[Frame, Float[Tensor, "H W 3"]]]:
        """Each frame in order with its sharp picture at mid-exposure, sRGB-coded in [0, 1]."""
        ...

    def provenance(self) -> dict[str, Any]:
        """How the pictures were made, as JSON values."""
        ...


RESTORERS: dict[str, Callable[..., Restorer]] = {"edi": Edi, "pienet": PieNet}
"""By name; called with the capture and the restorer's own options as keywords."""
