"""Steps with a value that is not finite: left out, counted, and an error when they go on."""

import logging
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from evsplat.errors import DataError

logger = logging.getLogger(__name__)

MAX_BAD_STEPS = 20
"""Consecutive steps with a non-finite loss or gradient after which training stops."""


class BadSteps:
    """Counts them. On the CPU each step is judged at once.

    On a GPU the host would have to wait for every verdict. It stays on the device instead, where it
    keeps the optimiser from moving anything, and the host reads the counts now and then (`settle`).
    """

    def __init__(self, device: torch.device, source: str) -> None:
        """``source`` begins the message of the error."""
        self.at_once = device.type == "cpu"
        self.source = source
        self.skipped = 0
        """Ever, as far as the host knows."""
        self._in_a_row = 0
        self._found = torch.zeros(2, device=device)  # in a row, not settled yet

    def refuse(
        self, sound: Callable[[], Tensor], culprits: Callable[[], list[str]], iteration: int
    ) -> bool:
        """Whether the step ends here, its verdict being asked for at once and bad."""
        if not self.at_once or bool(sound()):
            return False
        found = culprits()
        self.skipped += 1
        self._in_a_row += 1
        logger.warning("step %d skipped: %s is not finite", iteration, ", ".join(found))
        self._stop_if_it_goes_on(found[0])
        return True

    def count(self, sound: Bool[Tensor, ""]) -> Float[Tensor, ""] | None:
        """A step is made, or will be left out by the device; then 1 where it is, else 0."""
        if self.at_once:
            self._in_a_row = 0
            return None
        bad = (~sound).float()
        self._found += bad
        self._found[0].mul_(bad)
        return bad

    def settle(self) -> int:
        """Take over what the device counted, which waits for it; the number of skipped steps."""
        if not self.at_once:
            self._in_a_row, new = map(int, self._found.tolist())
            self._found[1] = 0
            self.skipped += new
            if new:
                logger.warning("%d steps skipped: loss or gradient is not finite", new)
            self._stop_if_it_goes_on("loss or gradient")
        return self.skipped

    def in_a_row(self) -> int:
        """Bad steps since the last sound one."""
        self.settle()
        return self._in_a_row

    def _stop_if_it_goes_on(self, culprit: str) -> None:
        if self._in_a_row >= MAX_BAD_STEPS:
            raise DataError(
                f"{self.source}: {MAX_BAD_STEPS} steps in a row gave a non-finite {culprit}; the "
                "last good checkpoint is kept. Lower the weight of that term with --set, or check "
                "the poses with `evsplat inspect`."
            )
