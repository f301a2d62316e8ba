"""Sections of the report by themselves: what differs, how fast, how much of a long recording."""

from types import SimpleNamespace

import numpy as np
import pytest

from evsplat.capture import load_body_track, load_capture
from evsplat.config import to_dict
from evsplat.devices import hardware
from evsplat.evaluation.report.charts import Series
from evsplat.evaluation.report.configuration import _changed, configuration, made_with
from evsplat.evaluation.report.frames import _chosen_entries, _speeds
from evsplat.evaluation.report.page import _running_mean
from evsplat.methods import TRAINABLE, method_config


@pytest.mark.parametrize("method", sorted(TRAINABLE))
def test_only_settings_that_differ_from_the_defaults_are_told(method):
    config = {"method": method, **to_dict(method_config(method, {}, where="test"))}
    assert _changed(config) == []
    section = next(key for key, value in config.items() if isinstance(value, dict) and value)
    name = next(iter(config[section]))
    config[section][name] = 0.4321
    ((key, value, default),) = _changed(config)
    assert (key, value) == (f"{section}.{name}", 0.4321)
    assert default != value
    page = configuration(SimpleNamespace(config=config))
    assert page.count("0.4321") == 2
    assert _changed({"method": "of tomorrow", "a": 1}) is None


def test_the_machine_and_the_time_are_told_but_not_where_the_capture_lay():
    versions = {
        "capture": "/home/someone/secret",
        "seed": 5,
        **hardware(),
        "packages": {"torch": "2.13"},
    }
    metrics = {"train_seconds": 200.0, "iteration": 400, "evaluate_seconds": 61.0}
    page = made_with(SimpleNamespace(versions=versions, metrics=metrics))
    for told in ("3 min 20 s", "500 ms", "1 min 01 s", "cpu_cores", "2.13"):
        assert told in page
    assert "secret" not in page


def test_speed_is_the_longest_path_of_a_vertex_in_an_exposure(tiny_capture):
    capture = load_capture(tiny_capture())
    source = SimpleNamespace(capture=capture, metrics={"per_frame": []})
    speeds = _speeds(source)
    assert set(speeds) == {frame.name for frame in capture.frames}
    track = load_body_track(capture)
    for frame in capture.frames:
        ends = [
            capture.camera(frame).project(track.vertices(time))[0].numpy()
            for time in frame.exposure_us
        ]
        longest = np.linalg.norm(ends[1] - ends[0], axis=1).max()
        # A part of the vertices is looked at.
        assert 0.3 * longest <= speeds[frame.name] <= longest + 1e-4


@pytest.mark.parametrize("count", [1, 3, 9, 500])
def test_a_long_recording_shows_the_hardest_frame_and_an_even_choice_of_others(count):
    rng = np.random.default_rng(count)
    values = rng.permutation(count).astype(float)
    unknown = {"psnr": None}
    entries = [
        {
            "frame": i,
            "others": {
                "blurry_input": {
                    "person_mask": unknown,
                    "person_crop": {"psnr": value},
                    "full": unknown,
                }
            },
        }
        for i, value in enumerate(values)
    ]
    shown = [entry["frame"] for entry in _chosen_entries(entries, 30)]
    assert shown[0] == int(values.argmin())
    assert len(set(shown)) == len(shown) <= max(30, 3)
    assert len(shown) >= min(count, 29)
    if count > 30:
        assert np.diff(sorted(shown)).max() < 3 * count / 30


def test_the_curve_of_training_pictures_is_a_running_mean() -> None:
    steps, psnr = np.arange(40) * 10, 30 + np.arange(40) * 0.1
    zigzag = psnr + np.where(np.arange(40) % 2, 4.0, -4.0)
    smooth = _running_mean(Series("psnr", steps.tolist(), zigzag.tolist()))
    # an even count of neighbours: the zig-zag cancels, a straight line stays one
    assert np.allclose(smooth.x, np.arange(31) * 10 + 45)
    assert np.allclose(smooth.y, 30 + np.asarray(smooth.x) / 10 * 0.1)
    assert _running_mean(Series("psnr", [3.0], [30.0])).y == [30.0]
    assert list(_running_mean(Series("psnr", [], [])).y) == []
