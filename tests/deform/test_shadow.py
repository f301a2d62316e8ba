"""The person's shadow against the sum over all casters, and where it must not fall."""

import pytest
import torch

from evsplat.body import SurfaceSamples
from evsplat.deform.shadow import BodyShadow

UP = torch.tensor([0.0, 0.0, 1.0])


def make(lights: int = 1) -> BodyShadow:
    casters = SurfaceSamples(torch.zeros(9, 3), torch.zeros(9, 3), torch.ones(9, 1))
    return BodyShadow(casters, UP, lights).double()


def column(seed: int = 0) -> torch.Tensor:
    """Casters of a person standing at the origin."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(1, 200, 3, generator=generator, dtype=torch.float64)
    return (points - torch.tensor([0.5, 0.5, 0.0])) * torch.tensor([0.5, 0.4, 1.8])


def floor(height: float = 0.0) -> torch.Tensor:
    line = torch.linspace(-2.5, 2.5, 41, dtype=torch.float64)
    x, y = torch.meshgrid(line, line, indexing="ij")
    return torch.stack([x, y, torch.full_like(x, height)], -1)


@pytest.mark.parametrize("seed", range(3))
def test_optical_depth_is_the_sum_over_the_casters(seed):
    shadow, body, places = make(), column(seed), floor()
    torch.manual_seed(seed)
    with torch.no_grad():
        shadow.directions[0] = UP + 0.4 * torch.randn(3)
        shadow.widths_log.fill_(-1.5)
    factor = shadow(body, places)[0]
    light = torch.nn.functional.normalize(shadow.directions[0], dim=0)
    width, share = 0.03 + torch.exp(torch.tensor(-1.5)), torch.sigmoid(shadow.share_logits[0])
    apart = places[:, :, None] - body[0]
    apart = apart - (apart @ light)[..., None] * light
    bells = torch.exp(-0.5 * (apart.norm(dim=-1) / width).square()).sum(-1)
    depth = bells * 3.0 * 0.5 / (200 * 2 * torch.pi * width**2)
    behind = (body.mean(1) - places) @ light  # fades out where the body is not between
    depth = depth * torch.sigmoid((behind + 0.2) / 0.1)
    expected = 1 - share * (1 - torch.exp(-depth))
    near = (places - body.mean(1)).norm(dim=-1) < 1.4
    assert (factor - expected)[near].abs().max() < 0.01
    assert factor.min() < 1 - 0.5 * share


def test_what_is_between_the_body_and_the_light_and_what_is_far_stays_lit():
    shadow, body = make(), column()
    assert (shadow(body, floor(height=2.5)) > 0.999).all()
    factor = shadow(body, floor())[0]
    assert (factor[floor().norm(dim=-1) > 1.0] > 0.999).all()
    assert factor[20, 20] < 0.95


def test_no_share_of_the_light_is_no_shadow():
    shadow = make(lights=3)
    with torch.no_grad():
        shadow.share_logits.fill_(-50.0)
    assert torch.equal(shadow(column(), floor()), torch.ones(1, 41, 41, dtype=torch.float64))


def test_gradients_of_lights_and_body_equal_finite_differences():
    shadow, places = make(lights=2), floor()[10:31:5, 10:31:5]
    parameters = dict(shadow.named_parameters())

    def factor(body, *values):
        named = dict(zip(parameters, values, strict=True))
        return torch.func.functional_call(shadow, named, (body, places))

    body = column()[:, ::20].requires_grad_()
    values = [value.detach().requires_grad_() for value in parameters.values()]
    # Bilinear look-up has kinks at the cells' borders, which a small step does not meet.
    assert torch.autograd.gradcheck(factor, (body, *values), eps=1e-7, atol=1e-5)
