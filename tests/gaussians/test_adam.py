"""Several Adams stepped at once against each one's own step."""

import pytest
import torch

from evsplat.gaussians import step_together

SHAPES = ((40, 3), (40, 4), (7,), ())
RATES = (1e-2, 3e-3, 1e-2, 0.0)


def adams() -> list[torch.optim.Adam]:
    """Two of them, with groups of different and of equal rates."""
    generator = torch.Generator().manual_seed(0)
    values = [torch.nn.Parameter(torch.randn(shape, generator=generator)) for shape in SHAPES]
    groups = [{"params": [p], "lr": lr} for p, lr in zip(values, RATES, strict=True)]
    groups[1]["weight_decay"] = 0.1
    return [torch.optim.Adam(some, eps=1e-15, fused=True) for some in (groups[:2], groups[2:])]


def parameters(made: list[torch.optim.Adam]) -> list[torch.nn.Parameter]:
    return [p for adam in made for group in adam.param_groups for p in group["params"]]


@pytest.mark.parametrize("tells", [False, True])
def test_it_is_the_step_of_each_adam_bit_for_bit(tells):
    apart, together = adams(), adams()
    generator = torch.Generator().manual_seed(1)
    for number in range(5):
        unsound = torch.tensor(float(number == 2)) if tells else None
        pairs = zip(parameters(apart), parameters(together), strict=True)
        for place, (one, other) in enumerate(pairs):
            silent = place == 2 and number in (0, 3)
            gradient = None if silent else torch.randn(one.shape, generator=generator)
            one.grad, other.grad = gradient, gradient
        for adam in apart:
            if tells:
                adam.found_inf = unsound  # as gradient scaling does
            adam.step()
        step_together(together, unsound)
        for one, other in zip(parameters(apart), parameters(together), strict=True):
            assert torch.equal(one, other)
    for one, other in zip(apart, together, strict=True):
        states = zip(
            one.state_dict()["state"].items(), other.state_dict()["state"].items(), strict=True
        )
        for (name, state), (other_name, other_state) in states:
            assert name == other_name
            assert all(torch.equal(state[key], other_state[key]) for key in state)


def test_without_gradients_nothing_happens():
    made = adams()
    step_together(made)
    assert not any(adam.state for adam in made)
