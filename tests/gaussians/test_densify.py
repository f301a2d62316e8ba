"""Densification: rows, labels and optimiser moments move together."""

import pytest
import torch

from evsplat.gaussians import (
    DensifyLimits,
    GaussianSet,
    RowAdam,
    ScreenStatistics,
    densify,
    step_together,
)
from evsplat.gaussians.densify import rebuild
from evsplat.gaussians.initialise import gaussians_at

LIMITS = {
    "human": DensifyLimits(start=0, end=10_000, prune_after=0, split_above_m=0.03),
    "scene": DensifyLimits(
        start=0,
        end=10_000,
        prune_after=0,
        split_above_m=0.03,
        prune_opacity=0.005,
        prune_screen_px=None,
        prune_scale_m=None,
    ),
}


def make_set(seed: int, humans: int = 40, scenes: int = 60) -> tuple[GaussianSet, RowAdam]:
    generator = torch.Generator().manual_seed(seed)

    def start(count: int, semantic: float) -> dict[str, torch.Tensor]:
        points = torch.randn(count, 3, generator=generator)
        scales = 0.01 + 0.04 * torch.rand(count, 3, generator=generator)
        values = gaussians_at(points, scales, opacity=0.6, semantic_logit=semantic)
        values["features"] = torch.randn(count, 32, generator=generator)
        # A mark that identifies each row after any number of edits.
        values["semantic_logits"] = values["semantic_logits"] + 0.01 * torch.rand(
            count, generator=generator
        )
        return values

    gaussians = GaussianSet(start(humans, 2.0), start(scenes, -2.0))
    names = gaussians.attributes
    adam = RowAdam({name: getattr(gaussians, name) for name in names}, dict.fromkeys(names, 1e-3))
    loss = sum((getattr(gaussians, name) ** 2).sum() for name in names)
    loss.backward()
    step_together([adam.adam])
    return gaussians, adam


def moments(adam: RowAdam, name: str) -> torch.Tensor:
    (group,) = [g for g in adam.adam.param_groups if g["name"] == name]
    return adam.adam.state[group["params"][0]]["exp_avg"]


@pytest.mark.parametrize("seed", range(3))
def test_clone_split_and_prune_do_what_the_limits_say(seed):
    gaussians, adam = make_set(seed)
    statistics = ScreenStatistics.zeros(len(gaussians), torch.device("cpu"))
    generator = torch.Generator().manual_seed(seed)
    count, humans = len(gaussians), gaussians.human_count
    statistics.seen += 1
    statistics.gradient_sum[:] = torch.rand(count, generator=generator) * 4e-4
    statistics.radius_px[:5] = 50
    statistics.radius_px[humans : humans + 5] = 50
    with torch.no_grad():
        gaussians.opacity_logits[5:8] = -4.0  # 0.018: too faint for a person, not for the scene
        gaussians.opacity_logits[humans + 5 : humans + 8] = -4.0

    label = gaussians.semantic_logits.detach().clone()
    largest = gaussians.scales_log.detach().amax(-1).exp()
    pruned = torch.zeros(count, dtype=torch.bool)
    pruned[:8] = True
    grow = (statistics.gradient_sum > 2e-4) & ~pruned
    expected = count - 8 + int(grow.sum())

    before = gaussians.scales_log.detach().clone()
    densify(gaussians, adam, statistics, LIMITS, 5_000, generator)
    assert len(gaussians) == expected

    after = gaussians.semantic_logits.detach()
    assert len(label.unique()) == count
    for row in range(count):
        descendants = gaussians.scales_log.detach()[after == label[row]].exp()
        shrunk = 1.6 if grow[row] and largest[row] > 0.03 else 1.0
        assert len(descendants) == (0 if pruned[row] else 2 if grow[row] else 1)
        assert torch.allclose(descendants, (before[row].exp() / shrunk).expand_as(descendants))
    # Labels are inherited exactly: every label of the new set is one of the old set's.
    assert bool(torch.isin(after, label).all())
    assert bool((after[gaussians.human] > 0).all()) and bool((after[gaussians.scene] < 0).all())


