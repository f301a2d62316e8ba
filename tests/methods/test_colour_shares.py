"""Shares of colours: all of what is weighed looks like itself, in the light and in the shade."""

import numpy as np
import pytest

from evsplat.methods.colour_shares import ColourShares


def two_halves(rng: np.random.Generator, shade: float) -> np.ndarray:
    """A picture of one colour, darker on the right; its lowest row is white."""
    picture = np.tile(rng.uniform(0.5, 0.8, 3), (9, 12, 1))
    picture[:, 6:] *= shade
    picture[-1] = 1.0
    return picture


def test_what_is_weighed_looks_like_itself(rng):
    lit = np.zeros((9, 12))
    lit[:-1, :6] = rng.uniform(0.5, 2.0)
    shares = ColourShares(two_halves(rng, 0.4)).of(lit)
    assert shares[0, 0] > 20 * shares[0, 11]
    assert np.ptp(shares[:-1, :6]) < 1e-12
    assert ColourShares(two_halves(rng, 0.4)).of(0 * lit).max() == 0


@pytest.mark.parametrize("shade", [0.7, 0.9])
def test_in_the_shade_it_has_half_the_share(rng, shade):
    lit = np.zeros((9, 12))
    lit[:-1, :6] = 1
    # Of one level where brightness is even: its colours are those of the lit half exactly.
    colours = ColourShares(two_halves(rng, shade))
    shares = colours.of(lit, (shade,))
    assert np.allclose(shares[:-1, :6], colours.of(lit)[:-1, :6])
    assert shares[:-1, 6:] == pytest.approx(np.full((8, 6), 0.5 * shares[0, 0]), rel=0.5)
    assert (shares >= colours.of(lit)).all()
