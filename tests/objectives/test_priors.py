"""Priors in closed form."""

from types import SimpleNamespace

import pytest
import torch

from evsplat.objectives.priors import SkinningPrior


@pytest.mark.parametrize("seed", range(3))
def test_errors_of_weights_are_squared_summed_over_joints_and_averaged_over_points(seed):
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(40, 3, generator=generator)
    weights = torch.rand(40, 6, generator=generator)
    off = 0.2 * torch.randn(40, 6, generator=generator)
    model = SimpleNamespace(
        skinning_weights=lambda asked: (weights + off)[torch.cdist(asked, points).argmin(1)]
    )
    prior = SkinningPrior(SimpleNamespace(points=points, weights=weights), 25)
    step = SimpleNamespace(model=model, generator=torch.Generator().manual_seed(seed))
    chosen = torch.randint(40, (25,), generator=torch.Generator().manual_seed(seed))
    expected = off[chosen].square().sum() / 25
    torch.testing.assert_close(prior.loss(step)["skinning"], expected)
