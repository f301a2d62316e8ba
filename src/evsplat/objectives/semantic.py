"""Teaches the semantic attribute where the person is, without any mask (A8)."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from evsplat.capture import Frame
from evsplat.objectives.base import Stateless, Step


def silhouette_bounds(
    silhouette: Bool[np.ndarray, "H W"], band_px: int
) -> tuple[Bool[Tensor, "H W"], Bool[Tensor, "H W"]]:
    """Where a pixel surely is the person, and where it surely is the scene.

    Inside the posed bare body it is the person; farther than ``band_px`` from it the scene; between
    lie clothes and hair, about which nothing is said.
    """
    if not silhouette.any():
        return torch.from_numpy(silhouette.copy()), torch.from_numpy(~silhouette)
    outside = distance_transform_edt(~silhouette) > band_px
    return torch.from_numpy(silhouette.copy()), torch.from_numpy(outside)


class RenderedSemantics(Stateless):
    """Cross-entropy of the rendered attribute against the posed body's bounds (A2 iii, A8)."""

    def __init__(
        self,
        bounds: dict[int, tuple[Bool[Tensor, "H W"], Bool[Tensor, "H W"]]],
    ) -> None:
        """``bounds``: `silhouette_bounds` at the mid-exposure (microseconds) of training frames."""
        self.bounds = bounds

    def times(self, frame: Frame, nominal: float) -> Sequence[int]:
        """None of its own: it looks at the mid-exposures that others render."""
        return ()

    def loss(self, step: Step) -> dict[str, Tensor]:
        """``semantic`` and the pressure ``binarise`` = mean m (1 - m) (A2)."""
        values: list[Float[Tensor, ""]] = []
        for time, drawn in zip(step.times_us, step.semantic, strict=True):
            if time not in self.bounds:
                continue
            inside, outside = (mask.to(drawn.device) for mask in self.bounds[time])
            probability = drawn.clamp(1e-4, 1 - 1e-4)
            error = -torch.where(
                inside, probability.log(), torch.where(outside, (1 - probability).log(), 0.0)
            )
            values.append(error.mean())
        soft = step.model.gaussians.semantics()
        terms = {"binarise": (soft * (1 - soft)).mean()}
        if values:
            terms["semantic"] = torch.stack(values).mean()
        return terms
