"""What the controls make of the playback."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("viser", reason="needs the extra view: pip install 'evsplat[view]'")

from evsplat.capture import load_capture  # noqa: E402
from evsplat.view.camera import BrowserCamera  # noqa: E402
from evsplat.view.compositor import Compositor  # noqa: E402
from evsplat.view.panel import _EXPOSURE, Panel  # noqa: E402
from evsplat.view.request import Motion, Playback, ViewRequest  # noqa: E402


class _Client:
    """A browser's state without a browser, at second 0."""

    def __init__(self, playback: Playback) -> None:
        self.playback = playback

    @property
    def current(self) -> SimpleNamespace:
        return SimpleNamespace(time_us=round(self.playback.at(0.0)))

    def change_motion(self, **fields) -> None:
        pass

    def change_playback(self, change) -> Playback:
        self.playback = change(self.playback, 0.0)
        return self.playback


def test_back_from_another_motion_the_chosen_loop_goes_on(tiny_capture):
    frames = load_capture(tiny_capture()).frames
    first, last = frames[0].mid_us, frames[-1].mid_us
    panel = object.__new__(Panel)
    panel.client = _Client(Playback(0, 2_000_000, 1_000_000))
    panel.loop = SimpleNamespace(value=_EXPOSURE, visible=False)
    panel.steps, panel.slider = SimpleNamespace(visible=False), SimpleNamespace(max=2_000.0)
    panel._frames, panel._recording_us, panel._motion = frames, (first, last), "kick"
    panel._show_motion(None)
    playback = panel.client.playback
    assert (playback.start_us, playback.end_us) == frames[0].exposure_us
    assert panel.loop.visible and panel.steps.visible


@pytest.mark.parametrize("motion", [None, "walk"])
def test_the_browser_goes_where_the_recording_camera_is_drawn_from(tiny_capture, motion):
    """A moving one; of another motion, which has times of its own, it stands where it was first."""
    path = tiny_capture()
    document = json.loads((path / "capture.json").read_text())
    for number, frame in enumerate(document["frames"]):
        pose = np.array(document["cameras"]["main"]["world_to_camera"])
        pose[0, 3] += 0.1 * number
        frame["world_to_camera"] = pose.tolist()
    (path / "capture.json").write_text(json.dumps(document))
    capture = load_capture(path)
    compositor = Compositor(SimpleNamespace(capture=capture), {})
    browser = BrowserCamera((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.8)
    time_us = capture.frames[6].mid_us
    request = ViewRequest(64, 48, browser, time_us, "main", motion=Motion(motion))
    went = []
    panel = object.__new__(Panel)
    panel.client = SimpleNamespace(
        current=request, compositor=compositor, look_through=lambda *args: went.append(args)
    )
    panel.capture, panel.pivot = capture, np.zeros(3)
    panel.look_through("main")
    drawn = compositor.camera(request)
    assert went[0][1].position == pytest.approx(drawn.center().tolist(), abs=1e-6)
    assert (drawn.center() - capture.camera(capture.frames[0]).center()).norm() < 1e-6 or not motion
