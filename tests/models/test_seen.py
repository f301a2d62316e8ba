"""What training saw of each Gaussian: closed forms of two stacked discs, and the runs that tell."""

import dataclasses

import pytest
import torch

from evsplat.camera import Camera
from evsplat.capture import Policy, load_capture
from evsplat.models.at_rest import SkinnedGaussians
from evsplat.models.layers import Layers, human_splats, scene_splats
from evsplat.models.seen import Seen, draw_values, roughness, seen_by, shares_in

from ..small_model import built

SIZE = 24


def stacked(opacity):
    """Two wide discs one behind the other, both of ``opacity``, that fill a small picture."""
    intrinsics = torch.tensor([[SIZE, 0, SIZE / 2], [0, SIZE, SIZE / 2], [0, 0, 1.0]])
    camera = Camera(SIZE, SIZE, intrinsics, torch.eye(4))
    means = torch.tensor([[[0.0, 0, 2], [0, 0, 3]]])
    turned = torch.tensor([[1.0, 0, 0, 0]]).expand(1, 2, 4)
    wide = torch.tensor([200.0, 200.0, 0.01]).expand(1, 2, 3)
    alike = torch.full((2,), opacity), torch.full((1, 2, 3), 0.5), torch.ones(2)
    transforms = torch.eye(4).expand(1, 2, 4, 4)
    human = human_splats(means, turned, wide, *alike, transforms[..., :3, :3])
    away = torch.tensor([[0.0, 0, -5]]), turned[0, :1], wide[0, :1]
    scene = scene_splats(*away, torch.ones(1), torch.zeros(1, 3), torch.zeros(1))
    return Layers(human, scene, transforms), camera


def test_shares_of_two_stacked_discs():
    layers, camera = stacked(0.8)
    draws = 400
    shares = shares_in(layers, camera, torch.Generator().manual_seed(0), draws)
    pixels = SIZE * SIZE
    wanted = torch.tensor([0.8, 0.2 * 0.8])
    assert torch.allclose(shares[:, 0], pixels * wanted, rtol=1e-3)
    # The mean of n squares of a normal variable has the relative error sqrt(2 / n).
    squares = shares[:, 1:].square().mean(1)
    assert torch.allclose(squares, pixels * wanted.square(), rtol=5 * (2 / draws) ** 0.5)


@pytest.mark.parametrize("behind", [True, False])
def test_of_a_scene_only_what_may_hide_the_person_is_drawn(behind):
    layers, camera = stacked(0.8)
    generator = torch.Generator().manual_seed(int(behind))
    depths = torch.tensor([3.1, 4.0, 9.0] if behind else [1.0, 2.5, 4.0])
    means = torch.cat([0.3 * torch.randn(3, 2, generator=generator), depths[:, None]], 1)
    wide = torch.full((3, 3), 0.4)
    turned = torch.tensor([[1.0, 0, 0, 0]]).expand(3, 4)
    alike = torch.full((3,), 0.6), torch.zeros(3, 3), torch.zeros(3)
    layers = dataclasses.replace(layers, scene=scene_splats(means, turned, wide, *alike))
    values = torch.rand(1, 2, 3, generator=generator)
    all_of_it, needed = (
        draw_values(layers, camera, values, scene) for scene in (torch.zeros(1, 3, 3), None)
    )
    assert torch.allclose(needed, all_of_it, atol=1e-6)
    alone = draw_values(dataclasses.replace(layers, scene=stacked(0.8)[0].scene), camera, values)
    assert torch.allclose(needed, alone, atol=1e-6) == behind


def test_what_shines_through_is_less_certain_than_what_is_seen():
    seen = Seen(torch.tensor([1.0, 1.0]), torch.tensor([0.8, 0.01]), torch.zeros(2, 3))
    front, through = seen.certainty().tolist()
    assert front > 0.7 and through < 0.05
    assert seen.little().tolist() == [False, True]


def test_every_gaussian_has_what_frames_showed_of_it(tiny_capture):
    capture = load_capture(tiny_capture())
    training = capture.for_training(Policy())
    model = built("evsplat", capture).model
    seen = seen_by(model, training)
    assert torch.equal(seen.weight, seen_by(model, training).weight)
    assert len(seen.weight) == model.gaussians.human_count
    assert float(seen.weight.sum()) > 1 and float(seen.squares.min()) >= 0
    length = seen.directions.norm(dim=-1)
    assert bool((length <= seen.weight * (1 + 1e-4) + 1e-6).all())


@pytest.mark.parametrize("method", ["paper", "hugs", "avatar3dgs"])
def test_other_methods_know_what_they_saw(tiny_capture, method):
    capture = load_capture(tiny_capture())
    model = built(method, capture).model
    seen = seen_by(model, capture.for_training(Policy()))
    assert len(seen.weight) == sum(rows.human_count for rows in model.sets.values())
    assert float(seen.weight.max()) > 0


def test_speckle_is_rough_where_it_is():
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(400, 3, generator=generator)
    rgb = torch.full((400, 3), 0.5)
    left = means[:, 0] < 0.5
    rgb[left] += 0.1 * torch.randn(int(left.sum()), 3, generator=generator)
    rgb[~left] += 0.01 * torch.randn(int((~left).sum()), 3, generator=generator)
    rest = dataclasses.replace(_rest(means), rgb=rgb)
    seen = Seen(torch.ones(400), (~left).float(), torch.zeros(400, 3))
    found = roughness(rest, seen)
    assert found["little_seen"] == pytest.approx(float(left.float().mean()))
    # Independent values differ by sqrt(2) of their deviation.
    assert found["roughness_little"] == pytest.approx(0.1 * 2**0.5, rel=0.1)
    assert found["ratio"] is not None and found["ratio"] > 4


def _rest(means):
    zeros = torch.zeros_like(means)
    one = zeros[:, 0]
    return SkinnedGaussians(None, means, zeros, zeros, one, zeros, zeros, None)


def test_tensors_of_other_gaussians_are_refused():
    tensors = vars(Seen(torch.ones(3), torch.ones(3), torch.ones(3, 3)))
    assert Seen.of({}, 3) is None
    assert isinstance(Seen.of(tensors, 3), Seen)
    with pytest.raises(ValueError, match="of 4 Gaussians"):
        Seen.of(tensors, 4)


@pytest.mark.parametrize("name", ["weight", "squares", "directions"])
@pytest.mark.parametrize("wrong", [float("nan"), float("inf")])
def test_one_number_that_is_none_is_refused_wherever_it_stands(name, wrong):
    tensors = dict(vars(Seen(torch.ones(3), torch.ones(3), torch.ones(3, 3))))
    tensors[name] = tensors[name].clone()
    tensors[name][2] = wrong
    with pytest.raises(ValueError, match="not finite"):
        Seen.of(tensors, 3)


@pytest.mark.parametrize("method", ["evsplat", "paper", "avatar3dgs"])
def test_of_a_person_without_gaussians_nothing_was_seen(tiny_capture, method):
    """All of them may have been pruned; the end of a training asks what was seen all the same."""
    capture = load_capture(tiny_capture())
    composition = built(method, capture)
    model = composition.model
    (rows,) = model.sets.values()
    rows.set_rows({name: rows.get_parameter(name)[rows.scene] for name in rows.attributes}, 0)
    for cache in model.row_caches.values():
        cache.rows_changed()
    seen = seen_by(model, composition.capture or capture.for_training(Policy()))
    assert [tuple(value.shape) for value in vars(seen).values()] == [(0,), (0,), (0, 3)]
