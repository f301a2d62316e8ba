"""Options of ``evsplat render``: what a film shows."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from evsplat.config import Above, AtMost
from evsplat.errors import ConfigError
from evsplat.options.declare import Flag, Parts, Sensor, check_options, option

Shown = Literal["rgb", "semantic", "depth", "events"]


@dataclass(frozen=True)
class Film:
    """What `render_run` draws."""

    what: Literal["sequence", "test"] = "sequence"
    """The whole recording, or the held-out frames at mid-exposure."""
    show: Shown = "rgb"
    """Events are those of a simulated sensor."""
    parts: Parts = "all"
    """The person and the scene, or one of them."""
    camera: Annotated[str | None, option("NAME", default="that of the frames")] = None
    """A camera of the capture; it need not have recorded anything."""
    path: Annotated[str | None, option("PATH", default="it stays")] = None
    """Move it: orbit, swing, interpolate or a JSON file."""
    motion: Annotated[str | None, option("NAME", default="none")] = None
    """Another motion: walk, run, spin, dance_a ... or a motion or pose file."""
    motion_fps: Annotated[float | None, option("HZ", default="the file's")] = None
    """Poses per second of a pose file."""
    in_place: Flag = False
    """Leave out the motion's travel along the floor."""
    at: Annotated[float | None, option("S", default="no")] = None
    """Hold the person at this time of the recording."""
    seconds: Annotated[
        float | None, Above(0), AtMost(86_400), option("S", default="all; 4 with --at")
    ] = None
    """Film so much of it."""
    fps: Annotated[float, Above(0), AtMost(1000), option("HZ")] = 30.0
    """Pictures per second that the video plays."""
    slow: Annotated[float, Above(0), AtMost(10_000), option("FACTOR")] = 1.0
    """Times slower than life: draws FPS x SLOW pictures a second."""
    beside: Flag = False
    """Put the blurry input frame (or the recorded events) at the left."""
    transparent: Flag = False
    """Transparent where nothing is (.webp, .gif, PNG)."""
    sensor: Annotated[Sensor, option("NAME")] = "clean"
    """Event camera of --show events."""
    event_hz: Annotated[float, Above(0), AtMost(100_000), option("HZ")] = 1000.0
    """Pictures per second that it is shown."""

    def __post_init__(self) -> None:
        check_options(self)
        changed = [f for f in ("path", "motion", "at", "seconds") if getattr(self, f) is not None]
        if self.show == "events":
            changed.append("show events")
        if self.what == "test" and changed:
            raise ConfigError(
                f"--{changed[0]}: films the sequence, not --what test; leave one out."
            )
        if self.path is not None and self.camera is not None and self.path == "interpolate":
            raise ConfigError("--camera: --path interpolate goes through all; leave one out.")
        if self.at is not None and self.slow != 1:
            raise ConfigError("--slow: with --at the time stands still; leave one out.")
        if self.beside and (self.motion is not None or self.transparent):
            other = "motion" if self.motion is not None else "transparent"
            raise ConfigError(f"--beside: the input does not fit --{other}; leave one out.")
        if self.motion is None and (self.motion_fps is not None or self.in_place):
            option = "in-place" if self.in_place else "motion-fps"
            raise ConfigError(f"--{option}: goes with --motion; name one or leave it out.")

    def file_name(self) -> str:
        """Name of the film in a run's ``renders/``."""
        said = [self.parts, self.camera, self.path, self.motion, self.show]
        words: list[str] = [self.what]
        words += [Path(word).stem for word in said if word not in (None, "all", "rgb")]
        words += [] if self.at is None else [f"at-{self.at:g}s"]
        words += [name for name in ("transparent", "beside") if getattr(self, name)]
        ending = {"test": ""}.get(self.what, ".webp" if self.transparent else ".mp4")
        return "-".join(words) + ending
