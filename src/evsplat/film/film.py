"""What a film shows: the options of ``evsplat render`` as one value."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from evsplat.errors import ConfigError
from evsplat.events import SensorSettings
from evsplat.film.looks import Shown
from evsplat.methods.reconstruction import Parts


@dataclass(frozen=True)
class Film:
    """What `render_run` draws; every field is an option of ``evsplat render``."""

    what: Literal["sequence", "test"] = "sequence"
    """From the first to the last mid-exposure (poses are known between them), or the held-out
    frames at mid-exposure."""
    show: Shown = "rgb"
    """Colour; person and scene in two colours; depth (in a folder 16-bit PNG in millimetres, 0 =
    nothing, else coloured); or the events of a simulated sensor."""
    parts: Parts = "all"
    camera: str | None = None
    """A camera of the capture; it need not have recorded anything. Without one: the first that
    did."""
    path: str | None = None
    """``orbit``, ``swing`` or ``interpolate``, or a file (`evsplat.film.camera_path`)."""
    motion: str | None = None
    """What the person does instead: see `evsplat.film.load_motion_of`."""
    motion_fps: float | None = None
    """Poses per second of a pose file that does not say."""
    in_place: bool = False
    """Leave out the motion's travel along the floor."""
    at: float | None = None
    """Hold the person at this time, seconds of the camera's clock (or of the motion)."""
    seconds: float | None = None
    """Length in the recording's time, from its start; of a held moment 4 s without it."""
    fps: float = 30.0
    slow: float = 1.0
    """Times slower than life: ``fps * slow`` pictures are drawn per recorded second."""
    beside: bool = False
    """The blurry frame nearest in time at the left; for events, those recorded in that time."""
    transparent: bool = False
    event_hz: float = 1000.0
    """Pictures per recorded second that are drawn for the simulated sensor, at least."""
    sensor: SensorSettings | None = None
    """By default an ideal one."""

    def __post_init__(self) -> None:
        if not 0 < self.fps <= 1000:
            raise ConfigError(f"--fps {self.fps:g}: expected a frame rate of at most 1000 Hz.")
        if not 0 < self.slow <= 10_000:
            raise ConfigError(f"--slow {self.slow:g}: expected a factor above 0, at most 10000.")
        if self.seconds is not None and not 0 < self.seconds <= 86_400:
            raise ConfigError(f"--seconds {self.seconds:g}: expected more than 0, at most a day.")
        if not 0 < self.event_hz <= 100_000:
            raise ConfigError(f"--event-hz {self.event_hz:g}: expected above 0, at most 100000 Hz.")
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
        """Of the film in a run's ``renders/``."""
        said = [self.parts, self.camera, self.path, self.motion, self.show]
        words: list[str] = [self.what]
        words += [Path(word).stem for word in said if word not in (None, "all", "rgb")]
        words += [] if self.at is None else [f"at-{self.at:g}s"]
        words += [name for name in ("transparent", "beside") if getattr(self, name)]
        ending = {"test": ""}.get(self.what, ".webp" if self.transparent else ".mp4")
        return "-".join(words) + ending
