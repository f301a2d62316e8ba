"""Brightness that a camera changes from picture to picture, against what it was made of."""

import numpy as np
import pytest

from evsplat.calibration.gain import GainMeter

TRANSFERS = {"power": 2.2, "linear": 1.0}


def recording(
    seed: int,
    gains: np.ndarray,
    *,
    transfer: str = "power",
    noise: float = 0.01,
    person: float = 0.25,
) -> list[np.ndarray]:
    """Pictures of a scene that a dark person crosses, of ``person`` of the width, in 8 bits."""
    rng = np.random.default_rng(seed)
    height, width = int(rng.integers(50, 90)), int(rng.integers(60, 120))
    scene = np.kron(rng.uniform(0.1, 0.7, (9, 12, 3)), np.ones((11, 11, 1)))[:height, :width]
    pictures = []
    for i, gain in enumerate(gains):
        light = scene.copy()
        left = round(i / len(gains) * width * (1 - person))
        light[:, left : left + round(person * width)] = rng.uniform(0.05, 0.3)
        light = light * gain * np.exp(noise * rng.standard_normal(light.shape))
        coded = np.clip(light, 0, 1) ** (1 / TRANSFERS[transfer])
        pictures.append(np.uint8(np.round(255 * coded)))
    return pictures


def measured(pictures: list[np.ndarray], transfer: str = "power") -> np.ndarray | None:
    meter = GainMeter()
    for picture in pictures:
        meter.add(picture, transfer)
    return meter.gains()


@pytest.mark.parametrize("transfer", ["power", "linear"])
@pytest.mark.parametrize("seed", range(4))
def test_gains_of_each_colour_are_those_that_the_camera_had(seed: int, transfer: str) -> None:
    rng = np.random.default_rng(seed)
    true = np.exp(0.15 * rng.standard_normal((20, 3)))
    true /= np.quantile(true, 0.95, axis=0, method="lower")  # as the second brightest of 20
    found = measured(recording(seed, true, transfer=transfer), transfer)
    assert found is not None
    assert found == pytest.approx(true, rel=0.01)


@pytest.mark.parametrize("noise", [0.0, 0.1])
@pytest.mark.parametrize("person", [0.1, 0.5])
@pytest.mark.parametrize("seed", range(3))
def test_a_steady_camera_has_none_however_large_the_person_and_the_noise(
    seed: int, person: float, noise: float
) -> None:
    pictures = recording(seed, np.ones((20, 3)), person=person, noise=noise)
    assert measured(pictures) is None


def test_one_flash_does_not_make_all_others_as_bright() -> None:
    true = np.ones((30, 1))
    true[11] = 1.3
    found = measured(recording(5, true))
    assert found is not None
    assert np.delete(found, 11, axis=0) == pytest.approx(1.0, abs=0.01)
    assert found[11] == pytest.approx(1.3, rel=0.02)


def test_grey_pictures_have_one_gain_and_a_dark_one_that_of_its_neighbours() -> None:
    gains = np.linspace(1.0, 0.7, 15)
    grey = [picture[..., 1] for picture in recording(8, gains[:, None])]
    grey[6] = np.zeros_like(grey[6])
    found = measured(grey)
    assert found is not None and found.shape == (15, 1)
    assert found[:, 0] == pytest.approx(gains / gains[1], rel=0.01)


def test_pictures_that_tell_nothing_have_none() -> None:
    dark = [np.zeros((40, 50, 3), np.uint8)] * 3
    assert measured(dark) is None
    assert measured([]) is None
    assert measured([np.full((40, 50), 99, np.uint8), np.full((40, 50, 3), 99, np.uint8)]) is None
