"""Neighbours along a surface and what follows from them: chains, plates, dense least squares."""

import numpy as np
import pytest
import torch
from scipy import sparse

from evsplat.body import Body
from evsplat.gaussians.surface_graph import closest, harmonic, laplacian, mirror_plane

UP = torch.tensor([0.0, 0, 1])


def chain(count):
    """The Laplacian of points in a row, each linked to the next."""
    links = np.zeros((count, count))
    for first in range(count - 1):
        links[first, first + 1] = links[first + 1, first] = 1
    return torch.from_numpy(np.diag(links.sum(1)) - links)


def csr(dense):
    return sparse.csr_matrix(dense.numpy())


def test_values_between_two_known_ends_are_linear():
    values = torch.tensor([[1.0], [9], [-9], [9], [5]])
    sure = torch.tensor([1e6, 0, 0, 0, 1e6])
    found = harmonic(values, sure, csr(chain(5)))
    assert torch.allclose(found[:, 0], torch.linspace(1, 5, 5), atol=1e-3)


def test_what_is_sure_moves_by_no_more_than_its_share():
    values = torch.tensor([[0.0], [1]])
    sure = torch.tensor([99.0, 1])
    # Ends of a spring of strength 1: 99 x = 1 - x', x' - 1 = x - x' ... solved by hand.
    found = harmonic(values, sure, csr(chain(2)))
    wanted = torch.linalg.solve(torch.diag(sure) + chain(2).float(), sure[:, None] * values)
    assert torch.allclose(found, wanted, atol=1e-5) and float(found[0]) < 0.006


@pytest.mark.parametrize("tint", [0.0, 3.0])
@pytest.mark.parametrize("elsewhere", [False, True])
def test_conjugate_gradients_find_the_least_squares(tint, elsewhere):
    generator = torch.Generator().manual_seed(0)
    seen = torch.randn(9, 6, generator=generator, dtype=torch.float64)
    pictures = torch.randn(9, 3, generator=generator, dtype=torch.float64)
    prior = torch.rand(6, 3, generator=generator, dtype=torch.float64)
    strength = torch.linspace(0.1, 1, 6, dtype=torch.float64)
    hue = tint * strength.flip(0)
    pull = seen.T @ (pictures - seen @ prior)
    diagonal = seen.square().sum(0)

    def squares(values):
        return seen.T @ (seen @ values)

    start = torch.rand(6, 3, generator=generator, dtype=torch.float64) if elsewhere else None
    found = closest(prior, pull, squares, diagonal, strength, hue, 18, start)
    # All 18 unknowns at once, a row's three colours beside each other.
    of_hue = torch.eye(3, dtype=torch.float64) - 1 / 3
    price = torch.kron(strength.diag(), torch.eye(3)) + torch.kron(hue.diag(), of_hue)
    whole = torch.kron(seen.T @ seen, torch.eye(3)) + price
    told = (seen.T @ pictures).flatten() + price @ prior.flatten()
    assert torch.allclose(found.flatten(), torch.linalg.solve(whole, told), atol=1e-9)


def test_a_price_on_hue_leaves_brightness_to_the_pictures():
    prior = torch.tensor([[0.5, 0.4, 0.3]])
    missing = torch.tensor([[1.0, 2.0, 6.0]])
    told, hue = torch.tensor([10.0]), torch.tensor([1e9])
    found = closest(prior, missing, lambda v: told[:, None] * v, told, torch.zeros(1), hue, 2)
    assert torch.allclose(found, prior + 0.3, atol=1e-6)


def test_what_no_picture_tells_of_is_as_the_prior_says():
    prior = torch.tensor([[0.25, 0.5, 0.75], [0.5, 0.5, 0.5]])
    pull = torch.tensor([[0.0, 0, 0], [10, 0, -10]])
    told = torch.tensor([0.0, 100])
    held, none = torch.full((2,), 0.01), torch.zeros(2)
    found = closest(prior, pull, lambda v: told[:, None] * v, told, held, none, 1)
    assert torch.equal(found[0], prior[0])
    assert torch.allclose(found[1], torch.tensor([0.6, 0.5, 0.4]), atol=1e-4)


def grid(height):
    ticks = torch.arange(5) * 0.01
    x, y = torch.meshgrid(ticks, ticks, indexing="ij")
    return torch.stack([x, y, torch.full_like(x, height)], -1).reshape(-1, 3)


def test_nothing_jumps_between_limbs_or_through_a_plate():
    points = torch.cat([grid(0.0), grid(0.011)])
    normals = torch.cat([-UP.expand(25, 3), UP.expand(25, 3)])
    one_bone = torch.ones(50, 1)
    limbs = torch.cat(
        [torch.tensor([[1.0, 0]]).expand(25, 2), torch.tensor([[0, 1.0]]).expand(25, 2)]
    )
    for turned, bones in ((normals, one_bone), (UP.expand(50, 3), limbs)):
        rough = laplacian(points, turned, bones, None).toarray()
        assert np.allclose(rough, rough.T) and np.allclose(rough.sum(1), 0)
        through, along = -rough[:25, 25:].sum(), -np.triu(rough[:25, :25], 1).sum()
        assert through < 0.03 * along
    alike = laplacian(points, UP.expand(50, 3), one_bone, None).toarray()
    assert -alike[:25, 25:].sum() > 0.3 * -np.triu(alike[:25, :25], 1).sum()


@pytest.mark.parametrize("aside", [0.0, 0.7])
def test_the_other_side_is_linked_where_the_skeleton_has_sides(aside):
    """``aside``: how far from the origin the body stands."""
    shift = torch.tensor([aside, 0, 0])
    names = ("root", "LeftArm", "RightArm")
    places = torch.tensor([[0.0, 0, 0], [0.3, 0, 0], [-0.3, 0, 0]])
    body = Body(
        rest_vertices=torch.rand(4, 3, generator=torch.Generator().manual_seed(0)),
        faces=torch.tensor([[0, 1, 2], [1, 2, 3]]),
        weights=torch.full((4, 3), 1 / 3),
        parents=torch.tensor([-1, 0, 0]),
        rest_joints=places + shift,
        joint_names=names,
    )
    plane = mirror_plane(body)
    assert plane is not None
    assert torch.allclose(plane[1].abs(), torch.tensor([1.0, 0, 0]))
    assert torch.allclose(plane[0], shift, atol=1e-6)
    points = torch.cat(
        [grid(0.0) + torch.tensor([0.2, 0, 0]), grid(0.0) - torch.tensor([0.24, 0, 0])]
    )
    points = points + shift
    normals, bones = UP.expand(50, 3), torch.ones(50, 1)
    apart = laplacian(points, normals, bones, None).toarray()
    linked = laplacian(points, normals, bones, plane).toarray()
    assert abs(apart[:25, 25:]).max() < 1e-3
    # The grid's first column mirrors the other's last: x = 0.2 lies opposite of x = -0.2.
    mirrored = [25 + 5 * (4 - row // 5) + row % 5 for row in range(25)]
    for row, partner in enumerate(mirrored):
        assert np.argmin(linked[row, 25:]) == partner - 25
    assert mirror_plane(Body(**{**vars_of(body), "joint_names": ("a", "b", "c")})) is None


def vars_of(body):
    names = ("rest_vertices", "faces", "weights", "parents", "rest_joints")
    return {name: getattr(body, name) for name in names}
