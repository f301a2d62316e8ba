"""Method `evsplat` put together: where its contrast thresholds come from."""

import json

import pytest

from evsplat.calibration import SensorEstimate, ThresholdEstimate
from evsplat.capture import load_capture
from evsplat.methods import TRAINABLE, method_config
from evsplat.methods import evsplat as method

SMALL = {
    "human": {"count": 60},
    "deform": {"width": 16, "colour_width": 16},
    "scene": {"prefit_steps": 1},
    "skinning_prefit_steps": 1,
}


def thresholds(path, *, fit: bool = True) -> list[float]:
    config = method_config("evsplat", SMALL, where="test")
    composition = TRAINABLE["evsplat"][1](config, load_capture(path), 0, fit=fit)
    return composition.model.sensor.logs.exp().tolist()


def forget(path) -> None:
    metadata = json.loads((path / "capture.json").read_text())
    metadata["events"]["contrast_threshold"] = None
    (path / "capture.json").write_text(json.dumps(metadata))


def test_a_stated_threshold_is_taken(tiny_capture):
    path = tiny_capture()
    stated = load_capture(path).contrast_threshold
    assert thresholds(path) == pytest.approx(stated, rel=1e-6)


def test_without_one_training_frames_and_events_tell_it(tiny_capture, monkeypatch):
    path = tiny_capture()
    forget(path)
    looked_at = []

    def estimate(capture, *, frames):
        looked_at.extend(frame.split for frame in frames)
        return SensorEstimate(None, ThresholdEstimate(0.31, 0.17, 0.1, 500))

    monkeypatch.setattr(method, "estimate_from_capture", estimate)
    assert thresholds(path) == pytest.approx((0.31, 0.17), rel=1e-6)
    assert set(looked_at) == {"train"}  # held-out pictures stay unseen
    looked_at.clear()
    thresholds(path, fit=False)
    assert not looked_at  # a loaded model brings its own


def test_what_cannot_be_told_is_said(tiny_capture, monkeypatch, caplog):
    path = tiny_capture()
    forget(path)
    monkeypatch.setattr(method, "estimate_from_capture", lambda capture, *, frames: None)
    assert thresholds(path) == pytest.approx((0.2, 0.2), rel=1e-6)
    assert "contrast thresholds are neither given nor to be found" in caplog.text
