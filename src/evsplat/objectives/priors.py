"""Priors: skinning near the body model's weights, pose residuals small."""

import torch
from torch import Tensor

from evsplat.body import SurfaceSamples
from evsplat.devices import send
from evsplat.models.discs import DiscModel
from evsplat.models.paper import PaperModel
from evsplat.objectives.base import Objective, Step


class PosePrior(Objective):
    """Squared residuals of the poses in units of what is expected."""

    def loss(self, step: Step[DiscModel]) -> dict[str, Tensor]:
        """``pose_prior``, once residuals are learned; see `PoseCorrection.price`."""
        if step.model.residual is None or not step.model.residual_active:
            return {}
        return {"pose_prior": step.model.residual.price(step.generator)}


class ReliefPrior(Objective):
    """Roughness of the scene's relief."""

    def loss(self, step: Step[DiscModel]) -> dict[str, Tensor]:
        """``relief``: see `Relief.price`."""
        assert step.model.relief is not None
        return {"relief": step.model.relief.price()}


class DeformationPrior(Objective):
    """How far the person's shape changes in time."""

    def loss(self, step: Step[DiscModel]) -> dict[str, Tensor]:
        """``deformation``, where poses err; see `Deformation.price`."""
        changes = step.model.shape_changes
        return {} if changes is None else {"deformation": changes.price()}


class SkinningPrior(Objective):
    """Mean over surface points of the squared weight error, summed over joints."""

    def __init__(self, surface: SurfaceSamples, points_per_step: int) -> None:
        """``surface``: samples of the canonical body, drawn once; each step uses a few of them."""
        self.surface, self.points_per_step = surface, points_per_step

    def loss(self, step: Step[PaperModel]) -> dict[str, Tensor]:
        """``skinning``: see `of`."""
        return {"skinning": self.of(step.model, step.generator)}

    def of(self, model: PaperModel, generator: torch.Generator) -> Tensor:
        """The prior of a model, at random surface points."""
        chosen = torch.randint(
            len(self.surface.points), (self.points_per_step,), generator=generator
        )
        chosen = send(chosen, self.surface.points.device)
        weights = model.skinning_weights(self.surface.points[chosen])
        return (weights - self.surface.weights[chosen]).square().sum(-1).mean()
