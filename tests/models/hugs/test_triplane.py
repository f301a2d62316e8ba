"""Look-up in the triplane against PyTorch's own sampler."""

import pytest
import torch
from torch.nn.functional import grid_sample

from evsplat.models.hugs.triplane import Triplane


def sampled(plane: Triplane, positions: torch.Tensor) -> torch.Tensor:
    """The same by `grid_sample`, one plane at a time."""
    side = plane.resolution
    place = (positions - plane.center) / plane.half_side
    planes = plane.texels.view(3, side, side, -1).permute(0, 3, 1, 2)
    features = []
    for number, axes in enumerate(([0, 1], [0, 2], [1, 2])):
        found = grid_sample(
            planes[number][None],
            place[None, None][..., axes],
            align_corners=True,
            padding_mode="border",
        )
        features.append(found[0, :, 0].T)
    return torch.cat(features, 1)


@pytest.mark.parametrize("seed", range(3))
def test_values_and_gradients_are_those_of_grid_sample(seed):
    torch.manual_seed(seed)
    plane = Triplane(5, 9, torch.randn(3), 0.7).double()
    # A third of the points lies outside of the cube.
    positions = plane.center + 0.7 * (3 * torch.rand(60, 3, dtype=torch.float64) - 1.5)
    upstream = torch.randn(60, 15, dtype=torch.float64)
    results = []
    for look_up in (plane, lambda points: sampled(plane, points)):
        points = positions.clone().requires_grad_()
        plane.zero_grad()
        features = look_up(points)
        features.backward(upstream)
        results.append((features.detach(), points.grad, plane.texels.grad.clone()))
    for found, expected in zip(*results, strict=True):
        torch.testing.assert_close(found, expected)


def test_corners_of_the_cube_are_corner_texels():
    plane = Triplane(2, 4, torch.zeros(3), 1.0)
    found = plane(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))
    texels = plane.texels.view(3, 16, 2)
    assert torch.equal(found[0], texels[:, 0].flatten())
    assert torch.equal(found[1], texels[:, -1].flatten())
