"""Densification: where Gaussians are cloned, split and pruned, each class by its own limits."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from evsplat.body.rotations import quaternion_to_matrix
from evsplat.devices import send
from evsplat.gaussians.gaussian_set import Part, Rows, Shape, human_first
from evsplat.gaussians.row_adam import RowAdam


@dataclass(frozen=True)
class DensifyLimits:
    """Limits of one class, in nominal iterations (of 15,000) and metres; 3DGS-Avatar's, see A20."""

    start: float = 1_000
    """First nominal iteration."""
    end: float = 10_000
    """Last nominal iteration."""
    every: float = 100
    """Nominal iterations between edits."""
    gradient: float = 2e-4
    """A Gaussian is cloned or split above this mean screen-space gradient (NDC units, as 3DGS)."""
    split_above_m: float = 0.035
    """Larger Gaussians are split in two, smaller ones cloned, metres."""
    prune_opacity: float = 0.05
    """Fainter Gaussians are removed."""
    prune_after: float = 3_000
    """Nominal iteration from which the two size limits below hold."""
    prune_screen_px: float | None = 20
    """Largest 3-sigma radius on the screen, pixels; None = no limit (scene)."""
    prune_scale_m: float | None = 0.35
    """Largest standard deviation, metres; None = no limit (scene)."""
    max_count: int = 60_000
    """No clone or split beyond this number of Gaussians."""


@dataclass
class ScreenStatistics:
    """Statistics of the renders since the last edit, one row per Gaussian."""

    gradient_sum: Float[Tensor, " N"]
    """Sum of the norms of the gradients of the 2-D centres, NDC units."""
    seen: Float[Tensor, " N"]
    """Number of renders in which the Gaussian was drawn."""
    radius_px: Float[Tensor, " N"]
    """Largest 3-sigma radius on the screen, pixels."""

    @classmethod
    def zeros(cls, count: int, device: torch.device) -> "ScreenStatistics":
        """Statistics before the first render."""
        return cls(*(torch.zeros(count, device=device) for _ in range(3)))

    def to(self, device: torch.device) -> "ScreenStatistics":
        """The same statistics on ``device``."""
        return ScreenStatistics(*(value.to(device) for value in vars(self).values()))

    def add(
        self,
        rows: slice,
        centers_gradient: Float[Tensor, "T M 2"],
        radii: Int[Tensor, "T M"],
        width: int,
        height: int,
    ) -> None:
        """Count T renders of the M Gaussians of ``rows``.

        Gradients are of the loss with respect to centres in pixels; one time for Gaussians that
        are the same in all renders.
        """
        # The T renders share one mean loss; 3DGS's threshold is for the loss of a single view.
        half = torch.tensor([width / 2, height / 2], dtype=centers_gradient.dtype)
        scale = send(half * len(centers_gradient), centers_gradient.device)
        visible = radii > 0
        # What is not drawn may have no number.
        norms = (centers_gradient * scale).norm(dim=-1).masked_fill(~visible, 0)
        self.gradient_sum[rows] += norms.sum(0)
        self.seen[rows] += visible.sum(0)
        radius = self.radius_px[rows]
        torch.maximum(radius, radii.amax(0).float(), out=radius)

    def mean_gradient(self) -> Float[Tensor, " N"]:
        """Mean gradient per render in which the Gaussian was drawn."""
        return self.gradient_sum / self.seen.clamp_min(1)


def densify(
    gaussians: Rows,
    optimiser: RowAdam,
    statistics: ScreenStatistics,
    limits: dict[Part, DensifyLimits],
    nominal: float,
    generator: torch.Generator,
) -> None:
    """Clone, split and prune every class that is in its window; labels are inherited exactly.

    ``limits`` may name ``human`` and ``scene``; a class without limits is left alone. Optimiser
    moments follow kept rows and start at zero for new ones.
    """
    due = {part: limit for part, limit in limits.items() if limit.start <= nominal < limit.end}
    if not due:
        return
    shape = gaussians.shape()
    keep = torch.ones(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
    clone, split = torch.zeros_like(keep), torch.zeros_like(keep)
    for part, limit in due.items():
        rows = gaussians.rows_of(part)
        keep[rows], clone[rows], split[rows] = _decide(shape, statistics, rows, limit, nominal)
    if bool(keep.all()) and not bool((clone | split).any()):
        return

    every = torch.arange(len(gaussians), device=keep.device)
    survivors = every[keep & ~split]
    children = every[split].repeat_interleave(2)
    source = torch.cat([survivors, every[clone], children])
    fresh = torch.ones(len(source), dtype=torch.bool, device=keep.device)
    fresh[: len(survivors)] = False

    values = {name: getattr(gaussians, name).detach()[source] for name in gaussians.attributes}
    first_child = len(source) - len(children)
    offsets = _offsets_inside(shape, children, generator)
    values["means"][first_child:] += offsets
    values["scales_log"][first_child:] -= torch.log(torch.tensor(1.6))
    rebuild(gaussians, optimiser, values, source, fresh, gaussians.human_mask()[source])


def rebuild(
    gaussians: Rows,
    optimiser: RowAdam,
    values: dict[str, Tensor],
    source: Int[Tensor, " M"],
    fresh: Bool[Tensor, " M"],
    is_human: Bool[Tensor, " M"],
) -> None:
    """Give the set new rows: the one place where rows and optimiser moments move together.

    ``values`` holds the new rows, ``source`` the old row each comes from, ``fresh`` whether its
    moments restart, ``is_human`` its class.
    """
    order, human_count = human_first(is_human, torch.arange(len(source), device=source.device))
    gaussians.set_rows({name: value[order] for name, value in values.items()}, human_count)
    parameters = {name: getattr(gaussians, name) for name in gaussians.attributes}
    optimiser.move_rows(parameters, source[order], fresh[order])


def _decide(
    shape: Shape,
    statistics: ScreenStatistics,
    rows: slice,
    limit: DensifyLimits,
    nominal: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Masks of the rows of one class that are kept, cloned and split."""
    largest = shape.scales[rows].amax(-1)
    keep = shape.opacities[rows] >= limit.prune_opacity
    if nominal >= limit.prune_after:
        if limit.prune_screen_px is not None:
            keep &= statistics.radius_px[rows] <= limit.prune_screen_px
        if limit.prune_scale_m is not None:
            keep &= largest <= limit.prune_scale_m
    gradient = statistics.mean_gradient()[rows]
    grow = keep & (gradient > limit.gradient)
    room = limit.max_count - int(keep.sum())
    if int(grow.sum()) > room:
        # Within the cap, the Gaussians with the largest gradients go first.
        ranked = torch.where(grow, gradient, gradient.new_tensor(-1.0)).argsort(descending=True)
        grow = torch.zeros_like(grow)
        grow[ranked[: max(room, 0)]] = True
    large = largest > limit.split_above_m
    return keep, grow & ~large, grow & large


def _offsets_inside(
    shape: Shape, rows: Int[Tensor, " M"], generator: torch.Generator
) -> Float[Tensor, "M 3"]:
    """One random offset per row, drawn from the row's own Gaussian, metres."""
    scales = shape.scales[rows]
    noise = torch.randn(len(rows), 3, generator=generator).to(scales.device) * scales
    rotation = quaternion_to_matrix(shape.quaternions[rows])
    return (rotation @ noise[..., None])[..., 0]
