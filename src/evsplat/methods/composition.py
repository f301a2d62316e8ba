"""What the training loop trains: a model, its objectives, and how both change with time."""

from dataclasses import dataclass

import torch

from evsplat.deform.human_scene import HumanSceneModel
from evsplat.gaussians import BodyFrames, DensifyConfig, Part
from evsplat.methods.config import OptimisationConfig, Weight
from evsplat.objectives import Objective


@dataclass(frozen=True)
class Composition:
    """A method put together for one capture; the loop knows nothing else of it."""

    model: HumanSceneModel
    objectives: list[Objective]
    weights: dict[str, Weight]
    """Weight per named term; a term without one is an error of the method."""
    optimisation: OptimisationConfig
    densify: dict[Part, DensifyConfig]
    """Limits for ``human`` and ``scene``."""
    body_frames: BodyFrames
    """The body at the training frames, for Gaussians that change class."""
    generator: torch.Generator
    """All randomness of the training; part of the checkpoint."""
