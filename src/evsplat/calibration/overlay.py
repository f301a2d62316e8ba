"""How pictures lie over each other, however bright the camera made each of them."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import affine_grid, avg_pool2d, grid_sample

Ways = Float[Tensor, "P 2 3"]
"""Affine, as of `torch.nn.functional.affine_grid`: where a place of the first picture lies in the
second; both reach from -1 to 1."""

_POOLED = (4, 2, 1)
"""Squares of pixels that are one, coarse to fine."""
_ROUNDS = 8
"""Steps of Gauss-Newton at each."""
_DAMPING = 1e-4
INSIDE = 0.99
"""What is carried of a map of ones is more where a whole pixel of it lies there."""
_LEAST_ERROR = 1e-3


def unmoved(count: int) -> Ways:
    """Pictures that lie over each other as they are."""
    return torch.eye(2, 3).repeat(count, 1, 1)


def one_after_the_other(first: Ways, second: Ways) -> Ways:
    """From a first picture to a second, and from there to a third."""
    last = torch.tensor([0.0, 0.0, 1.0]).expand(len(first), 1, 3)
    return (torch.cat([second, last], 1) @ torch.cat([first, last], 1))[:, :2]


def back(ways: Ways) -> Ways:
    """Where a place of the second picture lies in the first."""
    turn = torch.linalg.inv(ways[:, :, :2])
    return torch.cat([turn, -turn @ ways[:, :, 2:]], 2)


def carried(pictures: Float[Tensor, "P C H W"], ways: Ways) -> Float[Tensor, "P C H W"]:
    """What second pictures show at each place of the first; 0 beyond them."""
    grid = affine_grid(ways, list(pictures.shape), align_corners=False)
    return grid_sample(pictures, grid, align_corners=False)


def laid_over(logs: Float[Tensor, "P 2 H W"], usable: Bool[Tensor, "P 2 H W"], start: Ways) -> Ways:
    """The ways at which second pictures differ least from first ones, but for one factor of light.

    The rest of what differs, as a person who moves and what stands nearer than the rest, is
    weighed down (Geman and McClure). From ``start`` on ways are found that are off by up to about
    a tenth of the picture.

    Args:
        logs: Logarithms of the light of the first and the second picture.
        usable: Pixels that are neither dark nor clipped.
        start: The ways as far as they are known.
    """
    ways, change = start.clone(), torch.zeros(len(start))
    for side in _POOLED:
        here, there = avg_pool2d(logs, side).split(1, 1)
        seen, kept = avg_pool2d(usable.float(), side).split(1, 1)
        rows, columns = there.shape[2:]
        down, right = torch.gradient(there, dim=(2, 3))
        stack = torch.cat([there, right * columns / 2, down * rows / 2, kept], 1)
        x, y = affine_grid(unmoved(1), [1, 1, rows, columns], align_corners=False)[0].unbind(-1)
        for _ in range(_ROUNDS):
            value, along_x, along_y, covered = carried(stack, ways).unbind(1)
            inside = (covered > INSIDE) & (seen[:, 0] > INSIDE)
            error = torch.where(inside, value - here[:, 0] - change[:, None, None], 0.0)
            usual = torch.where(inside, error.abs(), torch.nan).flatten(1).nanmedian(1).values
            scale = 3 * usual.nan_to_num().clamp_min(_LEAST_ERROR)[:, None, None]
            weight = inside / (1 + (error / scale) ** 2) ** 2
            slopes = torch.stack(
                [along_x * x, along_x * y, along_x, along_y * x, along_y * y, along_y], -1
            )
            slopes = torch.cat([slopes, -torch.ones_like(error)[..., None]], -1)
            weighted = slopes * weight[..., None]
            system = torch.einsum("phwi,phwj->pij", weighted, slopes)
            system += _DAMPING * (torch.diag_embed(system.diagonal(dim1=1, dim2=2)) + torch.eye(7))
            step = torch.linalg.solve(system, torch.einsum("phwi,phw->pi", weighted, error))
            ways, change = ways - step[:, :6].reshape(-1, 2, 3), change - step[:, 6]
    return ways
