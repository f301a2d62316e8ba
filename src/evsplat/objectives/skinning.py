"""Keeps the skinning network near the body model's weights on the body's surface."""

from collections.abc import Sequence

import torch
from torch import Tensor

from evsplat.body import SurfaceSamples
from evsplat.capture import Frame
from evsplat.devices import send
from evsplat.models.paper import PaperModel
from evsplat.objectives.base import Stateless, Step


class SkinningPrior(Stateless):
    """Mean over surface points of the squared weight error, summed over joints (1.6)."""

    def __init__(self, surface: SurfaceSamples, points_per_step: int) -> None:
        """``surface``: samples of the canonical body, drawn once; each step uses a few of them."""
        self.surface, self.points_per_step = surface, points_per_step

    def times(self, frame: Frame, nominal: float) -> Sequence[int]:
        """None: the prior lives in canonical space."""
        return ()

    def loss(self, step: Step[PaperModel]) -> dict[str, Tensor]:
        """``skinning``."""
        return {"skinning": self.of(step.model, step.generator)}

    def of(self, model: PaperModel, generator: torch.Generator) -> Tensor:
        """The prior of a model, at random surface points."""
        chosen = torch.randint(
            len(self.surface.points), (self.points_per_step,), generator=generator
        )
        chosen = send(chosen, self.surface.points.device)
        weights = model.skinning_weights(self.surface.points[chosen])
        return (weights - self.surface.weights[chosen]).square().sum(-1).mean()
