"""Discs end near the body: on a plane, how far one reaches is known in closed form."""

import math

import pytest
import torch

from evsplat.body import SurfaceSamples
from evsplat.models.discs.reach import MOST_M, within_reach

LYING, UPRIGHT = [1.0, 0, 0, 0], [math.cos(math.pi / 4), math.sin(math.pi / 4), 0, 0]
"""Thin along z, or turned about x so that its second axis is."""


@pytest.fixture
def floor():
    """Points of the plane z = 0, every centimetre."""
    x, y = torch.meshgrid(*2 * [torch.linspace(-0.5, 0.5, 101)], indexing="ij")
    points = torch.stack([x, y, torch.zeros_like(x)], -1).reshape(-1, 3)
    up = torch.tensor([0.0, 0, 1]).expand_as(points)
    return SurfaceSamples(points=points, normals=up, weights=torch.ones(len(points), 1))


def shrunk(floor, height_m, rotation, sizes):
    """The factor of one disc among others that lie flat on the floor."""
    means = floor.points[::7].clone()
    quaternions = torch.tensor(LYING).repeat(len(means), 1)
    scales = torch.tensor([0.01, 0.01, 0.001]).repeat(len(means), 1)
    middle = int(means.norm(dim=-1).argmin())
    means[middle, 2] = height_m
    quaternions[middle], scales[middle] = torch.tensor(rotation), torch.tensor(sizes)
    factors = within_reach(means, quaternions, scales, floor)
    others = torch.arange(len(means)) != middle
    assert torch.equal(factors[others], torch.ones_like(factors[others]))
    return float(factors[middle])


@pytest.mark.parametrize("rotation", [LYING, UPRIGHT])
def test_a_disc_within_reach_keeps_its_size(floor, rotation):
    assert shrunk(floor, 0.0, rotation, [0.015, 0.015, 0.001]) == 1


def test_a_large_disc_that_lies_on_the_body_keeps_its_size(floor):
    assert shrunk(floor, 0.0, LYING, [0.1, 0.1, 0.001]) == 1


@pytest.mark.parametrize("height_m", [0.0, 0.02])
def test_an_upright_disc_ends_at_the_limit(floor, height_m):
    factor = shrunk(floor, height_m, UPRIGHT, [0.001, 0.05, 0.001])
    assert height_m + 2 * 0.05 * factor == pytest.approx(MOST_M, abs=1e-6)


def test_a_disc_whose_centre_is_beyond_the_limit_all_but_vanishes(floor):
    assert shrunk(floor, 0.06, LYING, [0.05, 0.05, 0.001]) == pytest.approx(0.05)


def test_heights_are_against_the_neighbours_whose_clothes_stand_off_as_well(floor):
    means = floor.points[::7] + torch.tensor([0.0, 0, 0.1])
    turned = torch.tensor(LYING).repeat(len(means), 1)
    scales = torch.full((len(means), 3), 0.01)
    assert torch.equal(within_reach(means, turned, scales, floor), torch.ones(len(means)))


def test_a_single_disc_stays(floor):
    one = torch.ones(1, 3)
    assert float(within_reach(one, torch.tensor([LYING]), one, floor)) == 1
