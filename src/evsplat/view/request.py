"""A picture that a browser asks for, and the playback that moves its time."""

from dataclasses import dataclass, replace
from typing import Literal

from evsplat.film import Look
from evsplat.view.camera import BrowserCamera

Layout = Literal["divided", "side by side"]

BLURRY = "blurry input"
SHARP = "sharp truth"
OWN_TRUTH = "recorded picture"
"""In place of both where the recorded pictures are taken as sharp."""


@dataclass(frozen=True)
class Motion:
    """The person's motion: the recorded one or one that ships, and angles on top of it."""

    name: str | None = None
    """A motion that ships with the package; None: the recorded one."""
    angles: tuple[float, ...] = ()
    """Angles of the pose sliders, degrees; empty where there are none."""

    @property
    def is_recorded(self) -> bool:
        """True for the recording and nothing but it."""
        return self.name is None and not any(self.angles)


@dataclass(frozen=True)
class ViewRequest:
    """One picture: camera, time and look. Equal requests have equal pictures."""

    width: int
    height: int
    """Size of the viewport, pixels."""
    browser_camera: BrowserCamera
    time_us: int
    """Time on the camera's clock; of a motion of the package, time since its start."""
    recording_camera: str | None = None
    """The capture's camera to look through; None: the browser's own."""
    motion: Motion = Motion()
    look: Look = Look()
    compare: str | None = None
    """Shown beside the run: `BLURRY`, `SHARP`, `OWN_TRUTH` or another run's name."""
    layout: Layout = "divided"
    divider: float = 0.5
    """Share of the width at which a divided picture changes to the run."""
    events_us: int | None = None
    """Width of the window of recorded events drawn over the picture; None: no events."""


@dataclass(frozen=True)
class Playback:
    """A time in the recording that stands or moves, and loops."""

    start_us: float
    end_us: float
    """End of the loop, where playing goes on at the start."""
    position_us: float
    """Time shown, or shown at ``since_s`` while it plays."""
    speed: float = 1.0
    """Recorded seconds per second; 0.01 is a hundred times slower than life."""
    since_s: float | None = None
    """Wall clock when playing began, seconds; None: it stands."""

    def at(self, now: float) -> float:
        """The time shown at wall-clock second ``now``, microseconds."""
        if self.since_s is None:
            return self.position_us
        elapsed = (now - self.since_s) * self.speed * 1e6
        length = self.end_us - self.start_us
        if length <= 0:
            return self.start_us
        return self.start_us + (self.position_us - self.start_us + elapsed) % length

    def playing(self, on: bool, now: float) -> "Playback":
        """Begin to play, or stand where it is."""
        return replace(self, position_us=self.at(now), since_s=now if on else None)

    def moved(self, position_us: float, now: float) -> "Playback":
        """Go to a time; a loop that does not hold it is left to `within`."""
        since = None if self.since_s is None else now
        return replace(self, position_us=position_us, since_s=since)

    def at_speed(self, speed: float, now: float) -> "Playback":
        """Go on from the same time at another speed."""
        return replace(self.moved(self.at(now), now), speed=speed)

    def within(self, start_us: float, end_us: float, now: float) -> "Playback":
        """Loop between other ends; a time outside of them goes to the nearer one."""
        position = min(max(self.at(now), start_us), end_us)
        return replace(self.moved(position, now), start_us=start_us, end_us=end_us)
