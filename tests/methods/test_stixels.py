"""Upright things of columns: the best of all choices, each column with its neighbours."""

import itertools

import numpy as np
import pytest

from evsplat.methods import stixels as module
from evsplat.methods.stixels import stixels


def worth(chosen, gains, edges):
    """Of one choice of ends in each column, added up as the docstrings say."""
    total = 0.0
    for column, ends in enumerate(chosen):
        if ends is not None:
            top, foot = ends
            total += gains[top : foot + 1, column].sum() + edges[foot, column]
            total += edges[top - 1, column] if top else 0
    for one, other in itertools.pairwise(chosen):
        if (one is None) != (other is None):
            total -= module._END
        elif one is not None:
            moved = module._BEND * (abs(one[0] - other[0]) + abs(one[1] - other[1]))
            total -= min(moved, module._BREAK, 2 * module._END)
    return total - module._END * (chosen[0] is not None)


def test_no_other_choice_is_better(rng):
    for _ in range(20):
        height, width = 5, 4
        gains, edges = rng.normal(0, 4, (2, height, width))
        floor = np.arange(height)[:, None] >= rng.integers(2, 5, width)
        risen = np.arange(height)[:, None] < rng.integers(1, 3, width)
        columns = []
        for column in range(width):
            ends = itertools.product(risen[:, column].nonzero()[0], floor[:, column].nonzero()[0])
            columns.append([None, *((int(top), int(foot)) for top, foot in ends)])
        most = max(worth(chosen, gains, edges) for chosen in itertools.product(*columns))
        assert worth(stixels(gains, edges, floor, risen), gains, edges) == pytest.approx(
            most, abs=1e-4
        )


def test_nothing_stands_where_no_floor_is_seen():
    nowhere = np.zeros((6, 3), bool)
    assert stixels(np.ones((6, 3)), np.zeros((6, 3)), nowhere, ~nowhere) == [None] * 3
