"""Rectangles of whole pixels."""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

Picture = TypeVar("Picture", Tensor, np.ndarray)


@dataclass(frozen=True)
class Box:
    """Pixels ``[top, bottom) x [left, right)``."""

    top: int
    bottom: int
    left: int
    right: int

    def crop(self, image: Picture) -> Picture:
        """The part of ``image`` (H, W, ...) inside the box."""
        return image[self.top : self.bottom, self.left : self.right]

    def enlarged(self, margin: float, height: int, width: int) -> "Box":
        """Wider by ``margin`` of its extent on each side, whole pixels, clipped to the picture."""
        rows = int(margin * (self.bottom - self.top))
        columns = int(margin * (self.right - self.left))
        return self.wider(rows, columns, height, width)

    def wider(self, rows: int, columns: int, height: int, width: int) -> "Box":
        """Wider by so many rows and columns on each side, clipped to the picture."""
        return Box(
            max(self.top - rows, 0),
            min(self.bottom + rows, height),
            max(self.left - columns, 0),
            min(self.right + columns, width),
        )

    def at_least(self, aspect: float, width: int) -> "Box":
        """Widened to ``aspect`` times its height, about its centre but inside the picture."""
        columns = min(width, max(self.right - self.left, round(aspect * (self.bottom - self.top))))
        left = (self.left + self.right - columns) // 2
        left = min(max(left, 0), width - columns)
        return Box(self.top, self.bottom, left, left + columns)

    def without_last(self) -> "Box":
        """Without its last row and column."""
        return Box(self.top, self.bottom - 1, self.left, self.right - 1)


def mask_box(mask: Bool[Tensor, "H W"]) -> Box | None:
    """Smallest box around the true pixels; None where there are none."""
    if not bool(mask.any()):
        return None
    rows = torch.nonzero(mask.any(dim=1)).flatten()
    columns = torch.nonzero(mask.any(dim=0)).flatten()
    return Box(int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1)
