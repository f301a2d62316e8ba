"""Where events are silent: what that decides of the band around the body."""

import json

import numpy as np
import pytest
import torch

from evsplat.body import silhouette
from evsplat.calibration import NoiseEstimate
from evsplat.capture import load_body_track, load_capture
from evsplat.config import override
from evsplat.errors import ConfigError
from evsplat.events import EventStream
from evsplat.methods import compose, method_config
from evsplat.objectives import Activity, PackedBounds
from evsplat.objectives.activity import reached

from ..seen import seen


def test_only_what_is_joined_to_the_start_is_reached():
    passable = np.ones((7, 9), dtype=bool)
    passable[2:5, 2:7] = False
    passable[3, 3:6] = True  # silent within an active ring
    start = np.zeros_like(passable)
    start[0] = True
    found = reached(start, passable)
    assert not found[3, 3:6].any()
    assert found[passable & ~np.pad(np.ones((3, 5), dtype=bool), ((2, 2), (2, 2)))].all()
    assert not reached(np.zeros_like(start), passable).any()


@pytest.mark.parametrize("seed", range(3))
def test_noise_passes_for_activity_no_oftener_than_allowed(tiny_capture, seed):
    capture = load_capture(tiny_capture())
    frame = capture.train_frames[0]
    seconds = (frame.exposure_us[1] - frame.exposure_us[0]) * 1e-6
    rng = np.random.default_rng(seed)
    for expected_per_pixel in (0.001, 0.05, 0.5):
        rate_hz = expected_per_pixel / seconds
        noise = NoiseEstimate(rate_hz, 0.5, np.array([[3, 3]]))
        activity = Activity(capture, _Uniform(rng, 90, 120, expected_per_pixel), noise)
        active = activity.active(frame)
        assert active.mean() < 0.015
        # A pixel that many events come from is not noise, unless it is a hot one.
        activity.events.more = [(60, 40)] * 12 + [(3, 3)] * 50
        assert activity.active(frame)[39:42, 59:62].all()
        assert not activity.active(frame)[2:5, 2:5].any() or active[2:5, 2:5].any()


class _Uniform:
    """Events everywhere alike."""

    def __init__(self, rng, height: int, width: int, per_pixel: float) -> None:
        self.height, self.width = height, width
        self.places = np.stack(np.nonzero(np.ones((height, width))), -1)[:, ::-1]
        counts = rng.poisson(per_pixel, len(self.places))
        self.places = self.places.repeat(counts, 0)
        self.more: list[tuple[int, int]] = []

    def between(self, start: int, end: int):
        places = np.concatenate([self.places, np.array(self.more).reshape(-1, 2)]).astype(np.uint16)
        count = len(places)
        times = np.sort(np.linspace(start, end - 1, count).astype(np.int64))
        return EventStream(times, places[:, 0], places[:, 1], np.ones(count, dtype=np.int8))


def test_no_events_to_tell_are_an_error_that_names_the_setting(tiny_capture):
    path = tiny_capture()
    metadata = json.loads((path / "capture.json").read_text())
    metadata["events"] = None
    (path / "capture.json").write_text(json.dumps(metadata))
    given = override({}, ("semantic_activity=true", "human.count=50", "event.weight=0"))
    config = method_config("paper", given, where="test")
    with pytest.raises(ConfigError, match="no events.*semantic_activity=false"):
        compose(config, seen(path), 0, fit=False)


@pytest.mark.parametrize("name", ["man_dance_hard_256", "worker_punch_256"])
def test_silent_pixels_of_the_band_are_the_scene(name, captures_root):
    capture = load_capture(captures_root / name)
    track, activity = load_body_track(capture), Activity.of(capture)
    decided = wrong = scene = closer = 0
    for frame in capture.train_frames[::8]:
        camera = capture.camera(frame)
        body = silhouette(track.vertices(frame.mid_us), track.body.faces, camera).numpy()
        person = capture.mask(frame).numpy() > 0.5
        still = activity.still_scene(frame, track, body, 9)
        inside, outside = PackedBounds.of(body, 9).masks().numpy()
        band = ~(inside | outside)
        assert not (still & inside).any()
        decided += (still & band).sum()
        wrong += (still & band & person).sum()
        scene += (band & ~person).sum()
        known = PackedBounds.of(body, 9, still).masks()[1]
        closer += int((known & ~torch.from_numpy(outside)).sum())
    assert closer == decided
    assert wrong < 0.005 * decided
    assert decided > 0.1 * scene
