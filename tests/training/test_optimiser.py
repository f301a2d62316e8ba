"""What moves in a step, how far, and what is held: rates, windows, frozen rows, clipped norms."""

from types import SimpleNamespace

import pytest
import torch

from evsplat.gaussians import GaussianSet
from evsplat.gaussians.initialise import gaussians_at
from evsplat.methods.learning import Learning, Network, Rate, RowRate
from evsplat.methods.settings import NOMINAL_ITERATIONS
from evsplat.training.optimiser import Optimiser

HUMANS, SCENES = 5, 7
WINDOW = (1_000.0, 12_000.0)
STARTS = {"means": 1e-3, "scales_log": 2e-3, "quaternions": 3e-3, "opacity_logits": 4e-3}
STARTS |= {"semantic_logits": 5e-3, "features": 6e-3}


def start(count: int, semantic: float) -> dict[str, torch.Tensor]:
    points = torch.randn(count, 3, generator=torch.Generator().manual_seed(count))
    return gaussians_at(points, torch.full_like(points, 0.02), opacity=0.5, semantic_logit=semantic)


class Made:
    """A set of both classes and two networks, the first of them clipped, with gradients of 1."""

    def __init__(self, **more) -> None:
        self.gaussians = GaussianSet(start(HUMANS, 2.0), start(SCENES, -2.0))
        assert set(self.gaussians.attributes) == set(STARTS)
        self.networks = [torch.nn.Linear(3, 2), torch.nn.Linear(2, 4)]
        rows = {name: RowRate(Rate(rate, 0.01, 0.5)) for name, rate in STARTS.items()}
        rows["semantic_logits"] = RowRate(Rate(STARTS["semantic_logits"]), WINDOW)
        networks = [
            Network([*self.networks[0].parameters()], Rate(0.1, 0.1), clipped=True),
            Network([*self.networks[1].parameters()], Rate(0.2)),
        ]
        model = SimpleNamespace(sets={"gaussians": self.gaussians})
        self.optimiser = Optimiser(model, Learning({"gaussians": rows}, networks, **more))

    def parameters(self) -> dict[str, torch.nn.Parameter]:
        parts = {"gaussians": self.gaussians, "first": self.networks[0], "other": self.networks[1]}
        return {f"{of}.{n}": p for of, part in parts.items() for n, p in part.named_parameters()}

    def moved(self, nominal: float, gradient: float = 1.0) -> dict[str, torch.Tensor]:
        """How far each parameter goes in a step at this nominal iteration."""
        before = {name: value.detach().clone() for name, value in self.parameters().items()}
        self.optimiser.set_progress(nominal)
        for value in self.parameters().values():
            value.grad = torch.full_like(value, gradient)
        self.optimiser.step(nominal)
        return {n: (before[n] - value.detach()) for n, value in self.parameters().items()}


@pytest.mark.parametrize("share", [0.2, 0.5, 0.75, 0.79])
def test_adams_first_step_is_the_rate_of_the_time(share):
    """By as much as the rate, whatever the gradient is."""
    nominal = share * NOMINAL_ITERATIONS
    moved = Made().moved(nominal)
    falling = 0.01 ** (max(share - 0.5, 0) / 0.5)
    for name, rate in STARTS.items():
        factor = 1.0 if name == "semantic_logits" else falling
        found = moved[f"gaussians.{name}"]
        torch.testing.assert_close(found, torch.full_like(found, factor * rate), atol=1e-6, rtol=0)
    for name, rate in (("first", 0.1 * 0.1**share), ("other", 0.2)):
        for found in (moved[f"{name}.weight"], moved[f"{name}.bias"]):
            torch.testing.assert_close(found, torch.full_like(found, rate))


@pytest.mark.parametrize("nominal, learns", [(999, False), (1_000, True), (12_000, False)])
def test_an_attribute_learns_in_its_window_alone(nominal, learns):
    moved = Made().moved(nominal)
    assert bool((moved["gaussians.semantic_logits"] != 0).all()) == learns
    assert bool((moved["gaussians.semantic_logits"] != 0).any()) == learns
    assert bool((moved["gaussians.features"] != 0).all())


