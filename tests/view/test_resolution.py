"""The size of drafts follows the time that they take."""

import pytest

from evsplat.view.resolution import LEAST_SCALE, Resolution


@pytest.mark.parametrize("nanoseconds_per_pixel", [20, 100, 300])
def test_drafts_come_to_take_the_target(nanoseconds_per_pixel):
    resolution = Resolution(target_s=0.04)
    for _ in range(40):
        width, height = resolution.size(1024, 1024)
        seconds = width * height * nanoseconds_per_pixel * 1e-9
        resolution.took(seconds)
    # Sizes go in steps of a quarter of an octave of the side, half an octave of the pixels.
    assert resolution.scale == 1 or 0.04 / 1.8 < seconds < 0.04 * 1.8


def test_drafts_never_become_useless():
    resolution = Resolution()
    for _ in range(40):
        resolution.took(100.0)
    assert resolution.scale == LEAST_SCALE
    assert resolution.size(100, 50) == (30, 16)
    for _ in range(40):
        resolution.took(1e-6)
    assert resolution.size(100, 50) == (100, 50)


def test_a_slow_picture_now_and_then_does_not_change_the_size():
    resolution = Resolution(target_s=0.04)
    sizes = set()
    for picture in range(60):
        sizes.add(resolution.size(512, 512))
        # A scene that has to be drawn anew takes three times as long.
        resolution.took(0.036 * resolution.scale**2 * (2 if picture % 20 == 0 else 1))
    assert len(sizes) <= 2
