"""Places of Gaussians by their class: how the semantic attribute decides between two (A2)."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from evsplat.gaussians import GaussianSet
from evsplat.models.networks.non_rigid import PoseDeformation


class Placement:
    """Which rows of the scene are posed beside the person's, and where both classes are drawn.

    By the label: the person's rows are posed, the scene's stay, and the attribute learns nothing.
    """

    def posed_scene_rows(
        self, gaussians: GaussianSet, deformation: PoseDeformation
    ) -> Int[Tensor, " K"] | None:
        """Rows of the scene to pose after the person's; None: none."""
        return None

    def places(
        self,
        gaussians: GaussianSet,
        rows: Int[Tensor, " K"] | None,
        posed: Float[Tensor, "T H+K 3"],
        scene: Float[Tensor, "S 3"],
    ) -> tuple[Float[Tensor, "T H 3"], Float[Tensor, "S 3"]]:
        """Centres of person and scene, from posed centres and those of the scene as it stands."""
        return posed, scene


class StraightThrough(Placement):
    """Both placements of each row, chosen by the hard label, with the gradient of m (A2 ii).

    Forward: ``h * deformed + (1 - h) * canonical`` with the hard label h; backward: dm/dl. Rows
    outside the canonical box have no deformed placement and so no gradient (literal eq. 6).
    """

    def posed_scene_rows(
        self, gaussians: GaussianSet, deformation: PoseDeformation
    ) -> Int[Tensor, " K"]:
        """Rows whose centre, read as canonical, lies in the body's box."""
        inside = deformation.inside_box(gaussians.means.detach()[gaussians.scene])
        return torch.nonzero(inside)[:, 0]

    def places(
        self,
        gaussians: GaussianSet,
        rows: Int[Tensor, " K"] | None,
        posed: Float[Tensor, "T H+K 3"],
        scene: Float[Tensor, "S 3"],
    ) -> tuple[Float[Tensor, "T H 3"], Float[Tensor, "S 3"]]:
        """As given, with the gradient of m."""
        assert rows is not None
        count = gaussians.human_count
        logits, canonical = (
            torch.cat([values[:count], values[count:][rows]])
            for values in (gaussians.semantic_logits, gaussians.means.detach())
        )
        soft = torch.sigmoid(logits)
        step = (soft - soft.detach())[None, :, None] * (posed.detach() - canonical)
        # The scene is drawn once for all times; its label sees the mean placement.
        return posed[:, :count] + step[:, :count], scene.index_add(0, rows, step[:, count:].mean(0))