def test_the_person_is_frozen_until_its_start_and_the_scene_is_not():
    for nominal in (499.0, 500.0):
        made = Made(human_start=500.0)
        moved = made.moved(nominal)["gaussians.means"]
        assert bool((moved[made.gaussians.scene] != 0).all())
        assert bool((moved[made.gaussians.human] != 0).all()) == (nominal == 500.0)
        assert bool((moved[made.gaussians.human] != 0).any()) == (nominal == 500.0)


@pytest.mark.parametrize("gradient", [1.0, 1e-3])
def test_gradients_of_clipped_networks_have_the_norm_together_that_is_allowed(gradient):
    made = Made(clip=0.5)
    made.moved(0.0, gradient)
    first = torch.cat([p.grad.flatten() for p in made.networks[0].parameters()])
    long = gradient * len(first) ** 0.5
    assert float(first.norm()) == pytest.approx(min(long, 0.5))
    rest = [*made.networks[1].parameters(), made.gaussians.means]
    assert all(bool((p.grad == gradient).all()) for p in rest)


def test_a_step_of_some_parameters_leaves_all_others_and_gradients_that_are_no_numbers():
    made = Made()
    made.optimiser.set_progress(0.0)
    chosen = [*made.networks[1].parameters()]
    for bad in (True, False):
        before = {name: value.detach().clone() for name, value in made.parameters().items()}
        gradients = [torch.ones_like(value) for value in chosen]
        if bad:
            gradients[0][0] = torch.nan
        made.optimiser.step_only(chosen, gradients)
        changed = {n for n, v in made.parameters().items() if not torch.equal(v, before[n])}
        assert changed == (set() if bad else {"other.weight", "other.bias"})


def test_rates_for_the_log_are_those_of_the_attributes():
    made = Made()
    made.optimiser.set_progress(0.75 * NOMINAL_ITERATIONS)
    expected = {name: 0.1 * rate for name, rate in STARTS.items()}
    expected["semantic_logits"] = STARTS["semantic_logits"]
    assert made.optimiser.learning_rates() == pytest.approx(expected)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("wrong", [float("nan"), float("inf"), -float("inf")])
def test_one_value_anywhere_that_is_not_finite_is_found(monkeypatch, seed, compiled, wrong):
    """In the first piece or the last, in a vector or in what is left over, in `others` as well."""
    if not compiled:
        monkeypatch.setattr("evsplat.training.optimiser.runs_native", lambda tensor: False)
    made, generator = Made(), torch.Generator().manual_seed(seed)
    long = torch.nn.Parameter(torch.zeros(2 * 2**15 + 21))  # of three pieces, the last a short one
    made.optimiser.networks.param_groups[0]["params"].append(long)
    gradients = [*made.parameters().values(), long]
    for value in gradients:
        value.grad = torch.randn(value.shape, generator=generator)
    loss = torch.randn((), generator=generator)
    assert bool(made.optimiser.finite(loss))
    assert not bool(made.optimiser.finite(loss * wrong))
    for value in gradients:
        last = value.numel() - 1
        drawn = int(torch.randint(value.numel(), (), generator=generator))
        for place in {0, min(2**15, last), drawn, last}:
            flat = value.grad.view(-1)
            kept = flat[place].clone()
            flat[place] = wrong
            assert not bool(made.optimiser.finite(loss)), (tuple(value.shape), place)
            flat[place] = kept
    assert bool(made.optimiser.finite(loss))


def test_a_gradient_of_any_layout_is_looked_at_whole():
    made = Made()
    for value in made.parameters().values():
        value.grad = torch.ones_like(value)
    weight = made.networks[1].weight
    weight.grad = torch.ones(2, 4).T
    assert bool(made.optimiser.finite())
    weight.grad[3, 1] = torch.nan
    assert not bool(made.optimiser.finite())
