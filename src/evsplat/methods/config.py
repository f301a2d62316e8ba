"""Settings shared by methods that train a Gaussian set."""

from dataclasses import dataclass, field
from typing import Protocol

from evsplat.capture import Policy

Weight = float | tuple[tuple[float, float], ...]
"""A constant, or (nominal iteration, value) pairs: piecewise constant from each iteration on."""

NOMINAL_ITERATIONS = 15_000
"""Length of the schedule in the units that every setting uses (3DGS-Avatar's default, A9).

A run of ``--iterations N`` steps passes through the same schedule; step ``i`` is at nominal
iteration ``15000 i / N``.
"""


def weight_at(weight: Weight, nominal: float) -> float:
    """Value of a weight at a nominal iteration; 0 before the first pair."""
    if isinstance(weight, int | float):
        return float(weight)
    value = 0.0
    for start, later in weight:
        if nominal >= start:
            value = later
    return value


@dataclass(frozen=True)
class LearningRates:
    """Adam's learning rates at the start; see ``decay`` for the end."""

    means: float = 5.5e-4
    """Centres, metres (1.6e-4 times 3DGS-Avatar's extent of 3.47)."""
    scales_log: float = 5e-3
    quaternions: float = 1e-3
    opacity_logits: float = 0.05
    features: float = 5e-3
    """Colour features; 3DGS-Avatar: 1e-3 over all 15,000 steps."""
    semantic_logits: float = 1e-2
    skinning: float = 1e-4
    non_rigid: float = 1e-3
    """Non-rigid network and pose encoder."""
    colour: float = 1e-3
    """Both colour networks."""
    latents: float = 1e-3
    pose_correction: float = 1e-4
    """Pose residuals, radians and metres; of a spline, units of the errors expected."""
    shading: float = 3e-3
    shadow: float = 1e-2
    sensor: float = 1e-3
    """Logarithms of the contrast thresholds."""
    final: float = 0.1
    """Factor that every rate reaches at the end, exponentially."""
    means_final: float = 0.1
    """The same for the centres."""
    gaussians_final: float = 0.1
    """The same for the Gaussians' other attributes; 3DGS-Avatar keeps their rates, 1."""
    constant: float = 0.3
    """Share of the training before the decay begins; 3DGS-Avatar: none, over 15,000 steps."""
    latent_weight_decay: float = 0.05
    clip_networks: float = 0.1
    """Largest gradient norm of all networks together."""


@dataclass(frozen=True)
class OptimisationConfig:
    """How long and how fast."""

    iterations: int = NOMINAL_ITERATIONS
    """Training steps; all schedules stretch with it."""
    rates: LearningRates = field(default_factory=LearningRates)
    human_start: float = 1_000
    """Nominal iteration until which the person's Gaussians are frozen while skinning settles."""
    semantics_window: tuple[float, float] = (1_000, 12_000)
    """Nominal iterations in which the semantic attribute learns (A2)."""


class Iterations(Protocol):
    """How long."""

    @property
    def iterations(self) -> int:
        """Training steps; all schedules stretch with it."""


class MethodConfig(Protocol):
    """What every method's configuration has; a frozen dataclass."""

    @property
    def policy(self) -> Policy:
        """What training may see of what is held out."""

    @property
    def optimisation(self) -> Iterations:
        """How long, and whatever else the method says of its optimisation."""
