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
    assert resolution.scale == 1 or seconds == pytest.approx(0.04, rel=0.05)


def test_drafts_never_become_useless():
    resolution = Resolution()
    for _ in range(40):
        resolution.took(100.0)
    assert resolution.scale == LEAST_SCALE
    assert resolution.size(100, 50) == (30, 16)
    for _ in range(40):
        resolution.took(1e-6)
    assert resolution.size(100, 50) == (100, 50)
