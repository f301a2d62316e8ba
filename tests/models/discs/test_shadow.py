"""The person's shadows against the sum over all casters, and where they must not fall."""

import pytest
import torch

from evsplat import _native
from evsplat.body import SurfaceSamples
from evsplat.models.discs.shadow import BodyShadow, Lamps

LAMP = torch.tensor([[0.3, -0.2, 3.5]], dtype=torch.float64)


def make(lamps: int = 1) -> BodyShadow:
    casters = SurfaceSamples(torch.zeros(9, 3), torch.zeros(9, 3), torch.ones(9, 1))
    return BodyShadow(casters, lamps, on_body=True).double()


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
def test_optical_depth_is_the_sum_over_the_casters_as_the_lamp_sees_them(seed):
    shadow, body, places = make(), column(seed), floor()
    generator = torch.Generator().manual_seed(seed)
    lamp = LAMP[0] + 0.5 * torch.randn(3, generator=generator, dtype=torch.float64)
    with torch.no_grad():
        shadow.widths_log.fill_(-1.5)
    factor = shadow(body, places, lamp[None])[0]
    width, share = 0.03 + torch.exp(torch.tensor(-1.5)), torch.sigmoid(shadow.share_logits[0])
    middle = body[0].mean(0)
    axis = (middle - lamp) / (middle - lamp).norm()

    def on_plane(points):
        """Where the ray from the lamp through a point meets the plane through the middle."""
        ray = points - lamp
        return lamp + ray * ((middle - lamp) @ axis / (ray @ axis))[..., None]

    apart = on_plane(places)[:, :, None] - on_plane(body[0])
    bells = torch.exp(-0.5 * (apart.norm(dim=-1) / width).square()).sum(-1)
    depth = bells * 3.0 * 0.5 / (200 * 2 * torch.pi * width**2)
    behind = (places - middle) @ axis  # fades out where the body is not between
    depth = depth * torch.sigmoid((behind + 0.2) / 0.1)
    expected = 1 - share * (1 - torch.exp(-depth))
    near = (on_plane(places) - middle).norm(dim=-1) < 1.4
    assert (factor - expected)[near].abs().max() < 0.01
    assert factor.min() < 1 - 0.5 * share


def test_a_lamp_far_away_casts_parallel_shadows():
    shadow, body, places = make(), column(), floor()
    far = shadow(body, places, 1e4 * LAMP)
    farther = shadow(body + torch.tensor([0.4, 0.0, 0.0]), places, 1e5 * LAMP)
    shifted = shadow(body, places - torch.tensor([0.4, 0.0, 0.0]), 1e5 * LAMP)
    assert torch.allclose(farther, shifted, atol=1e-3)
    assert torch.allclose(far, shadow(body, places, 1e5 * LAMP), atol=1e-3)


def test_what_is_between_the_body_and_the_lamp_and_what_is_far_stays_lit():
    shadow, body = make(), column()
    assert (shadow(body, floor(height=2.5), LAMP) > 0.999).all()
    factor = shadow(body, floor(), LAMP)[0]
    assert (factor[floor().norm(dim=-1) > 1.6] > 0.999).all()
    assert factor[20, 20] < 0.95


