"""Whether the rest of a schedule is worth its steps, told by how the pictures' loss falls."""

from collections.abc import Mapping

import torch
from torch import Tensor

from evsplat.methods.settings import NOMINAL_ITERATIONS, Weight, weight_at

PARTS = 20
"""Of a schedule, over each of which the loss is averaged."""
SPAN = 2
"""Parts that are compared with as many before."""
FIRST = 10
"""Parts after which the end may be brought forward: what is learned at high rates counts."""
SETTLED = 0.12
"""Share of the loss; while it falls by more from one `SPAN` to the next, more is to be learned."""
REST = 0.125
"""Share of the planned steps in which the rest of the schedule is passed then."""


class Outlook:
    """Mean loss of the pictures over each part of a schedule.

    Losses stay on their device until a part is over or the state is asked for, so that a GPU is not
    waited for in every step.
    """

    def __init__(self, weights: Mapping[str, Weight]) -> None:
        """``weights``: of the terms that compare pictures; without any nothing is ever told."""
        self.weights = dict(weights)
        self._totals = torch.zeros(PARTS, 2, dtype=torch.float64)  # sums, and their numbers
        self._waiting: list[tuple[float, list[Tensor]]] = []

    def note(self, fraction: float, terms: Mapping[str, Tensor]) -> None:
        """Count the unweighted terms of a step at this place of the schedule, 0 to 1."""
        if self.weights:
            self._waiting.append((fraction, [terms[name].detach() for name in self.weights]))

    def fall(self, before: float, after: float) -> float | None:
        """Share by which the mean loss fell, where a step from one place to another ended a part.

        None elsewhere, and where nothing can be told yet.
        """
        reached = _part(after)
        if not self.weights or reached == _part(before) or reached < FIRST:
            return None
        self._settle()
        earlier, later = self._totals[reached - 2 * SPAN : reached].split(SPAN)
        (last, of), (first, of_first) = later.sum(0).tolist(), earlier.sum(0).tolist()
        return 1 - (last / of) / (first / of_first) if of and of_first and first else None

    def state(self) -> Tensor:
        """All that a resume needs."""
        self._settle()
        return self._totals.clone()

    def load_state(self, totals: Tensor) -> None:
        """Go back to the moment of `state`; a `ValueError` where it is none."""
        if totals.shape != self._totals.shape or totals.dtype != self._totals.dtype:
            raise ValueError(f"outlook: {totals.dtype} of {tuple(totals.shape)}")
        self._totals, self._waiting = totals.clone(), []

    def _settle(self) -> None:
        """Add the losses that wait to their parts, one by one: the same whenever that is done."""
        if not self._waiting:
            return
        values = torch.stack([torch.stack(terms) for _, terms in self._waiting]).double().tolist()
        for (fraction, _), terms in zip(self._waiting, values, strict=True):
            nominal = fraction * NOMINAL_ITERATIONS
            weights = (weight_at(weight, nominal) for weight in self.weights.values())
            loss = sum(weight * term for weight, term in zip(weights, terms, strict=True))
            if loss == loss:  # a GPU's step whose values were not numbers moved nothing
                self._totals[_part(fraction)] += torch.tensor([loss, 1.0], dtype=torch.float64)
        self._waiting = []


def _part(fraction: float) -> int:
    return min(int(fraction * PARTS), PARTS - 1)
