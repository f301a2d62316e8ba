"""What the page of a bench says beside its pictures."""

import pytest

from evsplat.benching.page import _reached


@pytest.mark.parametrize(
    ("crop", "full", "said"),
    [
        (21.5, 30.0, "21.50\u00a0dB"),
        (0.0, 30.0, "0.00\u00a0dB"),
        (None, 30.0, "30.00\u00a0dB, full frame"),
        (None, None, ""),
    ],
)
def test_a_figure_that_is_not_of_the_person_crop_says_of_what_it_is(crop, full, said):
    regions = {"person_crop": {"psnr": crop}, "full": {"psnr": full}}
    assert _reached({"protocols": {"standard": regions}}) == said
