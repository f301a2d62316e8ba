"""Some of many, evenly spread."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from evsplat.spread import evenly_spread


@given(st.integers(1, 500), st.integers(2, 60))
def test_the_ends_are_among_them_and_steps_differ_by_one_at_most(count, most):
    chosen = evenly_spread(range(count), most)
    assert len(chosen) == min(count, most)
    assert (chosen[0], chosen[-1]) == (0, count - 1)
    steps = np.diff(chosen)
    if len(steps):
        assert steps.min() >= 1 and steps.max() - steps.min() <= 1


def test_of_nothing_there_is_nothing_and_of_one_place_the_first():
    assert evenly_spread([], 3) == []
    assert evenly_spread("abc", 1) == ["a"]
