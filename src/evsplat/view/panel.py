"""The controls that a browser shows."""

import functools
import time
from itertools import groupby

import numpy as np
import viser

from evsplat.capture import Frame
from evsplat.film import Look
from evsplat.film.looks import Shown
from evsplat.film.plan import recorded_by
from evsplat.methods.reconstruction import Parts
from evsplat.methods.trivial import nearest_in_time
from evsplat.staging.assets import motions
from evsplat.view.camera import BrowserCamera, forward, letterboxed, vertical_fov
from evsplat.view.client import Client
from evsplat.view.compositor import comparisons
from evsplat.view.controls import when_changed
from evsplat.view.request import Playback
from evsplat.view.save_panel import SavePanel

SPEEDS = {"as recorded": 1.0, **{f"1/{slower}": 1 / slower for slower in (2, 5, 10, 20, 50, 100)}}
_PARTS: dict[str, Parts] = {"person and scene": "all", "person": "human", "scene": "scene"}
_SHOWN: dict[str, Shown] = {
    "colour": "rgb",
    "person / scene": "semantic",
    "depth": "depth",
    "certainty": "certainty",
}
_WHOLE, _EXPOSURE = "the recording", "this exposure"
_NOTHING = "nothing"
_RECORDED = "as recorded"
_UPRIGHT = 0.75
"""Width by height of a window up to which it is a phone's, held upright."""
_SLIDER_S = 0.1
"""The time slider follows the picture this often."""


