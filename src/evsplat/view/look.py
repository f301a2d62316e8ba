"""What a client wants to see: a plain value, so that two wishes can be compared."""

from dataclasses import dataclass
from typing import Literal

from evsplat.methods.reconstruction import Parts
from evsplat.view.camera import Orbit

Colouring = Literal["colour", "semantic", "depth"]
Layout = Literal["divided", "side by side"]


@dataclass(frozen=True)
class Motion:
    """What the person does instead of what was recorded."""

    name: str | None
    """A motion of the package; None: the recorded one."""
    angles: tuple[float, ...]
    """Of the pose sliders, degrees, added to the motion; empty where there are none."""

    @property
    def is_recorded(self) -> bool:
        """Whether it is the recording and nothing but it."""
        return self.name is None and not any(self.angles)


@dataclass(frozen=True)
class Look:
    """One picture: from where, of when, and how."""

    width: int
    height: int
    """Of the viewport, pixels."""
    orbit: Orbit
    recording: str | None
    """The capture's camera through which is looked; None: the browser's own."""
    time_us: int
    """On the camera's clock; of a motion of the package since its start."""
    motion: Motion
    parts: Parts
    colouring: Colouring
    compare: str | None
    """What is shown beside the run: `BLURRY`, `SHARP` or another run's name."""
    layout: Layout
    divider: float
    """Where a divided picture changes from the other to the run, as a share of its width."""
    events_us: int | None
    """Width of the window of events drawn over the picture; None: no events."""


BLURRY = "blurry input"
SHARP = "sharp truth"
