"""What is learned at which rate: groups of parameters as a method names them for the optimiser."""

from dataclasses import dataclass

from torch import nn

from evsplat.deform.human_scene import HumanSceneModel
from evsplat.gaussians import ATTRIBUTES
from evsplat.methods.config import NOMINAL_ITERATIONS, OptimisationConfig


@dataclass(frozen=True)
class Rate:
    """Adam's learning rate: constant for a share of the training, then falling exponentially."""

    start: float
    final: float = 1.0
    """Factor at the end."""
    constant: float = 0.0
    """Share of the training before the decay begins."""

    def factor(self, nominal: float) -> float:
        """Of ``start`` at a nominal iteration."""
        progress = nominal / NOMINAL_ITERATIONS
        falling = max(0.0, progress - self.constant) / (1 - self.constant)
        return float(self.final ** min(falling, 1.0))


@dataclass(frozen=True)
class RowRate:
    """How one attribute of a set of Gaussians learns."""

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


def learning_of(model: HumanSceneModel, config: OptimisationConfig) -> Learning:
    """The groups of the paper's model, with 3DGS-Avatar's rates."""
    rates = config.rates

    def at(start: float, final: float | None = None) -> Rate:
        return Rate(start, rates.final if final is None else final, rates.constant)

    kept = rates.gaussians_final
    rows = {name: RowRate(at(getattr(rates, name), kept)) for name in ATTRIBUTES}
    rows["means"] = RowRate(at(rates.means, rates.means_final))
    rows["semantic_logits"] = RowRate(at(rates.semantic_logits, kept), config.semantics_window)
    clipped: list[tuple[list[nn.Parameter], float, float]] = [
        (_parameters(model.skinning), rates.skinning, 0.0),
        (_parameters(model.non_rigid, model.pose_encoder), rates.non_rigid, 0.0),
        (_parameters(model.human_colour, model.scene_colour), rates.colour, 0.0),
        ([model.latents], rates.latents, rates.latent_weight_decay),
    ]
    residuals = Network(
        [model.rotation_residuals, model.translation_residuals],
        at(rates.pose_correction),
        clipped=model.pose_spline is None,
    )
    free = [
        Network(list(part.parameters()), at(rate))
        for part, rate in (
            (model.shading, rates.shading),
            (model.shadow, rates.shadow),
            (model.lamps, rates.shadow),
            (model.sensor, rates.sensor),
        )
        if part is not None
    ]
    networks = [
        Network(parameters, at(rate), decay, clipped=True)
        for parameters, rate, decay in clipped
        if parameters
    ]
    return Learning(
        {"gaussians": rows},
        [*networks, residuals, *free],
        rates.clip_networks,
        config.human_start,
    )


def _parameters(*parts: nn.Module | None) -> list[nn.Parameter]:
    """Of those parts that the model has."""
    return [parameter for part in parts if part is not None for parameter in part.parameters()]
