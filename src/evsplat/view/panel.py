"""The controls that a browser shows."""

import time

import numpy as np
import viser

from evsplat.capture import Frame
from evsplat.film import Look, camera_at
from evsplat.film.looks import Shown
from evsplat.methods.reconstruction import Parts
from evsplat.view.camera import Orbit, forward, framed, vertical_fov
from evsplat.view.client import Client
from evsplat.view.painter import comparisons
from evsplat.view.pose_panel import PosePanel
from evsplat.view.request import ViewRequest
from evsplat.view.save_panel import SavePanel
from evsplat.view.timeline import Playback

SPEEDS = {
    "as recorded": 1.0,
    "1/2": 1 / 2,
    "1/5": 1 / 5,
    "1/10": 1 / 10,
    "1/20": 1 / 20,
    "1/50": 1 / 50,
    "1/100": 1 / 100,
}
_PARTS: dict[str, Parts] = {"person and scene": "all", "person": "human", "scene": "scene"}
_SHOWN: dict[str, Shown] = {"colour": "rgb", "person / scene": "semantic", "depth": "depth"}
_WHOLE, _EXPOSURE = "the recording", "this exposure"
_NOTHING = "nothing"
_SLIDER_S = 0.1
"""The time slider follows the picture this often."""


class Panel:
    """Builds the controls of one browser and connects them with its client.

    Callbacks are coroutines, which the event loop runs in order; each only writes a request down.
    """

    def __init__(self, client: Client, pivot: np.ndarray) -> None:
        """``pivot`` is the place in the world around which the view turns."""
        self.client, self.pivot = client, pivot
        self.capture = client.painter.capture
        self.gui = client.handle.gui
        self._slider_at = 0.0
        self._said = ""
        self._frames = sorted(self.capture.frames, key=lambda frame: frame.mid_us)
        self._frames = [f for f in self._frames if f.camera == self._frames[0].camera]
        self._recording_us = self._frames[0].mid_us, self._frames[-1].mid_us
        self._start_us, self._end_us = self._recording_us
        self._motion: str | None = None
        with self.gui.add_folder("Time"):
            self._build_time()
        with self.gui.add_folder("Camera"):
            self._build_camera()
        with self.gui.add_folder("Show"):
            self._build_show()
        if client.painter.subject.is_posable:
            with self.gui.add_folder("Motion and pose"):
                PosePanel(client, self.show_motion)
        with self.gui.add_folder("Save"):
            SavePanel(client, self.instant_name)
        client.on_time = self._follow

    def _build_time(self) -> None:
        gui = self.gui
        length_ms = max((self._end_us - self._start_us) / 1e3, 0.1)
        self.slider = gui.add_slider("Time, ms", 0.0, length_ms, 0.1, 0.0)
        self.play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)
        self.steps = gui.add_button_group("Frame", ("previous", "next"))
        self.speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="1/5")
        self.loop = gui.add_dropdown("Loop", (_WHOLE, _EXPOSURE))
        self.told = gui.add_markdown("")

        async def moved(event: viser.GuiEvent) -> None:
            if event.client_id is not None:  # else the player moved it
                self._go(self._start_us + 1e3 * self.slider.value)

        async def pressed(_: viser.GuiEvent) -> None:
            playback = self.client.play(lambda p, now: p.playing(p.since is None, now))
            self._show_playing(playback)

        async def stepped(event: viser.GuiEvent) -> None:
            place = self.client.standing.time_us
            mids = [frame.mid_us for frame in self._frames]
            later, earlier = [m for m in mids if m > place], [m for m in mids if m < place]
            forwards = event.target.value == "next"
            self._show_playing(self.client.play(lambda p, now: p.playing(False, now)))
            self._go(min(later, default=mids[-1]) if forwards else max(earlier, default=mids[0]))
            self._move_slider(self.client.standing.time_us)

        async def faster(_: viser.GuiEvent) -> None:
            self.client.play(lambda p, now: p.at_speed(SPEEDS[self.speed.value], now))

        async def looped(_: viser.GuiEvent) -> None:
            self._loop()

        self.slider.on_update(moved)
        self.play.on_click(pressed)
        self.steps.on_click(stepped)
        self.speed.on_update(faster)
        self.loop.on_update(looped)

    def _build_camera(self) -> None:
        names = tuple(self.capture.cameras)
        self.camera = self.gui.add_dropdown("Recorded by", names, visible=len(names) > 1)
        snap = self.gui.add_button("See through the recording camera", icon=viser.Icon.CAMERA)
        self.gui.add_markdown("Drag to turn, right-drag to move, scroll to come nearer.")

        async def see(_: viser.GuiEvent) -> None:
            self.look_through(self.camera.value)

        self.camera.on_update(see)
        snap.on_click(see)

    def _build_show(self) -> None:
        gui, client = self.gui, self.client
        parts = gui.add_dropdown("Parts", tuple(_PARTS))
        known = [name for name in _SHOWN if name != "depth" or client.painter.knows_depth]
        shown = gui.add_dropdown("Colours", tuple(known))
        others = comparisons(self.capture, list(client.painter.others))
        compare = gui.add_dropdown("Compare with", (_NOTHING, *others))
        layout = gui.add_dropdown("Layout", ("divided", "side by side"))
        divider = gui.add_slider("Divider", 0.0, 1.0, 0.005, client.standing.divider)
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
            control.on_update(changed)

    def look_through(self, camera: str) -> None:
        """Put the browser's camera where a recording camera is at this time."""
        request = self.client.standing
        recording = camera_at(self.capture, camera, request.time_us)
        view, _ = framed(recording, request.width, request.height)
        centre, ahead = recording.center().double().numpy(), forward(recording)
        # The view turns around the place on the optical axis that is as far as the pivot.
        away = max(0.5, float((self.pivot - centre) @ ahead))
        orbit = Orbit(request.orbit.wxyz, tuple(centre.tolist()), vertical_fov(view))
        self.client.look_through(camera, orbit, centre + away * ahead)

    def show_motion(self, name: str | None) -> None:
        """Let the time go through a motion of the package, or the recording (None).

        Called by the drawing thread, since reading a motion takes a while.
        """
        if name is None:
            self._start_us, self._end_us = self._recording_us
        else:
            times = self.client.painter.subject.track(name).times_us
            self._start_us, self._end_us = int(times[0]), int(times[-1])
        self._motion = name
        self.loop.visible = self.steps.visible = name is None
        self.slider.max = round((self._end_us - self._start_us) / 1e3, 1)
        self.client.move(name=name)
        self.client.play(
            lambda p, now: p.within(self._start_us, self._end_us, now).moved(self._start_us, now)
        )

    def _go(self, place_us: float) -> None:
        self.client.play(lambda p, now: p.moved(place_us, now))
        if self._motion is None and self.loop.value == _EXPOSURE:
            self._loop()

    def _loop(self) -> None:
        """Loop over what is chosen, around where the time stands."""
        if self.loop.value == _EXPOSURE and self._motion is None:
            start, end = self._frame_at(self.client.standing.time_us).exposure_us
        else:
            start, end = self._start_us, self._end_us
        self.client.play(lambda p, now: p.within(start, end, now))

    def _frame_at(self, time_us: float) -> Frame:
        return min(self._frames, key=lambda frame: abs(frame.mid_us - time_us))

    def _show_playing(self, playback: Playback) -> None:
        playing = playback.since is not None
        self.play.label = "Pause" if playing else "Play"
        self.play.icon = viser.Icon.PLAYER_PAUSE if playing else viser.Icon.PLAYER_PLAY

    def _follow(self, time_us: int) -> None:
        """Let the slider follow the picture; called by the drawing thread."""
        now = time.monotonic()
        if now - self._slider_at < _SLIDER_S:
            return
        self._slider_at = now
        self._move_slider(time_us)

    def _move_slider(self, time_us: int) -> None:
        place_ms = (time_us - self._start_us) / 1e3
        if abs(self.slider.value - place_ms) > 0.05:
            # viser's property has a setter, which type checkers do not see.
            self.slider.value = min(max(place_ms, 0.0), self.slider.max)  # type: ignore[misc]
        if self._motion is None:
            said = self._of_frame(time_us)
        else:
            said = f"Motion {self._motion.replace('_', ' ')}, which was not recorded"
        if said != self._said:
            self.told.content = self._said = said

    def _of_frame(self, time_us: int) -> str:
        frame = self._frame_at(time_us)
        start, end = frame.exposure_us
        split = {"train": "training", "test": "held out"}[frame.split]
        if start <= time_us <= end:
            where = f"{100 * (time_us - start) / max(end - start, 1):.0f} % into its exposure"
        else:
            where = "between exposures"
        return f"Frame {frame.name} ({split}), {where} of {(end - start) / 1e3:.3g} ms"

    def instant_name(self, request: ViewRequest) -> str:
        """What a file of this instant is called, without its ending."""
        motion = "" if request.motion.name is None else f"-{request.motion.name}"
        place_ms = request.time_us / 1e3
        return f"{self.capture.name}{motion}-{place_ms:.1f}ms"
