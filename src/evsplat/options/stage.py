"""Options of ``evsplat stage``: all that a synthetic capture is made by."""

from dataclasses import dataclass
from typing import Annotated, Literal

from evsplat.config import Within
from evsplat.errors import ConfigError
from evsplat.options.declare import Flag, Sensor, check_options, option

CameraMotion = Literal["static", "orbit", "handheld"]
NovelViews = Literal["test", "all", "none"]
PoseNoise = Literal["none", "mocap", "estimated", "estimated-blurry"]


@dataclass(frozen=True)
class StageSettings:
    """A synthetic capture; equal settings give equal captures."""

    character: Annotated[str, option("NAME")] = "man"
    """One of --list, or an .npz of your own."""
    motion: Annotated[str, option("NAME")] = "dance_b"
    """One of --list, or a .bvh, .amc or DeepMimic file."""
    width: Annotated[int, Within(16, 4096), option("PX", alias="--size")] = 256
    """Width of the pictures."""
    height: Annotated[int | None, Within(16, 4096), option("PX", default="the width")] = None
    """Height of the pictures."""
    frames: Annotated[
        int | None, Within(1, 100_000), option("N", default="the motion's, to 100")
    ] = None
    """How many frames."""
    fps: Annotated[float, Within(0.1, 1000), option("HZ")] = 25.0
    """Frames per second."""
    exposure_ms: Annotated[float, Within(0.05, 10_000), option("MS")] = 30.0
    """Exposure of each frame."""
    start_s: Annotated[float, Within(0, 1e6), option("S", name="start")] = 0.0
    """Where in the motion to begin."""
    yaw_deg: Annotated[float, Within(-360, 360), option("DEG", name="yaw")] = 0.0
    """Turn of the person about the vertical."""
    in_place: Flag = False
    """Leave out travel across the floor."""
    camera: Annotated[CameraMotion, option("HOW")] = "static"
    """static, orbit (an arc round the person) or handheld."""
    orbit_deg: Annotated[float, Within(-360, 360), option("DEG", name="orbit")] = 30.0
    """Arc of an orbiting camera over the whole capture."""
    shadows: Annotated[Flag, option(default="", name="shadow")] = True
    """The person's shadow on the room, unless switched off."""
    brightness: Annotated[float, Within(0.01, 100), option("X")] = 1.0
    """Factor of all light."""
    events: Annotated[Sensor, option("SENSOR")] = "clean"
    """clean, or the noise of davis346, dvxplorer or evk4."""
    pose_noise: Annotated[PoseNoise, option("P")] = "none"
    """Errors of the poses: none, mocap, estimated or estimated-blurry."""
    cloth_mm: Annotated[float, Within(0, 50), option("MM")] = 0.0
    """Wrinkles that garments throw, root mean square."""
    novel_views: Annotated[NovelViews, option("V")] = "test"
    """Frames with sharp pictures of two more cameras: test, all or none."""
    subframe_hz: Annotated[float, Within(1000, 100_000), option("HZ")] = 1000.0
    """Pictures per second that blur and events are made of, at least."""
    seed: Annotated[int, option("S")] = 0
    """Seed of every random number."""

    def __post_init__(self) -> None:
        check_options(self)
        if self.height is None:
            object.__setattr__(self, "height", self.width)
        if self.exposure_ms > 1000 / self.fps + 1e-9:
            raise ConfigError(
                f"--exposure-ms {self.exposure_ms:g}: a frame comes every {1000 / self.fps:g} ms "
                f"at {self.fps:g} frames per second; shorten the exposure or lower --fps."
            )

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the pictures, pixels."""
        return self.width, self.height or self.width
