"""Values that the configurations of several methods hold."""

from dataclasses import dataclass, replace
from typing import Annotated

from evsplat.gaussians import DensifyLimits, Part
from evsplat.ranges import Above, AtLeast, ReadIf, Within

NOMINAL_ITERATIONS = 15_000
"""Length of the schedule in the units that every setting uses (3DGS-Avatar's default, A9).

A run of ``--iterations N`` steps passes through the same schedule; step ``i`` is at nominal
iteration ``15000 i / N``.
"""

Nominal = Annotated[float, Within(0, NOMINAL_ITERATIONS)]
"""A nominal iteration."""
NotNegative = Annotated[float, AtLeast(0)]
Positive = Annotated[float, Above(0)]
Share = Annotated[float, Within(0, 1)]

Weight = NotNegative | tuple[tuple[NotNegative, NotNegative], ...]
"""A constant, or (nominal iteration, value) pairs: piecewise constant from each iteration on."""


def weight_at(weight: Weight, nominal: float) -> float:
    """Value of a weight at a nominal iteration; 0 before the first pair."""
    if isinstance(weight, int | float):
        return float(weight)
    value = 0.0
    for start, later in weight:
        if nominal >= start:
            value = later
    return value


WITH_EVENTS = ReadIf("event_weight", "above 0", lambda weight: weight != 0.0)
WITH_WINDOWS = ReadIf("event_term", "windows", lambda term: term == "windows")


@dataclass(frozen=True)
class Densify:
    """Growth and pruning of Gaussians, in nominal iterations; the other limits are the method's."""

    start: Nominal
    """First nominal iteration."""
    end: Nominal
    """Last nominal iteration."""
    gradient: Positive
    """A Gaussian is cloned or split above this mean screen-space gradient (NDC units, as 3DGS)."""
    max_human: Annotated[int, AtLeast(0)]
    """No clone or split of the person beyond this number of Gaussians; 0: none at all."""

    def limits(self, *, cube_max_count: int | None = None) -> dict[Part, DensifyLimits]:
        """Limits of the person as 3DGS-Avatar's, and of a random cube as 3DGS's (A20).

        Without ``cube_max_count`` the scene is left as it is: a median backdrop has a Gaussian for
        every 2x2 pixels already and would only grow where the person passes.
        """
        human = DensifyLimits(
            start=self.start, end=self.end, gradient=self.gradient, max_count=self.max_human
        )
        limits: dict[Part, DensifyLimits] = {"human": human}
        if cube_max_count is not None:
            # Neither the 20-pixel nor the 0.05-opacity rule of a person.
            limits["scene"] = replace(
                human,
                prune_opacity=0.005,
                prune_screen_px=None,
                prune_scale_m=None,
                max_count=cube_max_count,
            )
        return limits