@pytest.mark.parametrize("seed", range(3))
def test_light_on_the_body_is_what_parts_nearer_to_the_lamp_leave(seed):
    shadow, body = make(), column(seed)
    generator = torch.Generator().manual_seed(seed)
    lamp = LAMP[0] + 0.5 * torch.randn(3, generator=generator, dtype=torch.float64)
    with torch.no_grad():
        shadow.own_widths_log.fill_(-1.5)
    places = column(seed + 10)
    lit = shadow.lit(body, places, lamp[None])[0, 0]
    width = 0.03 + torch.exp(torch.tensor(-1.5))
    middle = body[0].mean(0)
    axis = (middle - lamp) / (middle - lamp).norm()

    def seen(points):
        """Where the ray through a point meets the plane through the middle, and how far behind."""
        ray = points - lamp
        at = lamp + ray * ((middle - lamp) @ axis / (ray @ axis))[..., None]
        return at, (points - middle) @ axis

    (at, behind), (own_at, own_behind) = seen(places[0]), seen(body[0])
    bells = torch.exp(-0.5 * ((at[:, None] - own_at).norm(dim=-1) / width).square())
    # 12 cm nearer, told between layers of 10 cm.
    depth_in_layers = (behind - 0.12 + 1.5) / 0.1
    layer, share = depth_in_layers.floor(), depth_in_layers % 1
    nearer = torch.zeros_like(bells)
    for step, weight in ((0, 1 - share), (1, share)):
        edge = -1.5 + 0.1 * (layer + step)
        nearer += weight[:, None] * torch.sigmoid((edge[:, None] - own_behind) / 0.03)
    depth = (bells * nearer).sum(-1) * 3.0 * 0.5 / (200 * 2 * torch.pi * width**2)
    assert (lit - torch.exp(-depth)).abs().max() < 0.02
    top = places[0, :, 2] > 1.7
    assert lit[top].min() > 0.8 and lit[places[0, :, 2] < 0.3].mean() < 0.5


def test_no_share_of_the_light_is_no_shadow():
    shadow = make(lamps=3)
    with torch.no_grad():
        shadow.share_logits.fill_(-50.0)
    lit = shadow(column(), floor(), LAMP + torch.eye(3, dtype=torch.float64))
    assert torch.equal(lit, torch.ones(1, 41, 41, dtype=torch.float64))


def test_gradients_of_lamps_body_and_places_equal_finite_differences():
    shadow, places = make(lamps=2), floor()[10:31:5, 10:31:5].clone().requires_grad_()
    parameters = dict(shadow.named_parameters())

    def factor(body, places, lamps, *values):
        named = dict(zip(parameters, values, strict=True))
        return torch.func.functional_call(shadow, named, (body, places, lamps))

    body = column()[:, ::20].requires_grad_()
    lamps = (LAMP + torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.5, -0.7]])).requires_grad_()
    values = [value.detach().requires_grad_() for value in parameters.values()]
    on_body = column(1)[:, :5]
    # Bilinear look-up has kinks at the cells' borders, which a small step does not meet.
    assert torch.autograd.gradcheck(factor, (body, places, lamps, *values), eps=1e-7, atol=1e-5)
    with torch.no_grad():
        shadow.own_widths_log.fill_(-1.5)
    lit = lambda body, lamps: shadow.lit(body, on_body, lamps)  # noqa: E731
    assert torch.autograd.gradcheck(lit, (body, lamps), eps=1e-7, atol=1e-5)


@pytest.mark.parametrize("count", [5, 60])
@pytest.mark.parametrize("seed", range(2))
def test_both_shadows_found_together_are_those_found_apart_with_their_gradients(seed, count):
    generator = torch.Generator().manual_seed(seed)
    shadow, places = make(lamps=2), floor()[10:31:5, 10:31:5].clone().requires_grad_()
    with torch.no_grad():
        shadow.own_widths_log.fill_(-1.5)
    moved = torch.tensor([[[0.0, 0.0, 0.0]], [[0.05, -0.1, 0.02]], [[0.1, 0.1, -0.05]]])
    body = (column(seed)[:, ::10] + moved).requires_grad_()
    lamps = (LAMP + torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.5, -0.7]])).requires_grad_()
    own = column(seed + 1)[:, :count]
    learned = [body, places, lamps, *shadow.parameters()]
    at = slice(1, 2)
    apart = shadow(body, places, lamps), shadow.lit(body[at].detach(), own, lamps)
    together = shadow.both(body, places, own.requires_grad_(), lamps, at)
    weights = [torch.randn(a.shape, generator=generator, dtype=a.dtype) for a in apart]
    gradients = []
    for found in (apart, together):
        total = sum((a * w).sum() for a, w in zip(found, weights, strict=True))
        gradients.append(torch.autograd.grad(total, learned))
    for one, other in zip((*apart, *gradients[0]), (*together, *gradients[1]), strict=True):
        assert torch.allclose(one, other, atol=1e-12, rtol=1e-9)
    # By the light on itself the body learns nothing, nor do its places.
    light = shadow.both(body, places, own, lamps, at)[1]
    assert torch.autograd.grad(light.sum(), own, allow_unused=True) == (None,)


