"""Learning rates: groups of parameters as a method names them for the optimiser."""

from collections.abc import Mapping
from dataclasses import dataclass

from torch import nn

from evsplat.methods.settings import NOMINAL_ITERATIONS


@dataclass(frozen=True)
class Rate:
    """Adam's learning rate: constant for a share of the training, then falling exponentially."""

    start: float
    final: float = 1.0
    """Factor at the end."""
    constant: float = 0.0
    """Share of the training before the decay begins."""

    def factor(self, nominal: float) -> float:
        """Share of ``start`` at a nominal iteration."""
        progress = nominal / NOMINAL_ITERATIONS
        falling = max(0.0, progress - self.constant) / (1 - self.constant)
        return float(self.final ** min(falling, 1.0))


@dataclass(frozen=True)
class RowRate:
    """Learning rate of one attribute of a set of Gaussians."""

    rate: Rate
    window: tuple[float, float] = (0.0, float("inf"))
    """Nominal iterations in which it does."""


@dataclass(frozen=True)
class Network:
    """Parameters that do not change in number."""

    parameters: list[nn.Parameter]
    rate: Rate
    weight_decay: float = 0.0
    clipped: bool = False
    """Whether their gradients count in, and are scaled by, the common norm."""


@dataclass(frozen=True)
class Learning:
    """All that a run learns. Every attribute of every set is named."""

    rows: dict[str, dict[str, RowRate]]
    """By set and attribute."""
    networks: list[Network]
    clip: float | None = None
    """Largest gradient norm of all clipped networks together."""
    human_start: float = 0.0
    """Nominal iteration until which the person's Gaussians are frozen."""


SEMANTICS_WINDOW = (1_000.0, 12_000.0)
"""Nominal iterations in which the semantic attribute learns (A2)."""


def row_rates(
    rates: Mapping[str, float],
    *,
    means: float,
    final: float,
    means_final: float,
    constant: float,
) -> dict[str, RowRate]:
    """Rates of a `GaussianSet`, each falling to ``final`` of it after a ``constant`` share."""
    rows = {name: RowRate(Rate(rate, final, constant)) for name, rate in rates.items()}
    rows["means"] = RowRate(Rate(means, means_final, constant))
    rows["semantic_logits"] = RowRate(Rate(1e-2, final, constant), SEMANTICS_WINDOW)
    return rows


def parameters_of(*parts: nn.Module | None) -> list[nn.Parameter]:
    """Parameters of those parts that a model has."""
    return [parameter for part in parts if part is not None for parameter in part.parameters()]