def test_children_of_a_split_are_smaller_and_inside_their_parent():
    gaussians, adam = make_set(1, humans=1, scenes=1)
    with torch.no_grad():
        gaussians.scales_log[0] = torch.log(torch.tensor([0.2, 0.1, 0.001]))
    parent = {name: getattr(gaussians, name).detach()[0].clone() for name in gaussians.attributes}
    statistics = ScreenStatistics.zeros(2, torch.device("cpu"))
    statistics.seen += 1
    statistics.gradient_sum[0] = 1.0
    densify(gaussians, adam, statistics, LIMITS, 1_000, torch.Generator().manual_seed(0))
    assert gaussians.human_count == 2
    children = gaussians.scales_log.detach()[:2].exp()
    assert torch.allclose(children, parent["scales_log"].exp().expand(2, 3) / 1.6)
    offset = (gaussians.means.detach()[:2] - parent["means"]) / parent["scales_log"].exp()
    assert bool((offset.abs() < 5).all())
    assert float(offset.abs().max()) > 1e-3


@pytest.mark.parametrize("seed", range(3))
def test_moments_follow_their_rows_and_new_rows_start_without(seed):
    gaussians, adam = make_set(seed)
    count = len(gaussians)
    before = {name: moments(adam, name).clone() for name in gaussians.attributes}
    generator = torch.Generator().manual_seed(seed)
    source = torch.randint(count, (count + 7,), generator=generator)
    fresh = torch.rand(len(source), generator=generator) < 0.3
    is_human = gaussians.human_mask()[source]
    values = {name: getattr(gaussians, name).detach()[source] for name in gaussians.attributes}
    marks = values["semantic_logits"].clone()
    rebuild(gaussians, adam, values, source, fresh, is_human)

    order = torch.argsort((~is_human).int(), stable=True)
    assert torch.equal(gaussians.semantic_logits.detach(), marks[order])
    for name in gaussians.attributes:
        expected = before[name][source[order]].clone()
        expected[fresh[order]] = 0
        assert torch.equal(moments(adam, name), expected), name


def test_optimiser_keeps_stepping_the_new_rows():
    gaussians, adam = make_set(0)
    source = torch.arange(10)
    values = {name: getattr(gaussians, name).detach()[source] for name in gaussians.attributes}
    rebuild(gaussians, adam, values, source, torch.zeros(10, dtype=torch.bool), source < 4)
    before = gaussians.means.detach().clone()
    (gaussians.means**2).sum().backward()
    step_together([adam.adam])
    assert bool((gaussians.means.detach() != before).all())


def test_growth_stops_at_the_cap_and_takes_the_largest_gradients():
    gaussians, adam = make_set(2, humans=20, scenes=4)
    statistics = ScreenStatistics.zeros(24, torch.device("cpu"))
    statistics.seen += 1
    statistics.gradient_sum[:20] = torch.linspace(3e-4, 9e-4, 20)
    limits = {**LIMITS, "human": DensifyLimits(start=0, split_above_m=9.0, max_count=23)}
    marks = gaussians.semantic_logits.detach()[17:20].clone()
    densify(gaussians, adam, statistics, limits, 1_000, torch.Generator())
    assert gaussians.human_count == 23
    assert torch.equal(gaussians.semantic_logits.detach()[20:23].sort().values, marks.sort().values)


def test_nothing_is_edited_outside_the_window():
    gaussians, adam = make_set(3)
    statistics = ScreenStatistics.zeros(len(gaussians), torch.device("cpu"))
    statistics.gradient_sum += 1
    statistics.seen += 1
    before = gaussians.means.detach().clone()
    densify(gaussians, adam, statistics, LIMITS, 10_000, torch.Generator())
    assert torch.equal(gaussians.means.detach(), before)


def test_statistics_average_ndc_gradients_over_the_renders_that_drew_a_row():
    statistics = ScreenStatistics.zeros(2, torch.device("cpu"))
    gradient = torch.tensor([[[3e-6, 0.0], [1.0, 1.0]], [[0.0, 4e-6], [0.0, 0.0]]])
    radii = torch.tensor([[4, 0], [9, 0]])
    statistics.add(slice(0, 2), gradient, radii, width=200, height=100)
    # Two renders share one mean loss, hence the factor 2 for each: 2 * 100 * 3e-6, 2 * 50 * 4e-6.
    assert statistics.mean_gradient().tolist() == pytest.approx([(6e-4 + 4e-4) / 2, 0.0])
    assert statistics.radius_px.tolist() == [9, 0]
