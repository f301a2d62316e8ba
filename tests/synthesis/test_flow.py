"""Interpolation along optical flow against motion that is known."""

import numpy as np
import pytest

from evsplat.synthesis.flow import FlowInterpolator

from .helpers import disc_over_texture, picture, psnr, shifted, texture

FRACTIONS = (0.25, 0.5, 0.8)


@pytest.mark.parametrize("seed", range(3))
def test_a_moving_picture_is_moved_by_the_fraction(seed):
    motion = np.random.default_rng(seed).uniform(-5, 5, 2)
    image = texture(64, 80, seed)
    before, after = picture(image), picture(shifted(image, *motion))
    made = FlowInterpolator().between(before, after, FRACTIONS)
    for fraction, between in zip(FRACTIONS, made, strict=True):
        truth = shifted(image, *(fraction * motion))
        inside = np.s_[10:-10, 10:-10]
        assert psnr(between[inside], truth[inside]) > 36
        blended = (1 - fraction) * before.linear + fraction * after.linear
        assert psnr(between[inside], truth[inside]) > psnr(blended[inside], truth[inside]) + 8


@pytest.mark.parametrize(("seed", "step", "gain_db"), [(0, 9.0, 4), (1, -9.0, 4), (2, 14.0, 1.5)])
def test_what_is_hidden_is_taken_from_the_picture_that_shows_it(seed, step, gain_db):
    """A disc over a standing texture uncovers it on one side and covers it on the other."""
    before, after = (disc_over_texture(48 + part * step, seed) for part in (-0.5, 0.5))
    made = FlowInterpolator().between(picture(before), picture(after), FRACTIONS)
    for fraction, between in zip(FRACTIONS, made, strict=True):
        truth = disc_over_texture(48 + (fraction - 0.5) * step, seed)
        blended = (1 - fraction) * before + fraction * after
        # where the two pictures differ: the disc and the strips that it hides in one of them
        changed = np.abs(after - before).max(-1) > 0.02
        gain = psnr(between[changed], truth[changed]) - psnr(blended[changed], truth[changed])
        assert gain > gain_db
        standing = ~changed
        assert np.abs(between[standing] - truth[standing]).mean() < 0.004


def test_a_standing_scene_stays_exactly():
    image = picture(texture(48, 40, seed=3))
    for between in FlowInterpolator().between(image, image, FRACTIONS):
        assert np.abs(between - image.linear).max() < 1e-5


def test_grey_pictures_and_sizes_without_a_factor_of_two_keep_their_shape():
    image = texture(37, 51, seed=4)[..., :1]
    made = list(FlowInterpolator().between(picture(image), picture(shifted(image, 2, 1)), [0.5]))
    assert made[0].shape == (37, 51, 1)
    assert psnr(made[0][6:-6, 6:-6], shifted(image, 1, 0.5)[6:-6, 6:-6]) > 35


def test_light_that_fades_without_motion_fades():
    """No pixel matches, yet the result lies between the two pictures."""
    image = texture(40, 40, seed=5)
    before, after = picture(image), picture(0.4 * image)
    between = next(FlowInterpolator().between(before, after, [0.5]))
    assert psnr(between, 0.7 * image) > 25


@pytest.mark.parametrize(("height", "width"), [(11, 11), (11, 12), (12, 11)])
def test_the_smallest_pictures_of_captures_are_moved_too(height, width):
    image = texture(height, width, seed=6)
    before, after = picture(image), picture(0.8 * image)
    made = next(FlowInterpolator().between(before, after, [0.5]))
    assert made.shape == image.shape
    assert (made <= before.linear.max() + 1e-5).all() and (made >= 0).all()
    standing = next(FlowInterpolator().between(before, before, [0.5]))
    assert np.abs(standing - before.linear).max() < 1e-5
