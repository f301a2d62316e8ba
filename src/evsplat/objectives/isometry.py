"""As isometric as possible: neighbours keep their distances and covariances when posed."""

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from evsplat.body.rotations import quaternion_to_matrix
from evsplat.compiled import native, runs_native
from evsplat.devices import send
from evsplat.models.paper import PaperModel
from evsplat.neighbours import nearest
from evsplat.objectives.base import LookedUp, Step

NEIGHBOURS = 4
MOST_TIMES = 2


def covariance6(matrix: Float[Tensor, "*N 3 3"]) -> Float[Tensor, "*N 6"]:
    """Upper triangle of ``M M^T``."""
    covariance = matrix @ matrix.transpose(-1, -2)
    row, column = torch.triu_indices(3, 3, device=matrix.device)
    return covariance[..., row, column]


def isometry_change(
    rows: Int[Tensor, "S 5"],
    canonical: tuple[Float[Tensor, "N 3"], Float[Tensor, "N 4"], Float[Tensor, "N 3"]],
    posed: tuple[
        Float[Tensor, "T H 3"],
        Float[Tensor, "T H 4"],
        Float[Tensor, "T H 3"],
        Float[Tensor, "T H 4 4"],
    ],
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Mean absolute change of neighbours' distances, and of their covariances' distances.

    ``rows`` are a Gaussian and its neighbours, all below H. ``canonical`` holds centres,
    quaternions and log-scales, ``posed`` centres, quaternions, scales and the transforms that carry
    covariances on. The distance of two covariances is that of their upper triangles.
    """
    if all(map(runs_native, (*canonical, *posed))):
        native_centers, native_covariances = _NativeIsometry.apply(rows, *canonical, *posed)
        return native_centers, native_covariances
    means, quaternions, log_scales = (_rows(part, rows, 0) for part in canonical)
    after, posed_quaternions, posed_scales, transforms = (_rows(part, rows, 1) for part in posed)
    before = (means[:, :1] - means[:, 1:]).norm(dim=-1)
    after = (after[:, :, :1] - after[:, :, 1:]).norm(dim=-1)
    centers = (after - before).abs().mean()

    canonical_6 = covariance6(quaternion_to_matrix(quaternions) * log_scales.exp()[..., None, :])
    rotation = transforms[..., :3, :3] @ quaternion_to_matrix(posed_quaternions)
    posed_6 = covariance6(rotation * posed_scales[..., None, :])
    before = (canonical_6[:, :1] - canonical_6[:, 1:]).norm(dim=-1)
    after = (posed_6[:, :, :1] - posed_6[:, :, 1:]).norm(dim=-1)
    return centers, (after - before).abs().mean()


class _NativeIsometry(torch.autograd.Function):
    """`isometry_change` in the compiled module; gradients are found on the way forward."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, *arrays: Tensor) -> tuple[Tensor, Tensor]:
        given = [array.detach().contiguous() for array in arrays]
        rows = rows.contiguous()
        times = len(given[3])
        gradients = torch.empty(len(rows), native.isometry_floats(times))
        centers, covariances = native.isometry(rows, given, gradients, torch.get_num_threads())
        ctx.shapes = [array.shape for array in arrays]
        ctx.save_for_backward(rows, gradients)
        return arrays[0].new_tensor(centers), arrays[0].new_tensor(covariances)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        grads = [torch.empty(shape) for shape in ctx.shapes]
        slopes = map(float, upstream)
        native.isometry_write(*ctx.saved_tensors, *slopes, grads, torch.get_num_threads())
        return None, *grads


def _rows(values: Tensor, rows: Tensor, axis: int) -> Tensor:
    """``values`` at a matrix of rows; unlike indexing, its gradient adds in a fixed order."""
    return values.index_select(axis, rows.flatten()).unflatten(axis, rows.shape)


class Isometry(LookedUp):
    """L1 between pairwise distances in canonical space and posed (3DGS-Avatar).

    Four neighbours per Gaussian, looked up among the canonical centres. Each step looks at
    ``samples`` random Gaussians, an unbiased estimate of the full mean, or at all if there are
    fewer, at whatever times are posed.
    """

    name = "neighbours"

    def __init__(self, *, refresh: int, samples: int) -> None:
        """Nothing is searched before the first step."""
        super().__init__(refresh=refresh)
        self.samples = samples

    def loss(self, step: Step[PaperModel]) -> dict[str, Tensor]:
        """``isometry_centers`` and ``isometry_covariances``."""
        gaussians, posed = step.model.gaussians, step.layers.human
        count = gaussians.human_count
        if count <= NEIGHBOURS:
            return {}
        canonical = gaussians.means  # the person's rows come first
        neighbours = self.looked_up(
            lambda: nearest(canonical[:count], NEIGHBOURS)[1], canonical.device
        )
        chosen = torch.arange(count)
        if self.samples < count:
            chosen = torch.randint(count, (self.samples,), generator=step.generator)
        chosen = send(chosen, canonical.device)
        rows = torch.cat([chosen[:, None], neighbours[chosen]], dim=1)

        at_rest = (gaussians.means, gaussians.quaternions, gaussians.scales_log)
        # Two of the times are enough: a step's lie close to each other.
        times = len(posed.means)
        every = -(-times // MOST_TIMES)
        moved = (
            posed.means,
            # What is the same at all times may have an axis of one.
            posed.quaternions.expand(times, -1, -1),
            posed.scales.expand(times, -1, -1),
            step.layers.transforms,
        )
        if every > 1:  # else a slice of all is made, whose gradient autograd copies
            means, quaternions, scales, transforms = (part[::every] for part in moved)
            moved = means, quaternions, scales, transforms
        centers, covariances = isometry_change(rows, at_rest, moved)
        return {"isometry_centers": centers, "isometry_covariances": covariances}
