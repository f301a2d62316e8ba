"""Random signs and what their sums tell."""

import torch

from evsplat.probes import random_signs


def test_signs_are_of_the_kind_of_what_they_are_for_and_drawn_alike():
    like = torch.zeros(40, 3, dtype=torch.float64)
    one, two = (random_signs(like, torch.Generator().manual_seed(5)) for _ in range(2))
    assert torch.equal(one, two) and one.dtype == torch.float64 and one.shape == (40, 3)
    assert set(one.unique().tolist()) == {-1.0, 1.0}


def test_products_with_signs_have_the_diagonal_of_a_matrix_for_their_mean():
    matrix = torch.tensor([[2.0, 0.3, -0.4], [0.3, 1.0, 0.2], [-0.4, 0.2, 0.5]])
    signs = random_signs(torch.zeros(20_000, 3), torch.Generator().manual_seed(0))
    # An entry's standard deviation is at most 0.5, of the mean 0.0035.
    torch.testing.assert_close(
        (signs * (signs @ matrix)).mean(0), matrix.diagonal(), atol=0.015, rtol=0
    )
    torch.testing.assert_close(
        (signs @ matrix).square().mean(0), matrix.square().sum(1), atol=0.05, rtol=0
    )
