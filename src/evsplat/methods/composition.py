"""What the training loop trains: a model, its objectives, and how both change with time."""

from dataclasses import dataclass

import torch
from torch import nn

from evsplat.capture import Frame, TrainingCapture
from evsplat.deform.model import Model
from evsplat.gaussians import BodyFrames, DensifyConfig, Part
from evsplat.methods.config import Weight
from evsplat.methods.rates import Learning
from evsplat.objectives import Objective


@dataclass(frozen=True)
class HeldOut:
    """What is learned between training steps of frames whose pictures stay unseen."""

    frames: list[Frame]
    objective: Objective
    parameters: list[nn.Parameter]
    """What alone these frames teach; of the groups in `Learning.networks`."""
    start: float
    """First nominal iteration."""
    every: int
    """Training steps between two of these."""


@dataclass(frozen=True)
class Composition:
    """A method put together for one capture; the loop knows nothing else of it."""

    model: Model
    objectives: list[Objective]
    weights: dict[str, Weight]
    """Weight per named term; a term without one is an error of the method."""
    learning: Learning
    densify: dict[Part, DensifyConfig]
    """Limits for ``human`` and ``scene``; classes in one set are edited at the same steps."""
    body_frames: BodyFrames | None
    """The body at the training frames, for Gaussians that change class; None where none does."""
    generator: torch.Generator
    """All randomness of the training; part of the checkpoint."""
    capture: TrainingCapture | None = None
    """The recording as the method sees it, where that is not all of it (masked pictures)."""
    held_out: HeldOut | None = None
