"""Pictures that were made elsewhere are measured as a method is, and wrong ones are refused."""

import json
from shutil import copy

import numpy as np
import pytest
from PIL import Image

from evsplat.benching.given_pictures import GivenPictures
from evsplat.capture import load_capture
from evsplat.cli.main import main
from evsplat.errors import DataError
from evsplat.untrusted.text import read_json

from .helpers import MEDIAN, cells_in_this_process, write_suite


@pytest.fixture
def bench(tiny_capture, tmp_path):
    """A bench of one untrained row, the capture, and a folder for somebody's pictures."""
    capture = load_capture(tiny_capture("one"))
    suite = write_suite(tmp_path / "suite.yaml", {"one": capture.path}, MEDIAN)
    theirs = tmp_path / "theirs" / "one"
    theirs.mkdir(parents=True)

    def run() -> dict | None:
        added = f"them={theirs.parent}"
        code = main(["bench", str(suite), "--out", str(tmp_path / "out"), "--add", added])
        record = tmp_path / "out" / "cells" / "one" / "them" / "seed0.json"
        return read_json(record) if code == 0 else None

    with cells_in_this_process():
        yield capture, theirs, run


def write_pictures(capture, folder, change: int) -> float:
    """Pictures off by ``change`` of 255 at every pixel; their mean PSNR, dB."""
    errors = []
    for frame in capture.test_frames:
        truth = np.asarray(Image.open(frame.sharp).convert("RGB")).astype(int)
        picture = np.where(truth > 127, truth - change, truth + change).astype(np.uint8)
        Image.fromarray(picture).save(folder / f"{frame.name}.png")
        errors.append(10 * np.log10(255**2 / np.mean((picture - truth) ** 2.0)))
    return float(np.mean(errors))


def test_given_pictures_are_measured_by_the_one_evaluator_and_again_when_they_change(bench):
    capture, theirs, run = bench
    for change in (9, 4):
        expected = write_pictures(capture, theirs, change)
        record = run()
        assert record["status"] == "done", record
        assert record["protocols"]["standard"]["full"]["psnr"] == pytest.approx(expected, abs=1e-3)
        # Nobody knows what a program of somebody else saw: no policy is claimed.
        assert record["policy"] is None


def with_gain(capture, gain) -> None:
    """Give all frames of the capture that gain."""
    path = capture.path / "capture.json"
    document = json.loads(path.read_text())
    for frame in document["frames"]:
        frame["gain"] = gain
    path.write_text(json.dumps(document))


@pytest.mark.parametrize("gain", [0.6, [0.9, 0.7, 0.5]])
def test_a_picture_in_place_of_the_truth_has_the_gain_of_its_frame(bench, gain):
    """Copies of the sharp pictures are exact."""
    capture, theirs, run = bench
    with_gain(capture, gain)
    for frame in capture.test_frames:
        copy(frame.sharp, theirs / f"{frame.name}.png")
    exact = run()["protocols"]["standard"]["full"]
    assert exact["ssim"] == pytest.approx(1.0, abs=1e-6)
    assert exact["psnr"] is None or exact["psnr"] > 90


def test_grey_pictures_are_not_divided_by_gains_of_three_colours(bench):
    """They would become coloured."""
    capture, theirs, _ = bench
    for frame in capture.test_frames:
        Image.open(frame.sharp).convert("L").save(theirs / f"{frame.name}.png")
    for gain in (0.6, [0.9, 0.7, 0.5]):
        with_gain(capture, gain)
        loaded = load_capture(capture.path)
        frame = loaded.test_frames[0]
        given = GivenPictures(theirs, loaded)
        if gain == 0.6:
            rgb = given.render(loaded.camera(frame), [frame.mid_us]).rgb
            assert (rgb == rgb[..., :1]).all() and rgb.mean() > 0
        else:
            with pytest.raises(DataError, match=f"{frame.name}.png: is grey and has a gain of 3"):
                given.render(loaded.camera(frame), [frame.mid_us])


def test_the_page_says_how_to_repeat_a_cell_and_links_its_files(bench, tmp_path):
    capture, theirs, run = bench
    write_pictures(capture, theirs, 3)
    run()
    page = (tmp_path / "out" / "index.html").read_text()
    assert 'href="cells/one/them/seed0.json"' in page
    assert 'href="runs/one/median/seed0/pictures"' in page
    assert f"--captures {capture.path} --only median" in page
    assert "made elsewhere; what training saw is not known" in page
    with Image.open(tmp_path / "out" / "strips" / "one.png") as strip:
        camera = capture.camera(capture.test_frames[0])
        assert strip.height > 200 and strip.width > strip.height
        assert camera.width


@pytest.mark.parametrize("wrong", ["missing", "size", "unreadable", "no capture", "no folder"])
def test_wrong_pictures_are_one_sentence(bench, tmp_path, capsys, wrong):
    capture, theirs, run = bench
    write_pictures(capture, theirs, 3)
    first = theirs / f"{capture.test_frames[0].name}.png"
    if wrong == "missing":
        first.unlink()
    elif wrong == "size":
        Image.new("RGB", (5, 7)).save(first)
    elif wrong == "unreadable":
        first.write_bytes(b"no picture")
    elif wrong == "no capture":
        theirs.rename(theirs.with_name("two"))
    else:
        theirs.rename(tmp_path / "gone")
        theirs.parent.rmdir()
    record = run()
    if wrong in ("no capture", "no folder"):
        assert record is None
        expected = "of no capture of the suite" if wrong == "no capture" else "NAME=FOLDER"
        assert expected in capsys.readouterr().err
        return
    assert record["status"] == "failed" and first.name in record["reason"]
    said = {"missing": "have no picture", "size": "5x7", "unreadable": "not a readable picture"}
    assert said[wrong] in record["reason"]
