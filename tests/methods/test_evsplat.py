"""Method `evsplat` put together: where its contrast thresholds come from."""

import json
import logging

import h5py
import numpy as np
import pytest

from evsplat.calibration import ClockEstimate, SensorEstimate, ThresholdEstimate
from evsplat.capture import TrainingCapture, load_capture
from evsplat.methods import Purpose, sensor
from evsplat.methods.evsplat import CLOSED_SURFACE
from evsplat.methods.evsplat_settings import EvsplatConfig
from evsplat.methods.starts import MOST_SAMPLES
from evsplat.objectives import EventChange, EventWindows
from evsplat.training import load_run, train

from ..conftest import write_event_file
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
    tiny_capture, monkeypatch, choice, late_us, start_us
):
    found = None if late_us is None else SensorEstimate(lag(late_us), None)
    monkeypatch.setattr(sensor, "estimate_sensor", lambda capture: found)
    learned = built("evsplat", tiny_capture(), f"clock={choice}", purpose="train").model.sensor
    if start_us is None:
        assert learned.offset_us is None
    else:
        assert float(learned.offset_us) == pytest.approx(start_us)


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
