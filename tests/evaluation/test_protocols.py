"""Regions, protocols, means over frames."""

import math

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from evsplat.evaluation.protocols import (
    AVATAR_COMPAT,
    HUGS_COMPAT,
    METRICS,
    PROTOCOLS,
    PSNR_CEILING_DB,
    STANDARD,
    MetricMeans,
    Truth,
    all_absent,
)
from evsplat.evaluation.regions import Absent
from evsplat.pictures.box import Box, mask_box
from evsplat.similarity.psnr_ssim import ssim_map

NO_NETWORKS = dict.fromkeys(METRICS[2:], Absent("no weights"))


def scene(seed: int = 0):
    """A true picture, a render that leaves [0, 1], and a person mask with its tight box."""
    rng = np.random.default_rng(seed)
    truth = np.round(rng.random((40, 60, 3)) * 255) / 255
    render = truth + rng.normal(0, 0.15, truth.shape)
    mask = np.zeros((40, 60), dtype=bool)
    mask[10:34, 5:25] = rng.random((24, 20)) > 0.3
    mask[10, 8] = mask[33, 9] = mask[20, 5] = mask[21, 24] = True
    return truth, render, mask, Box(10, 34, 5, 25)


def measure(protocol, truth, render, mask, box):
    judge = Truth(
        protocol,
        torch.from_numpy(truth),
        None if mask is None else torch.from_numpy(mask),
        box,
        NO_NETWORKS,
    )
    return judge.measure(torch.from_numpy(render))


def test_standard_rounds_to_8_bits_and_enlarges_the_box_by_a_tenth_per_side():
    truth, render, mask, box = scene()
    saved = np.round(render.clip(0, 1) * 255) / 255
    measured = measure(STANDARD, truth, render, mask, box)
    crop = np.s_[10 - 2 : 34 + 2, 5 - 2 : 25 + 2]
    settings = dict(gaussian_weights=True, sigma=1.5, use_sample_covariance=False)
    for region, part in (("full", np.s_[:, :]), ("person_crop", crop)):
        assert measured[region]["psnr"] == pytest.approx(
            peak_signal_noise_ratio(truth[part], saved[part], data_range=1)
        )
        assert measured[region]["ssim"] == pytest.approx(
            structural_similarity(
                truth[part], saved[part], data_range=1, channel_axis=-1, **settings
            )
        )
    in_mask = -10 * math.log10(((saved - truth)[mask] ** 2).mean())
    assert measured["person_mask"]["psnr"] == pytest.approx(in_mask)
    assert all(isinstance(measured["person_mask"][m], Absent) for m in METRICS[1:])


def test_avatar_compat_neither_clamps_nor_rounds_and_takes_range_two():
    truth, render, mask, box = scene(1)
    measured = measure(AVATAR_COMPAT, truth, render, mask, box)
    assert measured["full"]["psnr"] == pytest.approx(
        peak_signal_noise_ratio(truth, render, data_range=1)
    )
    assert measured["full"]["ssim"] == pytest.approx(
        structural_similarity(truth, render, data_range=2, channel_axis=-1)
    )


def test_hugs_compat_averages_channels_leaves_the_last_row_out_and_blackens():
    truth, render, mask, box = scene(2)
    measured = measure(HUGS_COMPAT, truth, render, mask, box)

    def channel_mean(a, b):
        return np.mean([-10 * math.log10(((a - b)[..., c] ** 2).mean()) for c in range(3)])

    crop = np.s_[10:33, 5:24]
    black = mask[..., None]
    assert measured["full"]["psnr"] == pytest.approx(channel_mean(truth, render))
    assert measured["person_crop"]["psnr"] == pytest.approx(channel_mean(truth[crop], render[crop]))
    assert measured["person_mask"]["psnr"] == pytest.approx(
        channel_mean(truth * black, render * black)
    )
    assert 0 < measured["person_mask"]["ssim"] < 1


@pytest.mark.parametrize("protocol", PROTOCOLS, ids=lambda p: p.name)
def test_equal_pictures_reach_the_ceiling_and_missing_networks_give_their_reason(protocol):
    truth, _, mask, box = scene()
    measured = measure(protocol, truth, truth, mask, box)
    assert measured["full"]["psnr"] == PSNR_CEILING_DB
    assert measured["full"]["ssim"] == pytest.approx(1)
    for name in METRICS[2:]:
        reason = measured["full"][name].reason
        expected = "no weights" if name in protocol.perceptual else "not part of protocol"
        assert expected in reason


@pytest.mark.parametrize("protocol", PROTOCOLS, ids=lambda p: p.name)
def test_without_a_mask_the_mask_region_says_so(protocol):
    truth, render, _, box = scene()
    measured = measure(protocol, truth, render, None, box)
    assert "no person mask" in measured["person_mask"]["psnr"].reason
    assert isinstance(measured["person_crop"]["psnr"], float)


@pytest.mark.parametrize("protocol", PROTOCOLS, ids=lambda p: p.name)
@pytest.mark.parametrize(
    "place", [(10, 34, 5, 25), (0, 18, 0, 60), (28, 40, 44, 60)], ids=["inside", "top", "corner"]
)
def test_similarity_of_parts_is_bit_for_bit_that_of_their_pixels_alone(protocol, place):
    """The person's windows are taken out of the picture's, and black ones are not computed."""
    top, bottom, left, right = place
    truth, render, _, _ = scene(5)
    mask = np.zeros((40, 60), dtype=bool)
    mask[top:bottom, left:right] = (
        np.random.default_rng(6).random((bottom - top, right - left)) > 0.4
    )
    box = mask_box(torch.from_numpy(mask))
    measured = measure(protocol, truth, render, mask, box)
    tight = protocol.crop == "tight"
    box = box.without_last() if tight else box.enlarged(0.1, 40, 60)
    seen = np.round(render.clip(0, 1) * 255) / 255 if protocol.eight_bit else render
    alone = {"person_crop": (box.crop(seen), box.crop(truth))}
    if protocol.mask == "blackened":
        alone["person_mask"] = seen * mask[..., None], truth * mask[..., None]
    for region, pictures in alone.items():
        windows = ssim_map(*map(torch.from_numpy, pictures), protocol.ssim)
        assert measured[region]["ssim"] == float(windows.mean())


def test_a_crop_smaller_than_the_window_has_psnr_only():
    truth, render, mask, _ = scene()
    measured = measure(STANDARD, truth, render, mask, Box(0, 5, 0, 5))
    assert isinstance(measured["person_crop"]["psnr"], float)
    assert "larger than the image" in measured["person_crop"]["ssim"].reason


def test_means_skip_gaps_and_say_how_many():
    frames = MetricMeans()
    truth, render, mask, box = scene()
    first = measure(STANDARD, truth, render, mask, box)
    second = measure(STANDARD, truth, 0.5 * (truth + render), mask, box)
    for measured in (first, second, all_absent("no truth")):
        frames.add(measured)
    means, reasons = frames.means()
    expected = (first["full"]["psnr"] + second["full"]["psnr"]) / 2
    assert means["full"]["psnr"] == pytest.approx(expected)
    assert reasons["full.psnr"] == "missing in 1 of 3: no truth"
    assert means["full"]["lpips_vgg"] is None and reasons["full.lpips_vgg"] == "no weights"
