import numpy as np
import pytest

from evsplat.pictures.squares import square_means


@pytest.mark.parametrize(("shape", "step"), [((2, 7, 9), 2), ((1, 6, 6), 3), ((2, 3, 5, 8), 4)])
def test_a_pixel_of_a_smaller_map_is_the_mean_of_its_square(shape, step):
    """What fills no square, at the right and below, counts nowhere."""
    maps = np.random.default_rng(len(shape) + step).random(shape, np.float32)
    means = square_means(maps, step)
    assert means.dtype == np.float32
    assert means.shape == (*shape[:-2], shape[-2] // step, shape[-1] // step)
    for place in np.ndindex(means.shape):
        *first, row, column = place
        rows, columns = (slice(k * step, (k + 1) * step) for k in (row, column))
        square = maps[(*first, rows, columns)].astype(np.float64)
        assert means[place] == pytest.approx(square.mean(), rel=1e-6)


def test_many_large_values_are_summed_in_the_kind_that_is_asked_for():
    values = np.full((256, 256), 65_535, np.uint16)
    values[0, 0] = 65_534
    assert square_means(values, 256, np.float64).item() == 65_535 - 2**-16
