"""How bright discs are by their normals, which the compiled module finds."""

import pytest
import torch

from evsplat.posing.surface_discs import shade_normals


@pytest.mark.parametrize("times", [1, 3])
@pytest.mark.parametrize("seed", range(3))
def test_the_compiled_brightness_of_turned_normals_is_the_plain_one_in_float64(seed, times):
    generator = torch.Generator().manual_seed(seed)
    linear = torch.randn(times, 57, 3, 3, generator=generator)
    normals = torch.nn.functional.normalize(torch.randn(57, 3, generator=generator), dim=-1)
    light = torch.randn(8, generator=generator)
    above = torch.randn(times, 57, generator=generator)
    found = []
    for dtype in (torch.float32, torch.float64):
        given = linear.to(dtype).requires_grad_(), light.to(dtype).requires_grad_()
        value = shade_normals(given[0], normals.to(dtype), given[1])
        found.append((value, *torch.autograd.grad((value * above).sum(), given)))
    for compiled, exact in zip(*found, strict=True):
        assert (compiled - exact).abs().max() < 2e-6 * exact.abs().max()
    # Where nothing is learned of the motion, that of the light is the same.
    alone = shade_normals(linear, normals, (held := light.clone().requires_grad_()))
    (gradient,) = torch.autograd.grad((alone * above).sum(), held)
    assert torch.equal(gradient, found[0][2])


def test_a_normal_without_length_is_as_bright_as_no_direction_and_others_shapes_are_refused():
    light = torch.arange(1.0, 9.0)
    flat = torch.zeros(1, 1, 3, 3, requires_grad=True)
    shade = shade_normals(flat, torch.tensor([[0.0, 0.0, 1.0]]), light)
    assert float(shade.detach()) == 1 - 8
    (gradient,) = torch.autograd.grad(shade.sum(), flat)
    assert gradient.isfinite().all()
    for normals, factors in ((torch.zeros(2, 3), light), (torch.zeros(1, 3), light[:7])):
        with pytest.raises(ValueError, match="the normals|the light"):
            shade_normals(flat.detach(), normals, factors)
