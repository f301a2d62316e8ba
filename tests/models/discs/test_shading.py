"""The person's shading: its polynomial and lamps in closed form, and normals of the surface."""

import copy
from functools import partial

import pytest
import torch

from evsplat.body import SurfaceSamples
from evsplat.models.discs.shading import NearestSurface, Shading, SurfaceLight


def sphere(count: int, generator: torch.Generator) -> SurfaceSamples:
    normals = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    return SurfaceSamples(2 * normals, normals, torch.rand(count, 3, generator=generator))


def test_nothing_is_shaded_at_the_start():
    shading = Shading(torch.zeros(3), 1.0)
    normals, places = torch.randn(2, 2, 50, 3).unbind(0)
    assert torch.equal(shading(normals, places), torch.ones(2, 50, 3))


@pytest.mark.parametrize("seed", range(3))
def test_a_lamp_above_is_a_cosine_and_grows_along_an_axis(seed):
    generator = torch.Generator().manual_seed(seed)
    shading = Shading(torch.tensor([1.0, 2.0, 3.0]), 4.0)
    normals = sphere(40, generator).normals[None]
    places = torch.tensor([1.0, 2.0, 3.0]) + torch.randn(1, 40, 3, generator=generator)
    with torch.no_grad():
        # The degree 1 harmonic of z is 0.4886 z, second of three; red brightens along x.
        shading.coefficients[0, 2, 1] = 0.3
        shading.coefficients[1, 0, 0] = 0.5
    factor = shading(normals, places)
    green = 1 + 0.3 * 0.4886025119 * normals[..., 2]
    red = 1 + 0.5 * (places[..., 0] - 1) / 4
    assert torch.allclose(factor[..., 0], red, atol=1e-6)
    assert torch.allclose(factor[..., 1], green, atol=1e-6)
    assert torch.equal(factor[..., 2], torch.ones(1, 40))


@pytest.mark.parametrize("seed", range(3))
def test_a_lamp_lights_by_the_cosine_and_the_inverse_square(seed):
    generator = torch.Generator().manual_seed(seed)
    center = torch.tensor([1.0, 2.0, 3.0])
    shading = Shading(center, 4.0, lamps=1)
    lamp = center + torch.tensor([0.0, 0.0, 2.0])
    with torch.no_grad():
        shading.intensities[0] = torch.tensor([0.5, 0.2, 0.0])
    normals = sphere(40, generator).normals[None]
    # At the centre the factor is that of the cosine, at half the distance four times it.
    for height, gain in ((0.0, 1.0), (1.0, 4.0)):
        places = (center + torch.tensor([0.0, 0.0, height])).expand(1, 40, 3)
        factor = shading(normals, places, lamp[None])
        cosine = normals[..., 2].clamp_min(0)
        expected = 1 + gain * cosine[..., None] * shading.intensities[0]
        assert torch.allclose(factor, expected.clamp(0.2, 3.0), atol=1e-5)
        share = torch.rand(1, 1, 40, generator=generator)
        shaded = 1 + share[0, ..., None] * (expected - 1)
        factor = shading(normals, places, lamp[None], share)
        assert torch.allclose(factor, shaded.clamp(0.2, 3.0), atol=1e-5)


@pytest.mark.parametrize(("lamps", "lit_times"), [(0, None), (3, None), (3, 1), (2, 4)])
@pytest.mark.parametrize("count", [1, 37, 2_050])
def test_the_compiled_light_is_the_plain_one_in_float64(lamps, lit_times, count):
    generator = torch.Generator().manual_seed(count + lamps)
    random = partial(torch.randn, generator=generator)
    shading = Shading(random(3), 1.7, lamps)
    with torch.no_grad():
        shading.coefficients.copy_(0.1 * random(4, 9, 3))
        shading.intensities.copy_(0.6 * random(lamps, 3))
    # Some places beyond what the polynomial knows, some nearer to a lamp than light grows.
    places, transforms = 2 * random(4, count, 3), random(4, count, 4, 4)
    lamp_places = (2 * random(lamps, 3)).requires_grad_()
    places[:, :lamps] = (lamp_places.detach() + 0.1)[None, :count]
    normals = sphere(count, generator).normals
    lit = None
    if lit_times is not None:
        lit = torch.rand(lamps, lit_times, count, generator=generator).requires_grad_()
    above = random(4, count, 3)
    learned = [shading.coefficients, *([shading.intensities, lamp_places] if lamps else [])]
    learned += [] if lit is None else [lit]
    light = SurfaceLight(shading, normals, lamp_places if lamps else None)
    factors = light.factors(transforms, places, lit)
    grads = torch.autograd.grad((factors * above).sum(), learned)

    exact = copy.deepcopy(shading).double()
    lamps64 = lamp_places.detach().double().requires_grad_()
    lit64 = None if lit is None else lit.detach().double().requires_grad_()
    light = SurfaceLight(exact, normals.double(), lamps64 if lamps else None)
    expected = light.factors(transforms.double(), places.double(), lit64)
    learned = [exact.coefficients, *([exact.intensities, lamps64] if lamps else [])]
    learned += [] if lit64 is None else [lit64]
    expected_grads = torch.autograd.grad((expected * above.double()).sum(), learned)
    assert (factors - expected).abs().max() < 1e-4
    # Where a factor meets its bound the two may differ by a whole gradient.
    for found, right in zip(grads, expected_grads, strict=True):
        assert (found - right).norm() < 1e-3 * right.norm() + 1e-5


