"""Where a scene lies as its shadows tell: nothing at the start, then what stands before a wall."""

import pytest
import torch

from evsplat.body import SurfaceSamples
from evsplat.camera import Camera
from evsplat.models.discs.relief import Relief, _Power
from evsplat.models.discs.shadow import BodyShadow
from evsplat.models.scene_places import places_of

from ...small_model import built
from .test_model import model_of

SIZE, WALL_M, BOX_M = 64, 4.0, 3.0
K = torch.tensor([[SIZE, 0.0, SIZE / 2], [0.0, SIZE, SIZE / 2], [0.0, 0.0, 1.0]])
CAMERA = Camera(SIZE, SIZE, K, torch.eye(4))


def places_at(depth: torch.Tensor, camera: Camera = CAMERA) -> torch.Tensor:
    return places_of(torch.stack([depth, torch.ones_like(depth)], -1), camera, 2)


def shaken(seed: int) -> Relief:
    relief = Relief(CAMERA)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in relief.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator))
    return relief


def test_at_the_start_places_are_as_given_and_shadows_as_they_are():
    places = places_at(torch.full((SIZE, SIZE), WALL_M))
    there, exponents = Relief(CAMERA)(places)
    torch.testing.assert_close(there, places, atol=1e-6, rtol=0)
    factors = torch.rand(3, *exponents.shape)
    shaded = Relief(CAMERA).shade(places, lambda at: factors)
    torch.testing.assert_close(shaded, factors.clamp_min(1e-3))


@pytest.mark.parametrize("seed", range(3))
def test_places_move_along_the_recording_cameras_rays_in_any_view(seed):
    relief = shaken(seed)
    generator = torch.Generator().manual_seed(seed)
    pose = torch.eye(4)
    pose[:3, 3] = torch.randn(3, generator=generator)
    camera = Camera(SIZE, SIZE, K, pose)
    relief_there = Relief(camera)
    relief_there.load_state_dict(relief.state_dict())
    places = places_at(1 + 3 * torch.rand(SIZE, SIZE, generator=generator), camera)
    there, exponents = relief_there(places)
    before, after = camera.project(places.flatten(0, 1))[0], camera.project(there.flatten(0, 1))[0]
    torch.testing.assert_close(after, before, atol=1e-3, rtol=0)
    assert (there - places).norm(dim=-1).std() > 0.1
    # The same places in the order of another view's picture.
    order = torch.randperm(places.shape[0], generator=generator)
    again, same = relief_there(places[order])
    torch.testing.assert_close(again, there[order])
    torch.testing.assert_close(same, exponents[order])


def test_gradients_equal_finite_differences():
    relief = shaken(0).double()
    places = places_at(torch.full((SIZE, SIZE), WALL_M))[::7, ::7].double()
    named = dict(relief.named_parameters())

    def moved(*values):
        given = dict(zip(named, values, strict=True))
        return torch.func.functional_call(relief, given, (places,))

    values = [value.detach().requires_grad_() for value in named.values()]
    directions = [torch.randn_like(value) for value in values]

    def along(step: float):
        return moved(*(v + step * d for v, d in zip(values, directions, strict=True)))

    above = [torch.randn_like(result) for result in moved(*values)]
    exact = torch.autograd.grad(moved(*values), values, above)
    slope = sum((g * d).sum() for g, d in zip(exact, directions, strict=True))
    ahead, back = along(1e-5), along(-1e-5)
    told = sum((a * (f - b)).sum() / 2e-5 for a, f, b in zip(above, ahead, back, strict=True))
    torch.testing.assert_close(slope, told, rtol=1e-6, atol=0)


