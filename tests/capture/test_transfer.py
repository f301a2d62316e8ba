"""Frames that hold light as the camera measured it: the same recording, coded or not."""

import functools
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from evsplat.capture import Capture, Policy, estimate_sensor, load_capture
from evsplat.capture.sensor_estimate import SensorEstimate, contrast_findings
from evsplat.objectives.base import Step
from evsplat.objectives.exposure import Exposure
from evsplat.pictures import decode, encode
from evsplat.pictures.files import write_image
from evsplat.restore import restore_capture

from .editing import edit


def say(path: Path, transfer: str) -> Capture:
    edit(path, lambda document: document["cameras"]["main"].update(transfer=transfer))
    return load_capture(path)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory, demo_capture_path) -> dict[str, Capture]:
    """The demo's first frames, coded, and as linear light in 16 bit."""
    root = tmp_path_factory.mktemp("transfer")
    made = {}
    for kind in ("power", "linear"):
        path = Path(shutil.copytree(demo_capture_path, root / kind))
        edit(path, lambda d: d.update(frames=d["frames"][:14], novel_views=[]))
        capture = load_capture(path)
        for frame in capture.frames if kind == "linear" else ():
            light = decode(capture.image(frame)).numpy()
            target = frame.image.with_suffix(".png")
            write_image(target, np.round(light * 65_535).astype(np.uint16))
            entry = f"images/{target.name}"
            edit(path, lambda d, i=frame.index, e=entry: d["frames"][i].update(image=e))
        made[kind] = say(path, kind)
    return made


@functools.cache  # a capture is equal to itself alone
def estimated(capture: Capture) -> tuple[Capture, SensorEstimate | None]:
    return capture, estimate_sensor(capture.for_training(Policy(use="everything")))


def thresholds(capture: Capture) -> np.ndarray:
    _, estimate = estimated(capture)
    assert estimate is not None and estimate.thresholds is not None
    return np.array([estimate.thresholds.plus, estimate.thresholds.minus])


def test_fitted_thresholds_do_not_depend_on_how_frames_are_coded(recordings):
    coded, linear = (thresholds(recordings[kind]) for kind in ("power", "linear"))
    # the sensor's own is 0.2; dark pixels below 2 % of the range, which are read least finely, are
    # others where the range is one of light
    assert linear == pytest.approx(coded, rel=0.12)
    assert linear == pytest.approx(0.2, abs=0.02) and coded == pytest.approx(0.2, abs=0.02)
    assert contrast_findings(*estimated(recordings["linear"])) == []


def test_linear_frames_that_are_taken_as_coded_are_noticed(recordings, tmp_path):
    path = Path(shutil.copytree(recordings["linear"].path, tmp_path / "unsaid"))
    edit(path, lambda document: document["cameras"]["main"].pop("transfer"))
    unsaid = load_capture(path)
    # the power curve on top of light multiplies every change of its logarithm
    assert thresholds(unsaid) == pytest.approx(2.2 * thresholds(recordings["linear"]), rel=0.05)
    capture, estimate = estimated(unsaid)
    scale = 0.7 / estimate.thresholds.plus
    fitted = replace(estimate.thresholds, plus=0.7, minus=scale * estimate.thresholds.minus)
    strong = replace(estimate, thresholds=fitted)
    (finding,) = contrast_findings(capture, strong)
    assert finding.field == "cameras.main.transfer" and "frames look linear" in finding.found
    (finding,) = contrast_findings(recordings["linear"], strong)
    assert finding.field == "events.contrast_threshold"  # of light, such thresholds contradict


def test_deblurred_pictures_show_the_same_light(recordings, tmp_path):
    sharp = {}
    for kind, capture in recordings.items():
        made = restore_capture(capture.path, tmp_path / kind, method="edi")
        restored = load_capture(made)
        assert restored.transfer("0003") == kind
        assert restored.provenance["restored"]["transfer"] == kind
        sharp[kind] = restored.image("0003")
    # 8 bit hold dark light less finely
    light = encode(sharp["linear"])
    bright = sharp["power"] > 0.3
    assert float((light - sharp["power"])[bright].abs().mean()) < 0.006


@pytest.mark.parametrize("transfer", ["power", "srgb", "linear"])
def test_an_exposure_is_a_mean_of_light(tiny_capture, transfer):
    capture = say(tiny_capture(), transfer).for_training(Policy())
    frame = capture.train_frames[0]
    rng = torch.Generator().manual_seed(0)
    pictures = [torch.rand((24, 32, 3), generator=rng).requires_grad_() for _ in range(3)]
    light = torch.stack([decode(picture, transfer) for picture in pictures])
    blurry = encode(light.mean(0), transfer).detach()
    step = Step(
        capture,
        None,
        frame,
        (frame.exposure_us[0], frame.mid_us, frame.exposure_us[1] - 1),
        SimpleNamespace(rgb=tuple(pictures)),
        0.0,
        rng,
        SimpleNamespace(get=lambda *_: blurry),
    )
    losses = Exposure(capture, {}, rng).loss(step)
    assert losses["l1"].item() < 1e-6 and losses["dssim"].item() < 1e-5
    gradient = torch.autograd.grad(losses["l1"], pictures, allow_unused=True)
    assert all(torch.isfinite(one).all() for one in gradient)
