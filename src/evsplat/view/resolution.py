"""How many pixels are drawn while something moves."""

import math

LEAST_SCALE = 0.3


class Resolution:
    """Finds the size of picture that takes no longer than ``target_s`` to draw."""

    def __init__(self, target_s: float = 0.045) -> None:
        self.target_s = target_s
        self.scale = 1.0
        """Side of the picture drawn, as a share of the viewport's; at most 1."""

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Pixels to draw for a viewport."""
        return max(16, round(self.scale * width)), max(16, round(self.scale * height))

    def took(self, seconds: float) -> None:
        """Learn from a picture that was drawn at the present scale.

        Half of the way to what would have met the target, so that one slow picture does not make
        the next ones coarse.
        """
        wanted = self.scale * math.sqrt(self.target_s / max(seconds, 1e-4))
        self.scale = min(1.0, max(LEAST_SCALE, math.sqrt(self.scale * wanted)))
