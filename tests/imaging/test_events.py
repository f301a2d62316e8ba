"""Brightness change: the fused power curve against its definition, and its gradient."""

import pytest
import torch

from evsplat.imaging import decode, log_brightness, log_brightness_change, luminance


def by_definition(rgb, eps):
    return torch.log(luminance(decode(rgb.clamp_min(1 / 255), "power")) + eps)


@pytest.mark.parametrize("seed", range(3))
def test_value_and_gradient_are_those_of_the_definition(seed):
    generator = torch.Generator().manual_seed(seed)
    rgb = torch.rand(9, 7, 3, generator=generator, dtype=torch.float64)
    rgb[0], rgb[1, 0] = 0.0, torch.tensor([0.5, 1e-3, -0.2], dtype=torch.float64)
    upstream = torch.randn(9, 7, generator=generator, dtype=torch.float64)
    results = []
    for function in (lambda x: log_brightness(x, eps=1e-3), lambda x: by_definition(x, 1e-3)):
        leaf = rgb.clone().requires_grad_()
        value = function(leaf)
        results.append((value, *torch.autograd.grad(value, leaf, upstream)))
    for fused, plain in zip(*results, strict=True):
        assert torch.allclose(fused, plain, rtol=1e-12, atol=1e-14)


def test_gradcheck_of_the_change():
    before, after = (
        (0.1 + 0.9 * torch.rand(4, 5, 3, dtype=torch.float64)).requires_grad_() for _ in range(2)
    )
    assert torch.autograd.gradcheck(log_brightness_change, (before, after))


def test_a_doubled_luminance_changes_the_logarithm_by_ln_2():
    rgb = 0.2 + 0.3 * torch.rand(6, 6, 3, dtype=torch.float64)
    brighter = rgb * 2 ** (1 / 2.2)
    change = log_brightness_change(rgb, brighter, eps=0.0)
    assert (change - torch.log(torch.tensor(2.0, dtype=torch.float64))).abs().max() < 1e-12
