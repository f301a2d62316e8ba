"""Rows whose class is open, drawn both ways so that the picture decides (A2 iv)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from evsplat.gaussians import BodyFrames, GaussianSet, PosedHuman, SecondCopies, StaticScene
from evsplat.gaussians.flip import applied, carried, nearest_row, to_canonical, to_world

CERTAIN = 0.95
"""A row is of its class alone where the probability of that is this or more."""


@dataclass(frozen=True)
class Open:
    """Rows of an open class and where each stands in the other; fixed between densifications."""

    human_rows: Int[Tensor, " L"]
    """Of the person's rows."""
    to_world: Float[Tensor, "L 4 4"]
    """Canonical to the place in the scene."""
    scene_donors: Int[Tensor, " L"]
    """Scene rows nearest to those places, whose colours the copies show."""
    scene_rows: Int[Tensor, " K"]
    """Of the scene's rows."""
    to_canonical: Float[Tensor, "K 4 4"]
    """World to the place on the person."""
    human_donors: Int[Tensor, " K"]
    """The person's rows nearest to those places."""
    weights: Float[Tensor, "K J"]
    """Skinning weights of the body's surface there."""

    def __len__(self) -> int:
        """How many rows are drawn twice."""
        return len(self.human_rows) + len(self.scene_rows)

    def canonical(self, scene: dict[str, Tensor]) -> dict[str, Tensor]:
        """Scene rows as the person's: their attributes with centre and rotation carried over."""
        values = {name: value[self.scene_rows] for name, value in scene.items()}
        means, quaternions = carried(values["means"], values["quaternions"], self.to_canonical)
        return values | {"means": means, "quaternions": quaternions}

    def shares(self, gaussians: GaussianSet) -> Float[Tensor, " N"]:
        """How much of each row's opacity its own class has.

        That is m or 1 - m, with its gradient, and 1 for rows that are drawn once.
        """
        soft = gaussians.semantics()
        own = torch.where(gaussians.human_mask(), soft, 1 - soft)
        rows = torch.cat([self.human_rows, gaussians.human_count + self.scene_rows])
        return torch.ones_like(own).index_put((rows,), own[rows])

    def copies(
        self,
        gaussians: GaussianSet,
        others: Float[Tensor, " N"],
        posed: PosedHuman,
        standing_rgb: Float[Tensor, "L 3"],
    ) -> SecondCopies:
        """The rows in the other class.

        ``others`` are the opacities that `shares` leaves, ``posed`` the scene rows as the person's,
        ``standing_rgb`` the colours of the others.
        """
        rows, values = self.human_rows, gaussians
        means, quaternions = carried(values.means[rows], values.quaternions[rows], self.to_world)
        standing = StaticScene(means, quaternions, values.scales_log[rows].exp(), standing_rgb)
        human, scene = gaussians.of_parts(others)
        return SecondCopies(posed, standing, scene[self.scene_rows], human[rows])


class Branches:
    """Finds and keeps what is `Open` at a densification step.

    A row with 0.05 < m < 0.95 is drawn posed with opacity alpha m and standing still with
    alpha (1 - m), so that the gradient of m tells which copy explains the pixels. The copy in the
    other class stands where `flip_labels` would put the row, by the same transform of its present
    centre and rotation, and has the colour of the nearest row there.
    """

    def __init__(self, frames: BodyFrames, window: tuple[float, float]) -> None:
        """``window``: nominal iterations in which the attribute learns; outside of it all is drawn
        by its label, so that what follows can settle.
        """
        self.frames, self.window = frames, window
        self._open: Open | None = None

    def of(self, gaussians: GaussianSet, nominal: float) -> Open | None:
        """What to draw twice; None for nothing."""
        if not self.window[0] <= nominal < self.window[1]:
            return None
        if self._open is None:
            self._open = self._find(gaussians)
        device = gaussians.means.device
        if self._open.weights.device != device:  # after a resume it is on the CPU
            self._open = Open(**{name: v.to(device) for name, v in vars(self._open).items()})
        return self._open if len(self._open) else None

    @torch.no_grad()
    def _find(self, gaussians: GaussianSet) -> Open:
        human_means, scene_means = gaussians.of_parts(gaussians.means)
        # Colours come from the other class.
        both = len(human_means) > 0 and len(scene_means) > 0
        soft = gaussians.semantics()
        undecided = (soft > 1 - CERTAIN) & (soft < CERTAIN) & both
        human_rows, scene_rows = (
            torch.nonzero(part)[:, 0] for part in gaussians.of_parts(undecided)
        )
        world = to_world(self.frames, human_means[human_rows])
        near, canonical, weights = to_canonical(self.frames, scene_means[scene_rows])
        scene_rows = scene_rows[near]
        return Open(
            human_rows=human_rows,
            to_world=world,
            scene_donors=_nearest(scene_means, human_means[human_rows], world),
            scene_rows=scene_rows,
            to_canonical=canonical,
            human_donors=_nearest(human_means, scene_means[scene_rows], canonical),
            weights=weights,
        )

    def rows_changed(self) -> None:
        """Row numbers mean other Gaussians now: look again at what is open."""
        self._open = None

    def state(self) -> dict[str, Tensor]:
        """What a resume needs."""
        return {} if self._open is None else dict(vars(self._open))

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Take back what `state` gave."""
        self._open = Open(**state) if state else None


def _nearest(
    others: Float[Tensor, "M 3"], means: Float[Tensor, "K 3"], transforms: Float[Tensor, "K 4 4"]
) -> Int[Tensor, " K"]:
    """Which of ``others`` is nearest to where each row goes."""
    if len(means) == 0:
        return torch.zeros(0, dtype=torch.long, device=means.device)
    return nearest_row(others, applied(transforms, means))[1]