@pytest.mark.parametrize("lit_times", [None, 1, 4])
@pytest.mark.parametrize("seed", range(2))
def test_gradients_of_light_on_a_fixed_surface_are_those_that_autograd_finds(seed, lit_times):
    generator = torch.Generator().manual_seed(seed)
    random = partial(torch.randn, generator=generator, dtype=torch.float64)
    shading = Shading(random(3).float(), 1.7, lamps=3).double()
    with torch.no_grad():
        shading.coefficients.copy_(0.1 * random(4, 9, 3))
        shading.intensities.copy_(0.6 * random(3, 3))
    places, transforms = 2 * random(4, 50, 3), random(4, 50, 4, 4)
    lamps = (2 * random(3, 3)).requires_grad_()
    places[:, :3] = lamps.detach() + 0.1  # nearer than light grows
    normals = sphere(50, generator).normals.double()
    lit = None if lit_times is None else random(3, lit_times, 50).sigmoid().requires_grad_()
    learned = [shading.coefficients, shading.intensities, lamps, *([] if lit is None else [lit])]
    light, above = SurfaceLight(shading, normals, lamps), random(4, 50, 3)
    turned = torch.nn.functional.normalize(transforms[..., :3, :3] @ normals[..., None], dim=-2)
    found = light.factors(transforms, places, lit), shading(turned[..., 0], places, lamps, lit)
    assert (found[0] - found[0].clamp(0.2, 3.0)).abs().max() == 0 < (found[0] == 3.0).sum()
    gradients = [torch.autograd.grad((one * above).sum(), learned) for one in found]
    for one, other in zip((found[0], *gradients[0]), (found[1], *gradients[1]), strict=True):
        assert torch.allclose(one, other, rtol=1e-9, atol=1e-9)


def test_gradcheck():
    shading = Shading(torch.zeros(3), 2.0, lamps=2).double()
    with torch.no_grad():
        shading.coefficients.normal_(std=0.05)
        shading.intensities.normal_(std=0.1)
    inputs = [torch.randn(2, 5, 3, dtype=torch.float64).requires_grad_() for _ in range(2)]
    inputs.append((3 + torch.rand(2, 3, dtype=torch.float64)).requires_grad_())
    assert torch.autograd.gradcheck(lambda *x: shading(*x), inputs)
    for name, value in shading.named_parameters():
        sums = lambda v, name=name: torch.func.functional_call(shading, {name: v}, tuple(inputs))  # noqa: E731
        assert torch.autograd.gradcheck(sums, value.detach().requires_grad_())


@pytest.mark.parametrize("seed", range(3))
def test_evened_weights_stay_shares_and_jump_between_no_neighbours(seed):
    generator = torch.Generator().manual_seed(seed)
    points = sphere(4_000, generator).points
    upper = (points[:, 2:] > 0).float()
    surface = NearestSurface(SurfaceSamples(points, points / 2, torch.cat([upper, 1 - upper], -1)))
    before, apart = surface.weights(points), torch.cdist(points, points)
    surface.even_out(points)
    after = surface.weights(points)
    assert torch.equal(surface.normals(points), points / 2)
    assert torch.allclose(after.sum(-1), torch.ones(len(points)), atol=1e-5)
    assert float(after.min()) > -1e-6
    closest = apart.fill_diagonal_(torch.inf).argmin(1)
    jumps = lambda weights: (weights[closest] - weights)[:, 0].abs()  # noqa: E731
    assert float(jumps(before).max()) == 1
    # Two alone, linked by 1, would be left a third apart; others pull at them.
    assert float(jumps(after).max()) < 0.6
    # What lies farther from the rim than a few neighbours is as it was.
    far = points[:, 2].abs() > 0.8
    assert torch.allclose(after[far], before[far], atol=0.01)
    surface.rows_changed()
    assert torch.equal(surface.weights(points), before)


@pytest.mark.parametrize("seed", range(3))
def test_what_the_nearest_surface_gives_follows_changed_rows(seed):
    generator = torch.Generator().manual_seed(seed)
    surface = NearestSurface(sphere(20_000, generator))
    radial = sphere(300, generator).normals
    points = radial * (1 + 2 * torch.rand(300, 1, generator=generator))
    place = torch.cdist(points, surface.surface.points).argmin(1)
    assert torch.equal(surface.normals(points), surface.surface.normals[place])
    assert torch.equal(surface.weights(points), surface.surface.weights[place])
    assert torch.equal(surface.normals(-points), surface.normals(points))  # until rows change
    resumed = NearestSurface(surface.surface)
    resumed.load_state(surface.state())
    assert torch.equal(resumed.normals(-points), surface.normals(points))
    surface.rows_changed()
    assert ((surface.normals(-points) * -radial).sum(-1) > 0.995).all()
