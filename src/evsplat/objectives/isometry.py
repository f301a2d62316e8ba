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

        centers, after = _rows(canonical, rows, 0), _rows(posed.means, rows, 1)
        before = (centers[:, :1] - centers[:, 1:]).norm(dim=-1)
        after = (after[:, :, :1] - after[:, :, 1:]).norm(dim=-1)
        terms = {"isometry_centers": (after - before).abs().mean()}

        rotation = quaternion_to_matrix(_rows(gaussians.quaternions, rows, 0))
        scales = _rows(gaussians.scales_log, rows, 0).exp()
        canonical_6 = covariance6(rotation * scales[..., None, :])
        posed_rotation = _rows(posed.transforms, rows, 1)[..., :3, :3] @ quaternion_to_matrix(
            _rows(posed.quaternions, rows, 1)
        )
        posed_6 = covariance6(posed_rotation * _rows(posed.scales, rows, 1)[..., None, :])
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
