"""Method `evsplat` put together: where its contrast thresholds come from."""

import json

import h5py
import numpy as np
import pytest

from evsplat.calibration import ClockEstimate, SensorEstimate, ThresholdEstimate
from evsplat.capture import TrainingCapture, load_capture
from evsplat.methods import TRAINABLE, method_config
from evsplat.methods import evsplat as method
from evsplat.objectives import EventChange, EventWindows
from evsplat.training import train

from ..seen import seen

SMALL = {
    "human": {"count": 60},
    "deform": {"width": 16, "colour_width": 16},
    "scene": {"prefit_steps": 1},
    "skinning_prefit_steps": 1,
}


def thresholds(path, *, fit: bool = True) -> list[float]:
    config = method_config("evsplat", SMALL, where="test")
    composition = TRAINABLE["evsplat"].build(config, seen(path), 0, fit=fit)
    return composition.model.sensor.logs.exp().tolist()


def lag(late_us: float) -> ClockEstimate:
    return ClockEstimate(late_us, 1_000.0, 0.9, np.zeros(1), np.zeros(1))


@pytest.mark.parametrize(
    ("choice", "late_us", "start_us"),
    [
        ("auto", 7_000.0, 7_000.0),
        ("auto", -7_000.0, -7_000.0),
        ("auto", 3_500.0, None),
        ("always", 3_500.0, 0.0),
        ("always", None, 0.0),
        ("never", 7_000.0, None),
    ],
)
def test_a_clock_that_is_late_is_learned_from_there(
    tiny_capture, monkeypatch, choice, late_us, start_us
):
    found = None if late_us is None else SensorEstimate(lag(late_us), None)
    monkeypatch.setattr(method, "estimate_sensor", lambda capture: found)
    config = method_config("evsplat", SMALL | {"windows": {"clock": choice}}, where="test")
    sensor = TRAINABLE["evsplat"].build(config, seen(tiny_capture()), 0).model.sensor
    if start_us is None:
        assert sensor.offset_us is None
    else:
        assert float(sensor.offset_us) == pytest.approx(start_us)


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

    def estimate(capture):
        looked_at.append(capture)
        return SensorEstimate(lag(0.0), ThresholdEstimate(0.31, 0.17, 0.1, 500))

    monkeypatch.setattr(method, "estimate_sensor", estimate)
    assert thresholds(path) == pytest.approx((0.31, 0.17), rel=1e-6)
    assert isinstance(looked_at[0], TrainingCapture)  # what is held out stays unseen
    looked_at.clear()
    thresholds(path, fit=False)
    assert not looked_at  # a loaded model brings its own


def test_what_cannot_be_told_is_said(tiny_capture, monkeypatch, caplog):
    path = tiny_capture()
    forget(path)
    monkeypatch.setattr(method, "estimate_sensor", lambda capture: None)
    assert thresholds(path) == pytest.approx((0.2, 0.2), rel=1e-6)
    assert "contrast thresholds are neither given nor to be found" in caplog.text


@pytest.mark.parametrize("missing", ["events", "polarity"])
def test_it_trains_on_what_is_there_and_says_so(tiny_capture, tmp_path, caplog, missing):
    path = tiny_capture()
    metadata = json.loads((path / "capture.json").read_text())
    if missing == "polarity":
        with h5py.File(path / metadata["events"]["file"], "r+") as file:
            file["events/p"][:] = 0
    else:
        metadata["events"] = None
        (path / "capture.json").write_text(json.dumps(metadata))
    overrides = ("human.count=60", "scene.prefit_steps=1", "deform.width=16")
    run = train(path, method="evsplat", out=tmp_path / "run", iterations=4, overrides=overrides)
    lines = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    assert ("event" in lines[-1]["terms"]) == (missing == "polarity")
    said = {"events": "has no events", "polarity": "events have no polarity"}[missing]
    assert said in caplog.text


@pytest.mark.parametrize("term", ["windows", "paper"])
def test_the_event_term_is_chosen(tiny_capture, term):
    config = method_config("evsplat", {**SMALL, "event_term": term}, where="test")
    objectives = method.compose(config, seen(tiny_capture()), 0).objectives
    assert any(isinstance(one, EventWindows) for one in objectives) == (term == "windows")
    assert any(isinstance(one, EventChange) for one in objectives) == (term == "paper")


@pytest.mark.parametrize("seed", range(3))
def test_the_papers_term_takes_events_without_polarity(tiny_capture, seed):
    """Where all pixels only brighten, sizes and signed changes say the same."""
    path = tiny_capture(seed=seed)
    with h5py.File(path / "events.h5", "r+") as file:
        file["events/p"][:] = 1
    signed = method.paper_events(method.EventConfig(), load_capture(path))
    pair = next(iter(signed.weights))
    changed = signed._map(*pair)
    signed.events.close()
    with h5py.File(path / "events.h5", "r+") as file:
        file["events/p"][:] = 0
    blind = method.paper_events(method.EventConfig(), load_capture(path))
    assert changed.any() and (changed == blind._map(*pair)).all()
    assert signed.weights == blind.weights
