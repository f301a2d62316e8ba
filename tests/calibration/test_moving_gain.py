"""Brightness that a camera changes on its way, against what it was made of."""

import numpy as np
import pytest
from scipy.ndimage import affine_transform, gaussian_filter

from evsplat.calibration.moving_gain import MovingGainMeter

POWER = 2.2


def recording(
    seed: int, gains: np.ndarray, *, pan: float = 0.2, grey: bool = False, noise: float = 0.01
) -> list[np.ndarray]:
    """8-bit pictures of a wall that the camera sways and pans across, and a person before it.

    ``pan`` is how much of a picture it goes on in all.
    """
    rng = np.random.default_rng(seed)
    height, width, channels = 90, 120, gains.shape[1]
    wide = np.stack(
        [gaussian_filter(rng.standard_normal((150, 240)), 4.0) for _ in range(channels)]
    )
    wide = 0.3 * np.exp(0.6 * wide / wide.std())
    pictures = []
    for i, gain in enumerate(gains):
        angle, zoom = 0.02 * np.sin(0.7 * i), 1 + 0.02 * np.cos(0.5 * i)
        turn = zoom * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        at = np.array([30 + 2 * np.sin(i), 30 + pan * width * i / len(gains)])
        light = np.stack(
            [affine_transform(layer, turn, at, (height, width), order=1) for layer in wide], -1
        )
        left = 20 + 2 * i
        light[20:80, left : left + 25] = rng.uniform(0.05, 0.6, channels)
        light *= gain * np.exp(noise * rng.standard_normal(light.shape))
        coded = np.uint8(np.round(255 * np.clip(light, 0, 1) ** (1 / POWER)))
        pictures.append(coded[..., 0] if grey else coded)
    return pictures


def measured(pictures: list[np.ndarray]) -> np.ndarray | None:
    meter = MovingGainMeter()
    for picture in pictures:
        meter.add(picture, "power")
    return meter.gains()


@pytest.mark.parametrize("pan", [0.0, 0.5])
@pytest.mark.parametrize("seed", range(3))
def test_gains_of_each_colour_are_those_that_the_camera_had(seed: int, pan: float) -> None:
    rng = np.random.default_rng(seed)
    true = np.exp(np.cumsum(0.08 * rng.standard_normal((24, 3)), axis=0))
    true /= np.quantile(true, 0.95, axis=0, method="lower")
    true *= 0.9 / true.max()
    found = measured(recording(seed, true, pan=pan))
    assert found is not None
    off = np.log(found / true)
    assert np.abs(off - np.median(off, axis=0)).max() < 0.04


@pytest.mark.parametrize("noise", [0.0, 0.1])
@pytest.mark.parametrize("pan", [0.0, 0.7])
@pytest.mark.parametrize("seed", range(3))
def test_a_steady_camera_has_none_wherever_it_goes(seed: int, pan: float, noise: float) -> None:
    assert measured(recording(seed, np.ones((20, 3)), pan=pan, noise=noise)) is None


@pytest.mark.parametrize("seed", [8, 9, 11, 13])
def test_grey_pictures_have_one_gain_and_a_dark_one_that_of_its_neighbours(seed: int) -> None:
    true = np.linspace(1.0, 0.6, 16)[:, None]
    pictures = recording(seed, true, grey=True)
    pictures[7] = np.zeros_like(pictures[7])
    found = measured(pictures)
    assert found is not None and found.shape == (16, 1)
    assert found / np.median(found) == pytest.approx(true / np.median(true), rel=0.03)


def test_pictures_that_do_not_lie_over_each_other_tell_nothing() -> None:
    gains = np.linspace(1.0, 0.5, 12)[:, None] * np.ones(3)
    assert measured([recording(i, gains)[i] for i in range(12)]) is None


def test_pictures_that_tell_nothing_have_none() -> None:
    assert measured([]) is None
    assert measured([np.full((40, 50, 3), 99, np.uint8)]) is None
    assert measured([np.zeros((40, 50, 3), np.uint8)] * 3) is None
    assert measured([np.full((40, 50), 99, np.uint8), np.full((40, 50, 3), 99, np.uint8)]) is None
