"""Opacities that the pictures do not need: closed forms of stacked discs and of a plane."""

import dataclasses

import pytest
import torch

from evsplat.body.surface import SurfaceSamples
from evsplat.camera import Camera
from evsplat.gaussians import GaussianSet
from evsplat.models.discs.shading import NearestSurface
from evsplat.models.discs.transparent import (
    OFF,
    OFF_FROM_M,
    OFF_MOST_M,
    WRONG,
    WRONG_FROM,
    Sight,
    areas,
    kept_opacity,
    off_the_body,
    prices,
)
from evsplat.models.layers import Layers, human_splats, scene_splats
from evsplat.models.seen import draw_values

SIZE = 24
ALPHA = 0.8


def sights(colours, views=3):
    """Wide discs of the person one behind the other, before black; ``colours`` are grey values."""
    intrinsics = torch.tensor([[SIZE, 0, SIZE / 2], [0, SIZE, SIZE / 2], [0, 0, 1.0]])
    camera, count = Camera(SIZE, SIZE, intrinsics, torch.eye(4)), len(colours)
    means = torch.tensor([[[0.0, 0, 2 + depth] for depth in range(count)]])
    turned = torch.tensor([[1.0, 0, 0, 0]]).expand(1, count, 4)
    wide = torch.tensor([200.0, 200.0, 0.01]).expand(1, count, 3)
    grey = torch.tensor(colours)[None, :, None].expand(1, count, 3)
    transforms = torch.eye(4).expand(1, count, 4, 4)
    alike = torch.full((count,), ALPHA), grey, torch.ones(count)
    human = human_splats(means, turned, wide, *alike, transforms[..., :3, :3])
    black = torch.tensor([[0.0, 0, 9]]), turned[0, :1], wide[0, :1]
    scene = scene_splats(*black, torch.ones(1), torch.zeros(1, 3), torch.zeros(1))
    layers = Layers(human, scene, transforms)
    picture = draw_values(layers, camera, grey, scene.channels[..., :3])
    return [Sight(layers, camera, grey, picture)] * views


def error(colours, kept, views=3):
    """Squared error of the pictures by the formula of alpha blending."""

    def blended(factors):
        value, light = 0.0, 1.0
        for colour, factor in zip(colours, factors, strict=True):
            value = value + light * factor * ALPHA * colour
            light = light * (1 - factor * ALPHA)
        return value

    return views * SIZE * SIZE * 3 * (blended(kept) - blended([1.0] * len(colours))) ** 2


@pytest.mark.parametrize("wanted", [0.9, 0.6, 0.3, 0.0])
def test_one_disc_gives_way_until_the_picture_loses_as_much_as_it_costs(wanted):
    slope = 3 * SIZE * SIZE * 3 * (ALPHA * (0.7 - ALPHA * 0.2)) ** 2
    price = torch.tensor([2 * slope * (1 - wanted), 0.0])
    kept = kept_opacity(sights([0.7, 0.2]), price, rounds=60)
    assert kept[1] == 1
    assert float(kept[0]) == pytest.approx(wanted, abs=0.02)


def test_discs_that_imitate_what_is_behind_them_vanish_for_next_to_nothing():
    kept = kept_opacity(sights([0.0, 0.0, 0.0]), torch.full((3,), 1e-3))
    assert torch.equal(kept, torch.zeros(3))


@pytest.mark.parametrize("seed", range(4))
def test_discs_behind_each_other_find_the_least_together(seed):
    generator = torch.Generator().manual_seed(seed)
    colours = torch.rand(2, generator=generator).tolist()
    price = 600 * torch.rand(2, generator=generator)
    first, second = torch.meshgrid(*[torch.linspace(0, 1, 201)] * 2, indexing="ij")
    least = (error(colours, [first, second]) + price[0] * first + price[1] * second).min()
    kept = kept_opacity(sights(colours), price, rounds=60)
    found = error(colours, kept.tolist()) + float(price @ kept)
    assert found <= 1.02 * float(least) + 0.5


def test_four_rounds_come_near_to_the_least():
    colours, price = [0.1, 0.6], torch.tensor([300.0, 0.0])
    few, many = (kept_opacity(sights(colours), price, rounds=rounds) for rounds in (4, 60))
    assert float((few - many).abs().max()) < 0.1


def test_what_costs_nothing_stays_without_a_look():
    assert torch.equal(kept_opacity([], torch.zeros(5)), torch.ones(5))


def test_a_disc_off_a_plane_stands_off_by_its_height():
    across = torch.linspace(-1, 1, 21)
    points = torch.stack([*torch.meshgrid(across, across, indexing="ij")], -1).reshape(-1, 2)
    points = torch.nn.functional.pad(points, (0, 1))
    up = torch.tensor([0.0, 0, 1]).expand_as(points)
    surface = NearestSurface(SurfaceSamples(points, up, torch.ones(len(points), 1)))
    means = points + 0.02 * up  # cloth stands off everywhere
    means[220, 2] += 0.03
    means[40, 2] -= 0.01
    off = off_the_body(means, up, surface)
    wanted = torch.zeros(len(points))
    wanted[220], wanted[40] = 0.03, -0.01
    assert torch.allclose(off, wanted, atol=1e-6)


def test_prices_begin_at_their_thresholds_and_grow_with_the_disc():
    pixels = torch.tensor([2.0, 2, 2, 6, 2, 2])
    wrong = torch.tensor([0.0, WRONG_FROM, WRONG_FROM + 0.5, WRONG_FROM + 0.5, 0, 0])
    off = torch.tensor([-1.0, OFF_FROM_M, 0, 0, OFF_FROM_M + 0.01, 1.0])
    wanted = [0, 0, 0.25 * WRONG, 0.25 * WRONG, OFF * 1e-4, OFF * OFF_MOST_M**2]
    assert torch.allclose(prices(wrong, off, pixels), pixels * torch.tensor(wanted), atol=1e-7)


def test_areas_are_of_the_two_long_axes_against_their_mean():
    scales = torch.tensor([[1.0, 2, 0.1], [0.1, 2, 3], [9, 9, 9]])
    names = ("means", "quaternions", "opacity_logits", "semantic_logits", "rgb_logits")
    values = {"scales_log": scales.log(), **{name: torch.zeros(3, 3) for name in names}}
    human = {name: value[:2] for name, value in values.items()}
    discs = GaussianSet(human, {name: value[2:] for name, value in values.items()})
    assert torch.allclose(areas(discs), torch.tensor([0.5, 1.5]))


def test_a_scene_before_the_person_keeps_what_it_hides_cheap():
    hidden = sights([0.7])
    near = dataclasses.replace(hidden[0].layers.scene, means=torch.tensor([[[0.0, 0, 1]]]))
    layers = dataclasses.replace(hidden[0].layers, scene=near)
    picture = draw_values(layers, hidden[0].camera, hidden[0].human, near.channels[..., :3])
    sight = dataclasses.replace(hidden[0], layers=layers, picture=picture)
    bare, covered = (kept_opacity([each], torch.tensor([5.0])) for each in (hidden[0], sight))
    assert float(bare) > 0.9 and float(covered) == 0
