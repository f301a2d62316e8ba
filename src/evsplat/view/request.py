"""What a browser shows: a plain value, so that two requests can be compared."""

from dataclasses import dataclass
from typing import Literal

from evsplat.film.looks import Look
from evsplat.view.camera import Orbit

Layout = Literal["divided", "side by side"]

BLURRY = "blurry input"
SHARP = "sharp truth"


@dataclass(frozen=True)
class Motion:
    """What the person does."""

    name: str | None = None
    """A motion that ships with the package; None: the recorded one."""
    angles: tuple[float, ...] = ()
    """Of the pose sliders, degrees, on top of the motion; empty where there are none."""

    @property
    def is_recorded(self) -> bool:
        """Whether it is the recording and nothing but it."""
        return self.name is None and not any(self.angles)


@dataclass(frozen=True)
class ViewRequest:
    """One picture: from where, of when, and how."""

    width: int
    height: int
    """Of the viewport, pixels."""
    orbit: Orbit
    time_us: int
    """On the camera's clock; of a motion of the package since its start."""
    recording: str | None = None
    """The capture's camera through which is looked; None: the browser's own."""
    motion: Motion = Motion()
    look: Look = Look()
    compare: str | None = None
    """What is shown beside the run: `BLURRY`, `SHARP` or another run's name."""
    layout: Layout = "divided"
    divider: float = 0.5
    """Where a divided picture changes from the other to the run, as a share of its width."""
    events_us: int | None = None
    """Width of the window of recorded events drawn over the picture; None: no events."""
