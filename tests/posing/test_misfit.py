"""How far drawings are from pictures, which the compiled module finds, against plain float64."""

from dataclasses import replace

import pytest
import torch

from evsplat.camera import Camera
from evsplat.compiled import native
from evsplat.posing.misfit import misfits
from evsplat.posing.targets import Targets
from evsplat.render import RenderOutput

PICTURES, HEIGHT, WIDTH = 4, 9, 11


def scene(seed, coloured):
    """Pictures of which a third of the pixels count, in the last one none, and drawings."""
    generator = torch.Generator().manual_seed(seed)

    def values(*shape):
        return torch.rand(PICTURES, *shape, generator=generator)

    camera = Camera(WIDTH, HEIGHT, torch.eye(3), torch.eye(4))
    weight = (values(HEIGHT, WIDTH) - 2 / 3).clamp_min(0)
    weight[-1] = 0
    image, behind = values(HEIGHT, WIDTH, 3), values(HEIGHT, WIDTH, 3)
    trust = torch.ones(PICTURES, HEIGHT, WIDTH)
    coloured = torch.tensor(coloured)
    times = list(range(PICTURES))
    targets = Targets(times, [], coloured, image, behind, weight, trust, camera, "power")
    planes = values(3, HEIGHT, WIDTH).requires_grad_()
    return targets, planes, values(HEIGHT, WIDTH).requires_grad_()


def found(targets, planes, alpha, above):
    output = RenderOutput(planes.permute(0, 2, 3, 1), alpha, alpha, alpha)
    sums = misfits(output, targets)
    return sums, *torch.autograd.grad((sums * above).sum(), (planes, alpha))


@pytest.mark.parametrize("coloured", [[True] * 4, [True, False, True, False]])
@pytest.mark.parametrize("seed", range(3))
def test_the_compiled_misfit_and_its_gradients_are_the_plain_ones_in_float64(seed, coloured):
    targets, planes, alpha = scene(seed, coloured)
    above = torch.randn(PICTURES, generator=torch.Generator().manual_seed(seed))
    single = found(targets, planes, alpha, above)
    exact = replace(
        targets,
        image=targets.image.double(),
        behind=targets.behind.double(),
        weight=targets.weight.double(),
    )
    planes64, alpha64 = (one.detach().double().requires_grad_() for one in (planes, alpha))
    double = found(exact, planes64, alpha64, above.double())
    for compiled, plain in zip(single, double, strict=True):
        assert (compiled - plain).abs().max() < 2e-6 * plain.abs().max()
    assert single[0][-1].item() == 0 and not single[1][-1].any()
    with torch.no_grad():
        output = RenderOutput(planes.permute(0, 2, 3, 1), alpha, alpha, alpha)
        assert torch.equal(misfits(output, targets), single[0])


def test_a_pixel_that_differs_costs_what_the_formula_says():
    """Colours 0.06 apart in one channel: log(1 + 1/2) by the weight."""
    targets, planes, alpha = scene(0, [True] * 4)
    weight = torch.zeros_like(targets.weight)
    weight[1, 2, 3] = 0.5
    targets = replace(targets, weight=weight)
    with torch.no_grad():
        alpha[1, 2, 3] = 1.0
        planes[1, :, 2, 3] = targets.image[1, 2, 3] + torch.tensor([0.06, 0, 0])
        output = RenderOutput(planes.permute(0, 2, 3, 1), alpha, alpha, alpha)
        sums = misfits(output, targets)
    assert sums.tolist() == pytest.approx([0, 0.5 * torch.tensor(1.5).log().item(), 0, 0], abs=1e-6)


def test_colours_that_are_no_number_make_no_number_of_their_picture_alone():
    targets, planes, alpha = scene(1, [True] * 4)
    pixel = torch.nonzero(targets.weight[2])[0]
    with torch.no_grad():
        planes[2, 1, pixel[0], pixel[1]] = torch.nan
        output = RenderOutput(planes.permute(0, 2, 3, 1), alpha, alpha, alpha)
        assert misfits(output, targets).isnan().tolist() == [False, False, True, False]


def test_the_compiled_module_refuses_places_outside_of_pictures():
    targets, planes, alpha = scene(2, [True] * 4)
    looked, planes, alpha = targets.looked, planes.detach(), alpha.detach()
    colours = torch.empty_like(looked.behind)
    outside = looked.pixel.clone()
    for bad in (-1, HEIGHT * WIDTH):
        outside[-1] = bad
        with pytest.raises(ValueError, match="outside of the picture"):
            at = outside, looked.ends, looked.behind
            native.colours_before(planes, alpha, *at, colours, 1)
    for ends in (looked.ends - 1, looked.ends.flip(0)):
        with pytest.raises(ValueError, match="the pictures' ends"):
            at = looked.pixel, ends, looked.behind
            native.colours_before(planes, alpha, *at, colours, 1)
