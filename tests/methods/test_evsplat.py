"""Method `evsplat` put together: where its contrast thresholds come from."""

import json
import logging

import h5py
import numpy as np
import pytest

from evsplat.calibration import (
    ClockEstimate,
    SensorEstimate,
    ThresholdEstimate,
    estimate_from_pairs,
)
from evsplat.capture import TrainingCapture, estimate_sensor, load_capture
from evsplat.capture.sensor_estimate import contrast_findings
from evsplat.methods import Purpose, sensor
from evsplat.methods.evsplat import CLOSED_SURFACE
from evsplat.methods.evsplat_settings import EvsplatConfig
from evsplat.methods.starts import MOST_SAMPLES
from evsplat.objectives import EventChange, EventWindows
from evsplat.training import load_run, train

from ..conftest import write_event_file
from ..seen import seen
from ..small_model import built, small


def thresholds(path, *, purpose: Purpose = "train") -> list[float]:
    return built("evsplat", path, purpose=purpose).model.sensor.logs.exp().tolist()


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
    tiny_capture, monkeypatch, caplog, choice, late_us, start_us
):
    caplog.set_level("INFO", "evsplat.methods.sensor")
    found = None if late_us is None else SensorEstimate(lag(late_us), None)
    monkeypatch.setattr(sensor, "estimate_sensor", lambda capture: found)
    learned = built("evsplat", tiny_capture(), f"clock={choice}", purpose="train").model.sensor
    if start_us is None:
        assert learned.offset_us is None
    else:
        assert float(learned.offset_us) == pytest.approx(start_us)
    said = [record.message for record in caplog.records if "clock is learned" in record.message]
    way = "lag" if start_us and start_us > 0 else "lead"
    told = f"events {way} the frames by 7.0 ms; the offset of their clock is learned"
    assert said == ([told] if start_us else [])


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

    monkeypatch.setattr(sensor, "estimate_sensor", estimate)
    assert thresholds(path) == pytest.approx((0.31, 0.17), rel=1e-6)
    assert isinstance(looked_at[0], TrainingCapture)  # what is held out stays unseen
    looked_at.clear()
    thresholds(path, purpose="resume")
    thresholds(path, purpose="draw")
    assert not looked_at  # a loaded model brings its own


def test_what_cannot_be_told_is_said(tiny_capture, monkeypatch, caplog):
    path = tiny_capture()
    forget(path)
    monkeypatch.setattr(sensor, "estimate_sensor", lambda capture: None)
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
    run = tmp_path / "run"
    with caplog.at_level(logging.INFO):
        train(path, method="evsplat", out=run, iterations=4, overrides=small("evsplat"))
    lines = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    assert ("event" in lines[-1]["terms"]) == (missing == "polarity")
    said = {"events": "has no events", "polarity": "events have no polarity"}[missing]
    assert said in caplog.text


@pytest.mark.parametrize("term", ["windows", "paper"])
def test_the_event_term_is_chosen(tiny_capture, term):
    objectives = built("evsplat", tiny_capture(), f"event_term={term}").objectives
    assert any(isinstance(one, EventWindows) for one in objectives) == (term == "windows")
    assert any(isinstance(one, EventChange) for one in objectives) == (term == "paper")


def test_as_many_discs_as_pixels_tell_apart(tiny_capture):
    """At half the distance four times as many, between what shapes a body and what is drawn."""
    path = tiny_capture()

    def count(spacing_px: float) -> int:
        settings = ("human.count=null", f"human.spacing_px={spacing_px}")
        return built("evsplat", path, *settings).model.gaussians.human_count

    assert CLOSED_SURFACE.fewest < count(0.4) < count(0.2) < MOST_SAMPLES
    assert count(0.2) == pytest.approx(4 * count(0.4), abs=4)
    assert count(40.0) == CLOSED_SURFACE.fewest and count(0.01) == MOST_SAMPLES


def test_the_person_grows_where_that_is_asked_for(tiny_capture, tmp_path):
    path, counts = tiny_capture(), {}
    most = {"by default": EvsplatConfig().densify.max_human, "asked for": 150}
    for name, largest in most.items():
        settings = small("evsplat", "densify.gradient=1e-12", f"densify.max_human={largest}")
        run = train(path, out=tmp_path / name, iterations=12, overrides=settings)
        counts[name] = load_run(run).reconstruction.model.gaussians.human_count
    assert counts["by default"] <= 120 < counts["asked for"] <= 150


@pytest.mark.parametrize("purpose", ["train", "resume"])
def test_a_sensor_that_lost_its_events_for_a_while_says_nothing_of_that_time(
    tiny_capture, purpose: Purpose
):
    path = tiny_capture(frames=12, width=64, height=48)
    assert event_windows(path, purpose).untold_us == ()
    with h5py.File(path / "events.h5") as file:
        t, *columns = (file[f"events/{key}"][:] for key in "txyp")
    kept = (t < 120_000) | (t > 220_000)
    write_event_file(path / "events.h5", t[kept], *(column[kept] for column in columns))
    ((start, end),) = event_windows(path, purpose).untold_us
    assert start == t[t < 120_000][-1] + 1 and end == t[t > 220_000][0]


