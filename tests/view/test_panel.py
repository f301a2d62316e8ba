"""What the controls make of the playback."""

from types import SimpleNamespace

import pytest

pytest.importorskip("viser", reason="needs the extra view: pip install 'evsplat[view]'")

from evsplat.capture import load_capture  # noqa: E402
from evsplat.view.panel import _EXPOSURE, Panel  # noqa: E402
from evsplat.view.request import Playback  # noqa: E402


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
