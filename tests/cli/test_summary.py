"""The table printed after an evaluation."""

from evsplat.cli.summary import summary_table


def _regions(psnr):
    return {
        region: {"psnr": psnr + step, "ssim": 0.9}
        for step, region in enumerate(("full", "person_crop", "person_mask"))
    }


def test_table_has_the_run_above_the_trivial_rows():
    metrics = {
        "method": "paper",
        "protocols": {"standard": _regions(30.0)},
        "trivial": {"median_background": _regions(20.0), "nearest_frame": _regions(25.125)},
    }
    lines = summary_table(metrics).splitlines()
    assert "standard" in lines[0]
    assert [line.split()[0] for line in lines[2:]] == [
        "paper",
        "median_background",
        "nearest_frame",
    ]
    assert "30.00 / 0.900" in lines[2]
    assert "26.12 / 0.900" in lines[4] or "26.13 / 0.900" in lines[4]
    assert len({len(line) for line in lines[1:]}) == 1


def test_what_was_not_measured_is_a_dash():
    regions = _regions(30.0)
    regions["person_mask"] = {"psnr": None, "ssim": None}
    metrics = {"method": "paper", "protocols": {"standard": regions}, "trivial": {}}
    assert summary_table(metrics).splitlines()[-1].endswith("- / -")