def test_a_box_before_the_wall_is_found_by_the_shadows_that_fall_on_it():
    """Bodies that wander between lamp and wall; the box is in the middle of the picture."""
    box = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    box[16:48, 20:44] = True
    wall = torch.full((SIZE, SIZE), WALL_M)
    true, sheet = places_at(torch.where(box, BOX_M, wall)), places_at(wall)
    casters = SurfaceSamples(torch.zeros(1, 3), torch.zeros(1, 3), torch.ones(1, 1))
    shadow, lamp = BodyShadow(casters, 1), torch.tensor([[1.5, -1.5, 0.0]])
    shadow.requires_grad_(False)
    generator = torch.Generator().manual_seed(0)
    middles = torch.rand(200, 1, 3, generator=generator) * torch.tensor([2.0, 2.0, 0.3])
    bodies = middles + torch.tensor([-1.0, -1.0, 2.0])
    bodies = bodies + 0.3 * torch.randn(200, 60, 3, generator=generator) * torch.tensor(
        [0.3, 1, 0.3]
    )
    seen = shadow(bodies, true, lamp)
    relief = Relief(CAMERA)
    optimiser = torch.optim.Adam(relief.parameters(), lr=0.02)
    for _ in range(120):
        drawn = torch.randint(len(bodies), (4,), generator=generator)
        factors = relief.shade(sheet, lambda at, rows=drawn: shadow(bodies[rows], at, lamp))
        optimiser.zero_grad()
        (factors - seen[drawn]).abs().mean().backward()
        optimiser.step()
    depth = relief(sheet)[0][..., 2].detach()
    inside, outside = torch.zeros(32, 32, dtype=torch.bool), torch.ones(32, 32, dtype=torch.bool)
    inside[10:22, 12:20] = True
    outside[6:26, 8:24] = False
    assert (depth[inside] - BOX_M).abs().median() < 0.1
    assert (depth[outside] - WALL_M).abs().median() < 0.1


def test_a_camera_that_moves_has_none_and_a_checkpoint_keeps_it(tiny_capture):
    model, capture, times, center = model_of(tiny_capture())
    assert {"relief.coarse", "relief.fine"} <= set(model.state_dict())
    places = model.at(times, center).scene.means
    model.nominal.fill_(10_000.0)
    before = model.at(times, center).shadow(places)
    with torch.no_grad():
        model.relief.fine[:, 1] += 1.0
    assert (model.at(times, center).shadow(places) < before - 1e-4).any()
    cube = built("evsplat", capture, "scene.kind=random_cube", "scene.cube_count=50").model
    assert cube.relief is None
    assert built("evsplat", capture, "lamps=0").model.relief is None


def test_the_price_is_of_steps_between_neighbours_and_draws_what_nothing_tells_to_the_sheet():
    relief = Relief(CAMERA)
    with torch.no_grad():
        relief.fine[0, 0, 10, 20] = 3.0
    cells, pairs = 2 * 64 * 64, 2 * 63 * 64
    # One cell differs from its four neighbours.
    assert relief.price().item() == pytest.approx(4 * 9 / pairs + 0.1 * 9 / cells)
    relief = shaken(0)
    optimiser = torch.optim.Adam(relief.parameters(), lr=0.02)
    for _ in range(300):
        optimiser.zero_grad()
        relief.price().backward()
        optimiser.step()
    assert relief.price() < 1e-3 * shaken(0).price()


def test_the_power_is_torchs_with_its_gradients_and_darkness_has_none():
    generator = torch.Generator().manual_seed(0)
    factors = torch.rand(3, 5, 7, generator=generator, dtype=torch.float64)
    factors[0, 0, :2] = torch.tensor([0.0, 5e-4])
    exponents = 0.5 + torch.rand(5, 7, generator=generator, dtype=torch.float64)
    upstream = torch.randn(3, 5, 7, generator=generator, dtype=torch.float64)
    found = []
    for power in (_Power.apply, lambda f, e: f.clamp_min(1e-3) ** e):
        given = [factors.clone().requires_grad_(), exponents.clone().requires_grad_()]
        result = power(*given)
        found.append([result, *torch.autograd.grad((result * upstream).sum(), given)])
    for own, torchs in zip(*found, strict=True):
        torch.testing.assert_close(own, torchs)
    assert found[0][1][0, 0, :2].tolist() == [0.0, 0.0]


@pytest.mark.parametrize("seed", range(3))
def test_the_price_of_any_cells_and_its_gradient_are_those_of_the_differences(seed):
    relief = shaken(seed).double()
    cells = relief._learned()
    steps = [cells.diff(dim=axis).square().mean() for axis in (2, 3)]
    plain = steps[0] + steps[1] + 0.1 * cells.square().mean()
    parameters = list(relief.parameters())
    wanted = torch.autograd.grad(plain, parameters)
    found = torch.autograd.grad(relief.price(), parameters)
    assert relief.price().item() == pytest.approx(plain.item(), rel=1e-6)  # the stencil is float32
    for one, other in zip(found, wanted, strict=True):
        assert torch.allclose(one, other, rtol=1e-5, atol=1e-6 * float(other.abs().max()))