class Panel:
    """Builds the controls of one browser and connects them with its client.

    Callbacks are coroutines, which the event loop runs in order; each only changes the request.
    """

    def __init__(self, client: Client, pivot: np.ndarray) -> None:
        """``pivot`` is the place in the world around which the view turns."""
        self.client, self.pivot = client, pivot
        self.capture = client.compositor.capture
        self.gui = client.handle.gui
        self._slider_moved_s = 0.0
        self._status = ""
        self._frames = recorded_by(self.capture, None)
        self._recording_us = self._frames[0].mid_us, self._frames[-1].mid_us
        self._start_us, self._end_us = self._recording_us
        self._motion: str | None = None
        camera = client.handle.camera
        # On a phone held upright the panel lies over the picture: opened it hides the person.
        open_at_first = camera.image_width > _UPRIGHT * camera.image_height
        with self.gui.add_folder("Time", expand_by_default=open_at_first):
            self._build_time()
        with self.gui.add_folder("Camera", expand_by_default=open_at_first):
            self._build_camera()
        with self.gui.add_folder("Show", expand_by_default=open_at_first):
            self._build_show()
        with self.gui.add_folder("Motion and pose", expand_by_default=open_at_first):
            self._build_pose()
        with self.gui.add_folder("Save", expand_by_default=open_at_first):
            SavePanel(client)
        client.on_drawn = self._follow

    def _build_time(self) -> None:
        gui = self.gui
        length_ms = max((self._end_us - self._start_us) / 1e3, 0.1)
        self.slider = gui.add_slider("Time, ms", 0.0, length_ms, 0.1, 0.0)
        self.play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)
        self.steps = gui.add_button_group("Frame", ("previous", "next"))
        self.speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="1/5")
        self.loop = gui.add_dropdown("Loop", (_WHOLE, _EXPOSURE))
        self.status = gui.add_markdown("")

        async def moved(event: viser.GuiEvent) -> None:
            if event.client_id is not None:  # else the player moved it
                self._go(self._start_us + 1e3 * self.slider.value)

        async def pressed(_: viser.GuiEvent) -> None:
            playback = self.client.change_playback(lambda p, now: p.playing(p.since_s is None, now))
            self._show_playing(playback)

        async def stepped(event: viser.GuiEvent) -> None:
            now_us = self.client.current.time_us
            mids = [frame.mid_us for frame in self._frames]
            later, earlier = [m for m in mids if m > now_us], [m for m in mids if m < now_us]
            forwards = event.target.value == "next"
            self._show_playing(self.client.change_playback(lambda p, now: p.playing(False, now)))
            self._go(min(later, default=mids[-1]) if forwards else max(earlier, default=mids[0]))
            self._move_slider(self.client.current.time_us)

        async def faster(_: viser.GuiEvent) -> None:
            self.client.change_playback(lambda p, now: p.at_speed(SPEEDS[self.speed.value], now))

        async def looped(_: viser.GuiEvent) -> None:
            self._loop()

        when_changed(self.slider, moved)
        self.play.on_click(pressed)
        self.steps.on_click(stepped)
        when_changed(self.speed, faster)
        when_changed(self.loop, looped)

    def _build_camera(self) -> None:
        names = tuple(self.capture.cameras)
        self.camera = self.gui.add_dropdown("Recorded by", names, visible=len(names) > 1)
        snap = self.gui.add_button("See through the recording camera", icon=viser.Icon.CAMERA)
        self.gui.add_markdown("Drag to turn, right-drag to move, scroll to come nearer.")

        async def see(_: viser.GuiEvent) -> None:
            self.look_through(self.camera.value)

        when_changed(self.camera, see)
        snap.on_click(see)

    def _build_show(self) -> None:
        gui, client = self.gui, self.client
        parts = gui.add_dropdown("Parts", tuple(_PARTS))
        shown = gui.add_dropdown("Colours", tuple(_SHOWN))
        others = comparisons(self.capture, list(client.compositor.others))
        compare = gui.add_dropdown("Compare with", (_NOTHING, *others))
        layout = gui.add_dropdown("Layout", ("divided", "side by side"))
        divider = gui.add_slider("Divider", 0.0, 1.0, 0.005, client.current.divider)
        events = gui.add_checkbox("Events", False, visible=self.capture.events is not None)
        window = gui.add_slider("Event window, ms", 0.5, 50.0, 0.5, 5.0)

        async def changed(_: viser.GuiEvent) -> None:
            something = compare.value != _NOTHING
            layout.visible = something
            divider.visible = something and layout.value == "divided"
            window.visible = events.value
            client.change(
                look=Look(_SHOWN[shown.value], _PARTS[parts.value]),
                compare=compare.value if something else None,
                layout=layout.value,
                divider=divider.value,
                events_us=round(1e3 * window.value) if events.value else None,
            )

        layout.visible = divider.visible = window.visible = False
        for control in (parts, shown, compare, layout, divider, events, window):
            when_changed(control, changed)

    def _build_pose(self) -> None:
        """A choice of motions that ship, and sliders on top, per group of joints."""
        gui, client = self.gui, self.client
        names = {_RECORDED: None, **{name.replace("_", " "): name for name in motions()}}
        motion = gui.add_dropdown("Motion", tuple(names))
        sliders: list[viser.GuiSliderHandle[float]] = []

        async def turned(_: viser.GuiEvent) -> None:
            client.change_motion(angles=tuple(slider.value for slider in sliders))

        for group, members in groupby(client.compositor.viewed.sliders, lambda s: s.group):
            with gui.add_folder(group, expand_by_default=False):
                for member in members:
                    limit = float(member.limit)
                    slider = gui.add_slider(f"{member.label}, \u00b0", -limit, limit, 1.0, 0.0)
                    when_changed(slider, turned)
                    sliders.append(slider)
        reset = gui.add_button("Pose as in the motion", icon=viser.Icon.RESTORE)
        reset.visible = bool(sliders)

        async def chosen(_: viser.GuiEvent) -> None:
            client.scheduler.submit(functools.partial(self._show_motion, names[motion.value]))

        async def straightened(_: viser.GuiEvent) -> None:
            for slider in sliders:
                # viser's property has a setter, which type checkers do not see.
                slider.value = 0.0  # type: ignore[misc]

        when_changed(motion, chosen)
        reset.on_click(straightened)

    def look_through(self, camera: str) -> None:
        """Put the browser's camera where a recording camera is at this time."""
        request = self.client.current
        recording = self.client.compositor.recording(camera, request)
        view, _ = letterboxed(recording, request.width, request.height)
        centre, ahead = recording.center().double().numpy(), forward(recording)
        # The view turns around the place on the optical axis that is as far as the pivot.
        away = max(0.5, float((self.pivot - centre) @ ahead))
        wxyz, position = request.browser_camera.wxyz, tuple(centre.tolist())
        browser_camera = BrowserCamera(wxyz, position, vertical_fov(view))
        self.client.look_through(camera, browser_camera, centre + away * ahead)

    def _show_motion(self, name: str | None) -> None:
        """Let the time go through a motion of the package, or the recording (None).

        Called by the render thread, since reading a motion takes a while.
        """
        if name is None:
            self._start_us, self._end_us = self._recording_us
        else:
            times = self.client.compositor.viewed.track(name).times_us
            self._start_us, self._end_us = int(times[0]), int(times[-1])
        self._motion = name
        self.loop.visible = self.steps.visible = name is None
        self.slider.max = round((self._end_us - self._start_us) / 1e3, 1)
        self.client.change_motion(name=name)
        self.client.change_playback(
            lambda p, now: p.within(self._start_us, self._end_us, now).moved(self._start_us, now)
        )
        self._loop()

    def _go(self, time_us: float) -> None:
        self.client.change_playback(lambda p, now: p.moved(time_us, now))
        if self._motion is None and self.loop.value == _EXPOSURE:
            self._loop()

    def _loop(self) -> None:
        """Loop over what is chosen, around where the time stands."""
        if self.loop.value == _EXPOSURE and self._motion is None:
            frame = nearest_in_time(self._frames, self.client.current.time_us)
            start, end = frame.exposure_us
        else:
            start, end = self._start_us, self._end_us
        self.client.change_playback(lambda p, now: p.within(start, end, now))

    def _show_playing(self, playback: Playback) -> None:
        playing = playback.since_s is not None
        self.play.label = "Pause" if playing else "Play"
        self.play.icon = viser.Icon.PLAYER_PAUSE if playing else viser.Icon.PLAYER_PLAY

    def _follow(self, time_us: int) -> None:
        """Let the slider follow the picture; called by the render thread."""
        now = time.monotonic()
        if now - self._slider_moved_s < _SLIDER_S:
            return
        self._slider_moved_s = now
        self._move_slider(time_us)

    def _move_slider(self, time_us: int) -> None:
        time_ms = (time_us - self._start_us) / 1e3
        if abs(self.slider.value - time_ms) > 0.05:
            # viser's property has a setter, which type checkers do not see.
            self.slider.value = min(max(time_ms, 0.0), self.slider.max)  # type: ignore[misc]
        if self._motion is None:
            status = _frame_status(nearest_in_time(self._frames, time_us), time_us)
        else:
            status = f"Motion {plain(self._motion.replace('_', ' '))}, which was not recorded"
        if status != self._status:
            self.status.content = self._status = status


def plain(text: str) -> str:
    """Text as Markdown that shows it as it is: HTML in Markdown would run in the page."""
    return "".join(c if c.isalnum() or c == " " else f"&#{ord(c)};" for c in text)


def _frame_status(frame: Frame, time_us: int) -> str:
    """A frame's name and split, and how far into its exposure a time lies."""
    start, end = frame.exposure_us
    split = {"train": "training", "test": "held out"}[frame.split]
    if start <= time_us <= end:
        share = f"{100 * (time_us - start) / max(end - start, 1):.0f} % into its exposure"
    else:
        share = "between exposures"
    return f"Frame {plain(frame.name)} ({split}), {share} of {(end - start) / 1e3:.3g} ms"
