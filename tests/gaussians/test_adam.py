"""Our Adam, and several stepped at once, against each one's own step in torch.optim."""

import pytest
import torch

from evsplat.gaussians import Adam, step_together

SHAPES = ((40, 3), (40, 4), (7,), (), (11_000, 3))  # the last one by all threads
RATES = (1e-2, 3e-3, 1e-2, 0.0, 1e-2)


def adams(kind, **more):
    """Two of them, with groups of different and of equal rates."""
    generator = torch.Generator().manual_seed(0)
    values = [torch.nn.Parameter(torch.randn(shape, generator=generator)) for shape in SHAPES]
    groups = [{"params": [p], "lr": lr} for p, lr in zip(values, RATES, strict=True)]
    groups[1]["weight_decay"] = 0.1
    groups[2]["betas"] = (0.8, 0.98)
    return [kind(some, eps=1e-15, **more) for some in (groups[:2], groups[2:])]


def parameters(made) -> list[torch.nn.Parameter]:
    return [p for adam in made for group in adam.param_groups for p in group["params"]]


@pytest.mark.parametrize("tells", [False, True])
def test_it_is_the_step_of_each_adam_bit_for_bit(tells):
    apart, together = adams(torch.optim.Adam, fused=True), adams(Adam)
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
        for of_one, of_other in zip(parameters([one]), parameters([other]), strict=True):
            states = one.state[of_one], other.state[of_other]
            assert states[0].keys() == states[1].keys()
            assert all(torch.equal(states[0][key], states[1][key]) for key in states[0])


def test_values_are_a_group_of_the_defaults():
    value = torch.nn.Parameter(torch.tensor([1.0, -2.0]))
    adam = Adam([value], lr=0.1)
    value.grad = torch.tensor([0.5, -3.0])
    adam.step()  # of the first one the size is the rate, whatever the gradient
    torch.testing.assert_close(value.detach(), torch.tensor([0.9, -1.9]))
    adam.zero_grad()
    assert value.grad is None


def test_without_gradients_nothing_happens():
    made = adams(Adam)
    step_together(made)
    assert not any(adam.state for adam in made)
