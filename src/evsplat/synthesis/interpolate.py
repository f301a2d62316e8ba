"""Pictures between two pictures: the protocol of up-sampling."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False)
class Picture:
    """A sharp picture in both of its forms, grey (C = 1) or RGB (C = 3)."""

    coded: Float[np.ndarray, "H W C"]
    """Values to look at, float32 in [0, 1]: as stored, or coded where these are light."""
    linear: Float[np.ndarray, "H W C"]
    """Linear light, float32 in [0, 1]."""


class Interpolator(Protocol):
    """Makes pictures at fractions of the time from one picture to the next."""

    def between(
        self, before: Picture, after: Picture, fractions: Sequence[float]
    ) -> Iterator[Float[np.ndarray, "H W C"]]:
        """Linear light at each fraction, 0 at ``before`` and 1 at ``after``, exclusive."""
        ...
