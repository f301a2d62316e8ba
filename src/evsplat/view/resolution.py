"""How many pixels are drawn while something moves."""

import math

LEAST_SCALE = 0.3
_STEP = 2**-0.25
"""From one scale to the next smaller one."""
_STEPS = math.ceil(math.log(LEAST_SCALE) / math.log(_STEP))


class Resolution:
    """Finds the size of picture that takes no longer than ``target_s`` to draw.

    Sizes are few and are left only for good reason: a picture of another size shares nothing with
    the one before.
    """

    def __init__(self, target_s: float = 0.045) -> None:
        self.target_s = target_s
        self._place = self._wanted = 0.0
        """In steps below the viewport's size: what is drawn, and what would meet the target."""

    @property
    def scale(self) -> float:
        """Side of the picture drawn, as a share of the viewport's; at most 1."""
        return max(LEAST_SCALE, _STEP**self._place)

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Pixels to draw for a viewport."""
        return max(16, round(self.scale * width)), max(16, round(self.scale * height))

    def took(self, seconds: float) -> None:
        """Learn from a picture that was drawn at the present scale.

        A third of the way to what would have met the target, so that one slow picture does not make
        the next ones coarse.
        """
        steps = math.log(max(seconds, 1e-4) / self.target_s) / (-2 * math.log(_STEP))
        self._wanted += (self._place + steps - self._wanted) / 3
        self._wanted = min(max(self._wanted, 0.0), float(_STEPS))
        if abs(self._wanted - self._place) > 0.75:
            self._place = float(round(self._wanted))
