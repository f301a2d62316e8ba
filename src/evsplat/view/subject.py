"""A run as the viewer draws it: networks remember, what changes little is drafted."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from evsplat.capture import Camera
from evsplat.methods.reconstruction import Parts, Reconstruction
from evsplat.training.run import Run
from evsplat.view.memory import remembering, set_rough


@dataclass(frozen=True, eq=False)
class Layers:
    """What was drawn of one instant."""

    rgb: Float[np.ndarray, "H W 3"]
    human: Float[np.ndarray, "H W"]


class Subject:
    """Draws one run; for the drawing thread alone."""

    def __init__(self, run: Run, name: str) -> None:
        self.run = run
        self.name = name
        self.capture = run.capture
        self._recorded = run.reconstruction
        self.refresh()

    def refresh(self) -> None:
        """Forget what was remembered: the parameters have changed."""
        self._recorded = _remembering(self.run.reconstruction)

    def layers(
        self, camera: Camera, time_us: int, *, parts: Parts = "all", rough: bool = False
    ) -> Layers:
        """One instant; ``rough`` may show scene colours and skinning of the picture before."""
        drawn = self._recorded
        model = getattr(drawn, "model", None)
        if isinstance(model, nn.Module):
            set_rough(model, rough)
        with torch.no_grad():
            rendering = drawn.render(camera, [time_us], parts=parts)
        return Layers(rendering.rgb[0].numpy(), rendering.human[0].numpy())


def _remembering(reconstruction: Reconstruction) -> Reconstruction:
    model = getattr(reconstruction, "model", None)
    if not isinstance(model, nn.Module):
        return reconstruction
    fields: Any = reconstruction
    return replace(fields, model=remembering(model))
