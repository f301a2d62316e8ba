"""Everything that a synthetic capture is made by."""

from dataclasses import dataclass
from typing import Literal

from evsplat.errors import ConfigError
from evsplat.events.simulator import PRESETS
from evsplat.staging.camera_path import CameraMotion

EventPreset = Literal["clean", "davis346", "dvxplorer", "evk4"]
NovelViews = Literal["test", "all", "none"]

PoseNoise = Literal["none", "mocap", "estimated", "estimated-blurry"]

POSE_ERRORS: dict[str, float] = {
    "none": 0.0,
    "mocap": 0.003,
    "estimated": 0.01,
    "estimated-blurry": 0.02,
}
"""Mean error of wrists and ankles as a share of the body's height. A pose network run on frames of
a synthetic 512-pixel kick missed them by 1 to 2 % of the height, blurry frames being twice as bad;
0.3 % (5 mm) is what markers reach."""

MOST_FRAMES = 100
"""What is filmed of a long motion where no number is asked for."""


@dataclass(frozen=True)
class StageSettings:
    """A synthetic capture; equal settings give equal captures."""

    character: str = "man"
    """A character that ships, or the path of one's own (docs/stage.md)."""
    motion: str = "dance_b"
    """A motion that ships, or the path of a .bvh, .amc or DeepMimic file."""
    width: int = 256
    height: int = 256
    """Pixels."""
    frames: int | None = None
    """None: as many as the motion lasts, at most 100."""
    fps: float = 25.0
    exposure_ms: float = 30.0
    start_s: float = 0.0
    """Where in the motion to begin."""
    yaw_deg: float = 0.0
    """Turn of the person about the vertical."""
    in_place: bool = False
    """Leave out the motion's travel across the floor."""
    camera: CameraMotion = "static"
    orbit_deg: float = 30.0
    """Arc of an orbiting camera over the whole capture."""
    shadows: bool = True
    """Whether the person's shadow falls on the room."""
    brightness: float = 1.0
    """Multiplies the light of everything."""
    events: EventPreset = "clean"
    pose_noise: PoseNoise = "none"
    cloth_mm: float = 0.0
    """Root mean square of the wrinkles on loose garments."""
    novel_views: NovelViews = "test"
    """At which frames two more cameras take sharp pictures."""
    subframe_hz: float = 1000.0
    """Pictures per second of which blur and events are made; more in short exposures."""
    seed: int = 0

    def __post_init__(self) -> None:
        for name, low, high in (
            ("width", 16, 4096),
            ("height", 16, 4096),
            ("fps", 0.1, 1000),
            ("exposure_ms", 0.05, 10_000),
            ("start_s", 0, 1e6),
            ("yaw_deg", -360, 360),
            ("orbit_deg", -360, 360),
            ("brightness", 0.01, 100),
            ("cloth_mm", 0, 50),
            ("subframe_hz", 1000, 100_000),
            ("frames", 1, 100_000),
        ):
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise ConfigError(f"{name} is {value:g}, expected {low:g} to {high:g}.")
        if self.exposure_ms > 1000 / self.fps + 1e-9:
            raise ConfigError(
                f"exposure_ms is {self.exposure_ms:g}, but a frame comes every "
                f"{1000 / self.fps:g} ms at {self.fps:g} frames per second; shorten the exposure "
                "or lower fps."
            )
        for name, known in (
            ("camera", ("static", "orbit", "handheld")),
            ("events", tuple(PRESETS)),
            ("pose_noise", tuple(POSE_ERRORS)),
            ("novel_views", ("test", "all", "none")),
        ):
            if getattr(self, name) not in known:
                raise ConfigError(
                    f"{name} is {getattr(self, name)!r}, expected one of {', '.join(known)}."
                )