def test_lamps_start_around_the_zenith():
    center, up = torch.tensor([1.0, 2.0, 0.9]), torch.tensor([0.0, 1.0, 0.0])
    lamps = Lamps(center, up, 4)
    rays = lamps.places().detach() - center
    assert torch.allclose(rays.norm(dim=-1), torch.full((4,), 3.0), atol=1e-5)
    cosines = (rays / 3) @ up
    assert float(cosines[0]) == pytest.approx(1, abs=1e-6)
    assert torch.allclose(cosines[1:], torch.tensor(1 / 1.49**0.5), atol=1e-5)


def wide(lamps: int, times: int) -> tuple[BodyShadow, torch.Tensor, torch.Tensor]:
    """A shadow of lamps of different widths and shares, bodies that move, and the lamps' places.

    One lamp is inside the body, where rays end that are shorter than the least; one is the sun.
    """
    generator = torch.Generator().manual_seed(1)
    shadow = make(lamps)
    with torch.no_grad():
        for parameter in shadow.parameters():
            parameter += torch.randn(lamps, generator=generator).double()
    body = torch.cat([column(seed) for seed in range(times)])
    body = body + 0.3 * torch.arange(times)[:, None, None]
    around = torch.randn(lamps, 3, generator=generator, dtype=torch.float64)
    around = 3.0 * torch.nn.functional.normalize(around, dim=-1)
    around[0] *= 1e3
    around[1] = torch.tensor([0.05, 0.02, 1.3])
    return shadow, body, around


@pytest.mark.parametrize("level", _native.levels())
@pytest.mark.parametrize("where", ["scene", "body"])
def test_the_compiled_shadow_and_its_gradients_are_those_of_the_plain_one(
    where, level, monkeypatch
):
    monkeypatch.setenv("EVSPLAT_ISA", level)
    shadow, body, lamps = wide(5, 3)
    own = torch.cat([column(seed + 10) * 1.3 for seed in range(3)])
    size = (3, 41, 41) if where == "scene" else (5, 3, 200)
    above = torch.randn(size, generator=torch.Generator().manual_seed(2)).double()
    results = []
    for dtype in (torch.float64, torch.float32):
        shadow.to(dtype).zero_grad()
        given = (value.to(dtype, copy=True).requires_grad_() for value in (body, lamps, floor(0.1)))
        points, lights, places = given
        if where == "scene":
            result = shadow(points, places, lights)
        else:
            result = shadow.lit(points.detach(), own.to(dtype), lights)
        (result * above.to(dtype)).sum().backward()
        gradients = [points.grad, lights.grad, places.grad, *(p.grad for p in shadow.parameters())]
        results.append([result, *(value.clone() for value in gradients if value is not None)])
    exact, compiled = results
    assert compiled[0].std() > 0.05
    assert (compiled[0] - exact[0]).abs().max() < 1e-5
    for one, other in zip(compiled[1:], exact[1:], strict=True):
        assert other.abs().max() > 0
        assert (one - other).abs().max() < 2e-5 * other.abs().max()


def test_a_body_that_is_no_number_shades_nothing_with_a_number():
    shadow = make().float()
    body = column().float()
    body[0, 5] = torch.nan
    assert shadow(body, floor().float(), LAMP.float()).isnan().all()
    assert shadow.lit(body, column(1).float(), LAMP.float()).isnan().all()
