"""The one set of Gaussians: person and scene together, told apart by a semantic attribute."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

FEATURE_DIM = 32
"""Inputs of the colour networks per Gaussian."""
COLOURS = ("features", "colour_logits")
"""Names of the attribute of colour: input of a network, or the colour itself."""

Part = Literal["human", "scene"]
"""The two classes."""


@dataclass(frozen=True)
class Shape:
    """Geometry of ``N`` Gaussians as they are drawn, for densification; without gradient."""

    scales: Float[Tensor, "N 3"]
    """Standard deviations, metres."""
    quaternions: Float[Tensor, "N 4"]
    opacities: Float[Tensor, " N"]


class Rows(nn.Module):
    """Learned values per Gaussian, of any names; rows ``[0, human_count)`` are the person's.

    The hard label is the row's place, not a tensor: it changes at densification steps only, when
    ``rebuild`` moves rows, so a row can never be in one class and be treated as the other. A set
    that densifies has ``means`` and ``scales_log``, on which the sizes of its Gaussians depend.
    """

    means: nn.Parameter
    """(N, 3) centre, metres."""
    scales_log: nn.Parameter

    def __init__(self, values: Mapping[str, Tensor], human_count: int) -> None:
        """``values`` name the attributes, each with a leading axis of rows."""
        super().__init__()
        self.attributes = tuple(values)
        self.human_count = human_count
        for name, value in values.items():
            setattr(self, name, nn.Parameter(value.float()))

    def __len__(self) -> int:
        """Number of Gaussians of both classes."""
        return len(self.means)

    @property
    def scene_count(self) -> int:
        """Number of Gaussians of the scene."""
        return len(self) - self.human_count

    @property
    def human(self) -> slice:
        """Rows of the person."""
        return slice(0, self.human_count)

    @property
    def scene(self) -> slice:
        """Rows of the scene."""
        return slice(self.human_count, len(self))

    def rows_of(self, part: Part) -> slice:
        """Rows of one class by its name."""
        return self.human if part == "human" else self.scene

    def holds(self, part: Part) -> bool:
        """True if Gaussians of this class can be in the set."""
        return True

    def human_mask(self) -> Bool[Tensor, " N"]:
        """Hard label h per row."""
        mask = torch.zeros(len(self), dtype=torch.bool, device=self.means.device)
        mask[self.human] = True
        return mask

    def set_rows(self, values: Mapping[str, Tensor], human_count: int) -> None:
        """Replace all rows, person first; the parameters become new objects."""
        for name in self.attributes:
            setattr(self, name, nn.Parameter(values[name].detach().contiguous()))
        self.human_count = human_count

    def shape(self) -> Shape:
        """Sizes, rotations and opacities as they are drawn."""
        raise NotImplementedError


class OneClassRows(Rows):
    """A set whose Gaussians are all of one class, for ever."""

    def __init__(self, values: Mapping[str, Tensor], part: Part) -> None:
        """``values`` name the attributes, each with a leading axis of rows."""
        super().__init__(values, len(values["means"]) if part == "human" else 0)
        self.part: Part = part

    def holds(self, part: Part) -> bool:
        """True for the set's class."""
        return part == self.part

    def set_rows(self, values: Mapping[str, Tensor], human_count: int) -> None:
        """Replace all rows; the class tells how many of them are the person's."""
        super().set_rows(values, len(values["means"]) if self.part == "human" else 0)


class GaussianSet(Rows):
    """Person and scene in one set.

    The person's Gaussians live in canonical metres, those of the scene in world metres (A6). Beside
    the attributes below there is one of colour, see `COLOURS`: (N, 32) inputs of colour networks,
    or (N, 3) sRGB before the sigmoid.
    """

    scales_log: nn.Parameter
    """(N, 3) natural logarithm of the standard deviations, metres."""
    quaternions: nn.Parameter
    """(N, 4) rotation (w, x, y, z), normalised where it is used."""
    opacity_logits: nn.Parameter
    """(N,) opacity before the sigmoid."""
    semantic_logits: nn.Parameter
    """(N,) l in ``m = sigmoid(l)``, the probability of "person" (paper eq. 4-5, A1)."""

    def __init__(self, human: Mapping[str, Tensor], scene: Mapping[str, Tensor]) -> None:
        """Join the two starts, which have the same attributes; see `gaussians_at`."""
        joined = {name: torch.cat([human[name], scene[name]]) for name in human}
        super().__init__(joined, len(human["means"]))

    @property
    def colour(self) -> str:
        """Name of the attribute of colour."""
        return next(name for name in self.attributes if name in COLOURS)

    def of_parts(self, values: Float[Tensor, "N *rest"]) -> tuple[Tensor, Tensor]:
        """Values per row, apart for person and scene.

        One split: two slices would each fill a gradient of all rows with zeros.
        """
        human, scene = values.split([self.human_count, self.scene_count])
        return human, scene

    def opacities(self) -> Float[Tensor, " N"]:
        """Opacity in (0, 1)."""
        return torch.sigmoid(self.opacity_logits)

    def semantics(self) -> Float[Tensor, " N"]:
        """Soft probability of "person", m in (0, 1) (paper eq. 5)."""
        return torch.sigmoid(self.semantic_logits)

    def shape(self) -> Shape:
        """Read from the attributes."""
        return Shape(
            self.scales_log.detach().exp(), self.quaternions.detach(), self.opacities().detach()
        )


def human_first(
    is_human: Bool[Tensor, " N"], source: Int[Tensor, " N"]
) -> tuple[Int[Tensor, " N"], int]:
    """Order that brings the person's rows to the front (stable), and their number."""
    order = torch.argsort((~is_human).to(torch.int8), stable=True)
    return source[order], int(is_human.sum())
