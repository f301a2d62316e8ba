"""The table printed after an evaluation."""

from dataclasses import asdict

from evsplat.capture import Policy
from evsplat.capture.policy import Terms
from evsplat.cli.runs import summary_table


def _regions(psnr):
    return {
        region: {"psnr": psnr + step, "ssim": 0.9}
        for step, region in enumerate(("full", "person_crop", "person_mask"))
    }


def test_table_has_the_run_above_the_trivial_rows_and_the_cameras_own_picture():
    metrics = {
        "method": "paper",
        "frames": {"test": 2},
        "policy": asdict(Policy(held_out_events=True)),
        "blurry_input": _regions(31.0),
        "protocols": {"standard": _regions(30.0)},
        "trivial": {"median_background": _regions(20.0), "nearest_frame": _regions(25.125)},
    }
    lines = summary_table(metrics).splitlines()
    assert "standard" in lines[0]
    assert [line.split()[0] for line in lines[2:-1]] == [
        "paper",
        "median_background",
        "nearest_frame",
        "own",
    ]
    assert "30.00 / 0.900" in lines[2]
    assert "26.12 / 0.900" in lines[4] or "26.13 / 0.900" in lines[4]
    assert len({len(line) for line in lines[1:-1]}) == 1
    assert lines[-1] == Terms(held_out_events=True).sentence(2)
    metrics |= {"frames": {"test": 0}, "policy": asdict(Policy(use="everything"))}
    assert summary_table(metrics).startswith("No test figures. Every frame and every event trained")
    metrics |= {"policy": asdict(Policy())}
    assert "nothing was held out" in summary_table(metrics)
    assert "hidden" not in summary_table(metrics)


def test_without_a_sharp_truth_a_sentence_stands_in_place_of_dashes():
    regions = dict.fromkeys(_regions(0.0), {"psnr": None, "ssim": None})
    metrics = {"method": "paper", "protocols": {"standard": regions}, "trivial": {}}
    metrics |= {"frames": {"test": 3}, "blurry_input": regions}
    summary = summary_table(metrics)
    assert "- / -" not in summary and "\n" not in summary
    assert "Of 3 held-out frames none has a sharp picture to be compared with." in summary


def test_what_was_not_measured_is_a_dash():
    regions = _regions(30.0)
    regions["person_mask"] = {"psnr": None, "ssim": None}
    metrics = {"method": "paper", "protocols": {"standard": regions}, "trivial": {}}
    metrics |= {"frames": {"test": 2}, "blurry_input": regions}
    lines = summary_table(metrics).splitlines()
    assert lines[-2].endswith("- / -") and "othing tells what training saw" in lines[-1]


def test_a_row_of_dashes_is_explained_below_the_table():
    gap = {region: dict.fromkeys(values) for region, values in _regions(0.0).items()}
    metrics = {"method": "avatar3dgs", "protocols": {"standard": _regions(30.0)}}
    metrics |= {"frames": {"test": 2}, "blurry_input": _regions(25.0)}
    metrics |= {"trivial": {"median_background": gap}, "composited": {"standard": gap}}
    places = ("trivial.median_background", "composited.standard")
    metrics["reasons"] = {f"{place}.full.psnr": "the camera moves." for place in places}
    lines = summary_table(metrics).splitlines()
    assert "on_median_background, median_background: the camera moves." in lines
