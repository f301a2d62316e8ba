"""As isometric as possible: neighbours keep their distances and covariances when posed."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from evsplat.body.rotations import quaternion_to_matrix
from evsplat.capture import Frame
from evsplat.objectives.base import Step

NEIGHBOURS = 4


def covariance6(matrix: Float[Tensor, "*N 3 3"]) -> Float[Tensor, "*N 6"]:
    """Upper triangle of ``M M^T``."""
    covariance = matrix @ matrix.transpose(-1, -2)
    row, column = torch.triu_indices(3, 3, device=matrix.device)
    return covariance[..., row, column]


def _rows(values: Tensor, rows: Tensor, axis: int) -> Tensor:
    """``values`` at a matrix of rows; unlike indexing, its gradient adds in a fixed order."""
    return values.index_select(axis, rows.flatten()).unflatten(axis, rows.shape)


class Isometry:
    """L1 between pairwise distances in canonical space and posed (3DGS-Avatar, 1.9).

    Four neighbours per Gaussian, found among the canonical centres; the search is repeated only
    every ``refresh`` steps and after densification, since centres move slowly. Each step looks at
    ``samples`` random Gaussians, an unbiased estimate of the full mean, or at all if there are
    fewer.
    """

    def __init__(self, *, refresh: int, samples: int) -> None:
        """Nothing is searched before the first step."""
        self.refresh, self.samples = refresh, samples
        self.neighbours = torch.zeros(0, NEIGHBOURS, dtype=torch.long)
        self.age = 0

    def times(self, frame: Frame, nominal: float) -> Sequence[int]:
        """None of its own: it looks at whatever is posed."""
        return ()

    def loss(self, step: Step) -> dict[str, Tensor]:
        """``isometry_centers`` and ``isometry_covariances``."""
        gaussians, posed = step.model.gaussians, step.posed.human
        count = gaussians.human_count
        if count <= NEIGHBOURS:
            return {}
        canonical = gaussians.means  # the person's rows come first
        if self.age == 0 or self.age >= self.refresh:
            self._search(canonical[:count])
        self.age += 1
        chosen = torch.arange(count)
        if self.samples < count:
            chosen = torch.randint(count, (self.samples,), generator=step.generator)
        near = self.neighbours[chosen].to(canonical.device)
        rows = torch.cat([chosen.to(canonical.device)[:, None], near], dim=1)

        # All that a row has is gathered in one piece: the gradient of a gather is as large as its
        # source, whatever the number of rows.
        parts = (gaussians.means, gaussians.quaternions, gaussians.scales_log)
        gathered = _rows(torch.cat([part[:count] for part in parts], -1), rows, 0)
        centers, quaternions, log_scales = gathered.split((3, 4, 3), -1)
        linear = posed.transforms[..., :3, :3].flatten(-2)
        world = torch.cat([posed.means, posed.quaternions, posed.scales, linear], -1)
        gathered = _rows(world, rows, 1)
        after, posed_quaternions, posed_scales, linear = gathered.split((3, 4, 3, 9), -1)

        before = (centers[:, :1] - centers[:, 1:]).norm(dim=-1)
        after = (after[:, :, :1] - after[:, :, 1:]).norm(dim=-1)
        terms = {"isometry_centers": (after - before).abs().mean()}

        rotation = quaternion_to_matrix(quaternions)
        canonical_6 = covariance6(rotation * log_scales.exp()[..., None, :])
        rotation = linear.unflatten(-1, (3, 3)) @ quaternion_to_matrix(posed_quaternions)
        posed_6 = covariance6(rotation * posed_scales[..., None, :])
        before = (canonical_6[:, :1] - canonical_6[:, 1:]).norm(dim=-1)
        after = (posed_6[:, :, :1] - posed_6[:, :, 1:]).norm(dim=-1)
        terms["isometry_covariances"] = (after - before).abs().mean()
        return terms

    def rows_changed(self) -> None:
        """Row numbers mean other Gaussians now: search again."""
        self.age = 0

    def state(self) -> dict[str, Tensor]:
        """The neighbours and how many steps ago they were found."""
        return {"neighbours": self.neighbours, "age": torch.tensor(self.age)}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Take back what `state` gave."""
        self.neighbours, self.age = state["neighbours"], int(state["age"])

    def _search(self, canonical: Float[Tensor, "H 3"]) -> None:
        positions = canonical.detach().cpu().numpy()
        _, index = cKDTree(positions).query(positions, k=NEIGHBOURS + 1)
        self.neighbours = torch.from_numpy(index[:, 1:]).long()
        self.age = 0
