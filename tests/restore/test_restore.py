"""`restore_capture`: sharper frames, everything else as it was, nothing half-written."""

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from PIL import Image

from evsplat.capture import Capture, Frame, Policy, load_capture, validate_capture
from evsplat.errors import ConfigError, DataError
from evsplat.events import deblur
from evsplat.pictures.files import read_image, write_image
from evsplat.restore import RESTORERS, restore_capture

from ..seen import seen

Factory = Callable[..., Path]


def _psnr(picture: torch.Tensor, truth: torch.Tensor) -> float:
    return float(-10 * torch.log10(((picture - truth) ** 2).mean()))


def _edi(capture: Capture, frame: Frame) -> torch.Tensor:
    events = capture.events.between(*frame.exposure_us)
    return deblur(
        capture.image(frame), events, frame.exposure_us, [frame.mid_us], capture.contrast_threshold
    )[0]


def _edit(path: Path, **changes) -> None:
    document = json.loads((path / "capture.json").read_text())
    document["events"] = {**document["events"], **changes} if changes else None
    (path / "capture.json").write_text(json.dumps(document))


def test_frames_become_what_edi_makes_at_mid_exposure(
    tiny_capture: Factory, tmp_path: Path
) -> None:
    path = tiny_capture(width=64, height=48)
    out = restore_capture(path, tmp_path / "sharp")
    blurry, sharp = load_capture(path), load_capture(out)
    for frame in blurry.frames:
        assert (_edi(blurry, frame) - sharp.image(frame.name)).abs().max() < 0.003
    assert [frame.mid_us for frame in sharp.frames] == [frame.mid_us for frame in blurry.frames]
    assert {frame.exposure_us[1] - frame.exposure_us[0] for frame in sharp.frames} == {1}
    made = sharp.provenance["restored"]
    assert made["with"] == "edi" and made["contrast_threshold"] == [0.2, 0.2]
    assert made["contrast_threshold_origin"] == "from the capture"
    assert made["recorded_exposure_us"]["0003"] == list(blurry.frame("0003").exposure_us)
    assert sharp.provenance["text"] == blurry.provenance["text"]


def test_all_else_stays_and_the_source_is_not_touched(
    tiny_capture: Factory, tmp_path: Path
) -> None:
    path = tiny_capture()
    (path / "LICENSE.txt").write_text("free")
    before = {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}
    out = restore_capture(path, tmp_path / "deep" / "sharp")
    assert validate_capture(out) == []
    for file, content in before.items():
        assert file.read_bytes() == content
        copy = out / file.relative_to(path)
        if file.name != "capture.json" and file.parent.name != "images":
            assert copy.read_bytes() == content
    changed = [
        f
        for f in (path / "images").iterdir()
        if (out / "images" / f.name).read_bytes() != before[f]
    ]
    assert changed


def test_unknown_thresholds_are_estimated(tiny_capture: Factory, tmp_path: Path) -> None:
    path = tiny_capture(frames=20, width=96, height=72)
    _edit(path, contrast_threshold=None)
    made = load_capture(restore_capture(path, tmp_path / "sharp")).provenance["restored"]
    assert made["contrast_threshold_origin"] == "estimated from the capture"
    assert made["contrast_threshold"] == pytest.approx([0.2, 0.2], rel=0.35)
    given = restore_capture(path, tmp_path / "given", contrast_threshold=(0.3, 0.1))
    assert load_capture(given).provenance["restored"]["contrast_threshold"] == [0.3, 0.1]


def test_lens_distortion_is_gone_afterwards(tiny_capture: Factory, tmp_path: Path) -> None:
    """The restored capture has to read as the old one did: undistorted once, not twice."""
    path = tiny_capture(width=64, height=48)
    document = json.loads((path / "capture.json").read_text())
    document["cameras"]["main"]["distortion"] = {
        "model": "opencv",
        "coefficients": [-0.2, 0.05, 0.001, -0.001],
    }
    document["events"]["clock_offset_us"] = 250
    (path / "capture.json").write_text(json.dumps(document))
    old, new = load_capture(path), load_capture(restore_capture(path, tmp_path / "flat"))
    assert not new.is_distorted("main")
    frame = old.frames[2]
    assert (old.sharp(frame) - new.sharp(frame.name)).abs().max() < 0.003
    assert (old.mask(frame) - new.mask(frame.name)).abs().max() < 0.003
    assert (_edi(old, frame) - new.image(frame.name)).abs().max() < 0.003
    window = old.events.time_range_us
    for column in ("t", "x", "y", "p"):
        expected = getattr(old.events.between(*window), column)
        assert np.array_equal(getattr(new.events.between(*window), column), expected)


@pytest.mark.parametrize("lens", [None, {"model": "opencv", "coefficients": [-0.1, 0, 0, 0]}])
def test_dark_pictures_of_16_bits_keep_their_levels(
    lens: dict | None, tiny_capture: Factory, tmp_path: Path
) -> None:
    """Light of a twentieth of the range has twelve levels in 8 bits."""
    path = tiny_capture(width=64, height=48)
    document = json.loads((path / "capture.json").read_text())
    for camera in document["cameras"].values():
        camera |= {"transfer": "linear", "distortion": lens}
    files = {frame[key] for frame in document["frames"] for key in ("image", "sharp")}
    for file in files | {view["image"] for view in document["novel_views"]}:
        light = 0.05 * (read_image(path / file) / 255) ** 2.2
        (path / file).unlink()
        write_image(path / file, np.rint(light * 65535).astype(np.uint16))
    (path / "capture.json").write_text(json.dumps(document))
    old = load_capture(path)
    new = load_capture(restore_capture(path, tmp_path / "sharp", transfer="linear"))
    for frame in old.frames:
        edges = frame.exposure_us, [frame.mid_us], old.contrast_threshold
        seen_events = old.events.between(*frame.exposure_us)
        (made,) = deblur(old.image(frame), seen_events, *edges, transfer="linear")
        assert (made - new.image(frame.name)).abs().max() < 2e-5
        assert (old.sharp(frame) - new.sharp(frame.name)).abs().max() < 2e-5
        assert read_image(new.frame(frame.name).mask).dtype == np.uint8
    for before, after in zip(old.novel_views, new.novel_views, strict=True):
        assert (old.novel_image(before) - new.novel_image(after)).abs().max() < 2e-5