def test_of_a_recorder_that_began_a_frame_late_nothing_is_asked_before(tiny_capture):
    path = tiny_capture(frames=12, width=96, height=72)
    assert event_windows(path, "train").untold_us == ()
    frames = load_capture(path).frames
    with h5py.File(path / "events.h5") as file:
        t, *columns = (file[f"events/{key}"][:] for key in "txyp")
    kept = t >= (frames[1].mid_us + frames[2].mid_us) // 2
    write_event_file(path / "events.h5", t[kept], *(column[kept] for column in columns))
    windows = event_windows(path, "train")
    ((start, end),) = windows.untold_us
    assert start < frames[0].mid_us and end == t[kept][0]
    assert windows.times(frames[0], 1e9) == windows.times(frames[1], 1e9) == ()
    assert min(windows.times(frames[2], 1e9)) >= end


def event_windows(path, purpose: Purpose) -> EventWindows:
    objectives = built("evsplat", path, purpose=purpose).objectives
    (windows,) = (each for each in objectives if isinstance(each, EventWindows))
    return windows


@pytest.mark.parametrize(
    ("found_us", "purpose"), [(None, "train"), (9_990, "train"), (9_990, "resume")]
)
def test_counts_are_averaged_over_the_period_of_lamps_that_flicker(
    tiny_capture, monkeypatch, found_us, purpose
):
    monkeypatch.setattr("evsplat.capture.training_capture.flicker_period_us", lambda *_: found_us)
    windows = event_windows(tiny_capture(), purpose)
    assert windows.flicker_us == (found_us or 0)
    # All of such a picture would count as noise.
    assert windows.noise.aware == (found_us is None)


def test_a_run_says_what_became_of_thresholds_that_nobody_gives(tiny_capture, tmp_path, caplog):
    """Estimated ones of a method that compares amounts, and only where they were found."""
    caplog.set_level(logging.INFO)
    signed, signless = (tiny_capture(name, frames=12, width=64, height=48) for name in "ab")
    with h5py.File(signless / "events.h5", "r+") as file:
        file["events/p"][:] = 0
    for path in (signed, signless):
        forget(path)
    said = {
        ("evsplat", signed): "contrast thresholds estimated from training frames",
        ("evsplat", signless): "contrast thresholds neither given nor found",
        ("paper", signless): "no contrast thresholds used",
        ("avatar3dgs_semantic", signless): "the method uses no events",
    }
    for (method, path), sentence in said.items():
        caplog.clear()
        out = tmp_path / method / path.name
        run = train(path, method=method, out=out, iterations=2, overrides=small(method))
        shown = load_run(run).policy.sentence(1)
        assert sentence in shown and sentence in caplog.text
        others = set(said.values()) - {sentence}
        assert not any(other in shown or other in caplog.text for other in others)


def test_given_thresholds_that_do_not_fit_are_told_where_amounts_are_compared(
    tiny_capture, tmp_path, caplog
):
    path, mirrored = (tiny_capture(name, frames=16, width=96, height=72) for name in "ab")
    given = load_capture(path).contrast_threshold

    def told(name: str, factor: float, *settings: str, method="evsplat", capture=path) -> list[str]:
        document = json.loads((capture / "capture.json").read_text())
        document["events"]["contrast_threshold"] = [factor * value for value in given]
        (capture / "capture.json").write_text(json.dumps(document))
        caplog.clear()
        overrides = small(method, *settings)
        train(capture, method=method, out=tmp_path / name, iterations=1, overrides=overrides)
        return [text for text in caplog.messages if "events.contrast_threshold" in text]

    assert told("as they are", 1.0) == []
    (sentence,) = told("too large", 2.8)
    (finding,) = contrast_findings(load_capture(path), estimate_sensor(seen(path)))
    assert sentence == str(finding)
    assert len(told("too small", 1 / 2.8, "clock=never")) == 1
    # Estimated anyway, cancelled, or not asked for.
    assert told("hidden", 2.8, "policy.thresholds=estimated") == []
    assert told("direction", 2.8, "event_term=paper") == []
    assert told("paper", 2.8, method="paper") == []
    assert told("none", 2.8, "event_weight=0") == []
    with h5py.File(mirrored / "events.h5") as file:
        t, x, y, p = (file[f"events/{key}"][:] for key in "txyp")
    write_event_file(mirrored / "events.h5", t, 95 - x, y, p)
    # What mirrored events fit is chance, and that they are mirrored is told.
    assert told("mirrored", 2.8, capture=mirrored) == []
    assert "mirrored left to right" in caplog.text


def test_the_sensor_is_estimated_once(tiny_capture, tmp_path, monkeypatch):
    calls = []

    def counted(*inputs):
        calls.append(inputs)
        return estimate_from_pairs(*inputs)

    monkeypatch.setattr("evsplat.capture.sensor_estimate.estimate_from_pairs", counted)
    train(tiny_capture(), out=tmp_path / "run", iterations=1, overrides=small("evsplat"))
    assert len(calls) == 1