@pytest.mark.parametrize("lens", [None, {"model": "opencv", "coefficients": [-0.1, 0, 0, 0]}])
def test_a_picture_that_several_entries_name_is_replaced_in_its_own_alone(
    lens: dict | None, tiny_capture: Factory, tmp_path: Path
) -> None:
    """Of sharp video the frame's picture may be its own truth; another may be named alike."""
    path = tiny_capture(width=64, height=48)
    document = json.loads((path / "capture.json").read_text())
    document["cameras"]["main"]["distortion"] = lens
    for frame in document["frames"]:
        frame["sharp"] = frame["image"]
    document["frames"][1] |= {"image": "images/0000.bmp", "mask": None}
    Image.open(path / "images/0001.png").save(path / "images/0000.bmp")
    (path / "capture.json").write_text(json.dumps(document))
    old, new = load_capture(path), load_capture(restore_capture(path, tmp_path / "out"))
    for frame in old.frames:
        assert (old.sharp(frame) - new.sharp(frame.name)).abs().max() < 0.003
        assert (_edi(old, frame) - new.image(frame.name)).abs().max() < 0.003
    named = {frame.image for frame in new.frames} | {frame.sharp for frame in new.frames}
    assert len(named) == 2 * len(new.frames)
    assert new.frames[1].mask is None and new.frames[2].mask is not None


def test_bad_input_leaves_nothing_behind(tiny_capture: Factory, tmp_path: Path) -> None:
    path, out = tiny_capture(), tmp_path / "out" / "sharp"
    with pytest.raises(ConfigError, match="nothing.*edi"):
        restore_capture(path, out, method="nothing")
    for wrong in (0.0, float("nan"), float("inf")):
        with pytest.raises(ConfigError, match="above 0"):
            restore_capture(path, out, contrast_threshold=(0.2, wrong))
    with pytest.raises(DataError, match="already exists"):
        restore_capture(path, path)
    Image.new("RGB", (5, 5)).save(path / "images" / "0004.png")
    with pytest.raises(DataError, match="0004"):
        restore_capture(path, out)
    assert not out.parent.exists() or list(out.parent.iterdir()) == []


def test_edi_says_what_it_lacks(tiny_capture: Factory, tmp_path: Path) -> None:
    path = tiny_capture()
    _edit(path)
    with pytest.raises(DataError, match="no events.*edi"):
        restore_capture(path, tmp_path / "sharp")
    blind = tiny_capture("blind")
    with h5py.File(blind / "events.h5", "r+") as file:
        file["events/p"][:] = 0
    with pytest.raises(DataError, match="no event has a polarity.*edi"):
        restore_capture(blind, tmp_path / "sharp")
    small = tiny_capture("small", frames=2)
    _edit(small, contrast_threshold=None)
    with pytest.raises(DataError, match="--contrast-threshold"):
        restore_capture(small, tmp_path / "sharp")


def test_a_restorer_that_fails_midway_leaves_nothing(
    tiny_capture: Factory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Broken:
        name = "broken"

        def __init__(self, capture):
            self.capture = capture

        def restore(self, capture, frames):
            yield frames[0], capture.image(frames[0])
            raise KeyboardInterrupt

        def provenance(self):
            return {}

    monkeypatch.setitem(RESTORERS, "broken", Broken)
    target = tmp_path / "out" / "sharp"
    with pytest.raises(KeyboardInterrupt):
        restore_capture(tiny_capture(), target, method="broken")
    assert not target.parent.exists()


def test_edi_is_nearer_to_the_truth_than_the_blurry_frame(demo_capture_path: Path) -> None:
    """Long exposures, limbs lost in the blur: 5.9 dB on average over all frames."""
    capture = load_capture(demo_capture_path)
    training = seen(capture)
    restored = RESTORERS["edi"](training).restore(training, training.train_frames[:6])
    gains = [
        _psnr(picture, capture.sharp(frame)) - _psnr(capture.image(frame), capture.sharp(frame))
        for frame, picture in restored
    ]
    assert np.mean(gains) > 4 and min(gains) > 2


def test_held_out_frames_come_from_everything_and_training_frames_do_not(
    tiny_capture: Factory, tmp_path: Path
) -> None:
    path = tiny_capture(frames=20, width=96, height=72)
    restored = load_capture(restore_capture(path, tmp_path / "sharp"))
    assert restored.provenance["restored"]["policy"] == asdict(Policy())
    assert [f.exposure_us[1] - f.exposure_us[0] for f in restored.frames] == [1] * 20
    everything = restore_capture(path, tmp_path / "all", policy=Policy(use="everything"))
    # EDI looks at a frame's own exposure alone: with stated thresholds both are the same
    for frame in restored.frames:
        assert torch.equal(restored.image(frame), load_capture(everything).image(frame.name))
