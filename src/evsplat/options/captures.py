"""Options of the verbs that make captures and read event recordings."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Literal

from evsplat.errors import ConfigError
from evsplat.options.declare import Flag, Sensor, Transfer, Use, check_options, option
from evsplat.ranges import Above, AtLeast, Within

Skip = Annotated[int, AtLeast(0), option("N")]
Stop = Annotated[int | None, AtLeast(1), option("N", default="the end")]
"""Numbers of events in their file: the first that is read, and one past the last."""


@dataclass(frozen=True)
class ReadOptions:
    """The caller's statements about a recording; None where the file decides."""

    repair: Flag = False
    """Read on where the file is cut, out of order or wrapped, and say what was repaired."""
    columns: Annotated[
        tuple[str, ...] | Mapping[str, str] | None,
        option("t,x,y,p", default="as the file says", read_as=str | None),
    ] = None
    """Columns of a text file in order, '-' for one to pass over; or 'mmhpsd'."""
    time_unit: Annotated[
        Literal["s", "ms", "us", "ns"] | None, option("UNIT", default="as the file says")
    ] = None
    """Unit of the times of a table."""
    width: Annotated[int | None, Within(1, 65536), option("PX", default="as the file says")] = None
    """Columns of the sensor."""
    height: Annotated[int | None, Within(1, 65536), option("PX", default="as the file says")] = None
    """Rows of the sensor."""
    skip: Skip = 0
    """Leave out so many events at the beginning of the file, as of another recording."""
    stop: Stop = None
    """Leave out event N of the file, counted from 0, and all after it."""

    def __post_init__(self) -> None:
        check_options(self)
        if self.stop is not None and self.stop <= self.skip:
            raise ConfigError(
                f"--stop {self.stop}: leaves nothing after --skip {self.skip}, expected a number "
                "above it."
            )
        if isinstance(self.columns, str):
            object.__setattr__(self, "columns", tuple(self.columns.split(",")))
        elif isinstance(self.columns, Sequence):
            object.__setattr__(self, "columns", tuple(self.columns))


Interpolation = Literal["flow", "super-slomo", "none"]


@dataclass(frozen=True)
class Recipe:
    """Settings that a data set of the paper is made with."""

    interpolation: Interpolation
    duty: float
    contrast: float | None = None


_NONE = Recipe("flow", duty=0.75)
# The paper names Super SloMo but neither factor nor exposure nor sensor. Read as: every source
# picture is the middle of an exposure as long as the time between two, of eight sub-frames.
_PAPER = Recipe("super-slomo", duty=1.0, contrast=0.2)
# The recorded events of MMHPSD carry no polarity, so they are simulated as well.
RECIPES = {"zju-mocap-blur": _PAPER, "mmhpsd-blur": _PAPER}
"""Recipes of the paper's data sets, made from ZJU-MoCap and MMHPSD, by name."""
_UPSAMPLE = 8
_EXPOSURES = ("exposure_us", "duty", "subframes")


@dataclass(frozen=True)
class SynthesisSettings:
    """Making of blurry frames and events; at most one of the three exposures is given.

    What a recipe says is filled in where nothing else is given.
    """

    recipe: Annotated[
        Literal["zju-mocap-blur", "mmhpsd-blur"] | None, option("NAME", default="none")
    ] = None
    """Data set of the paper: zju-mocap-blur or mmhpsd-blur."""
    fps: Annotated[float | None, Above(0), option("HZ", default="the source's")] = None
    """Blurry frames per second."""
    exposure_us: Annotated[int | None, Above(1), option("US", default="by --duty")] = None
    """Length of the exposures."""
    duty: Annotated[float | None, Above(0), option("SHARE", default="0.75")] = None
    """Their share of the time between frames."""
    subframes: Annotated[int | None, Above(0), option("K", default="by --duty")] = None
    """Frames are means of K sub-frames."""
    upsample: Annotated[int, AtLeast(1), option("N")] = _UPSAMPLE
    """Sub-frames per source picture."""
    interpolation: Annotated[Interpolation | None, option("KIND", default="flow")] = None
    """Pictures in between: flow, super-slomo or none."""
    transfer: Annotated[Transfer, option("CURVE")] = "power"
    """Values to light: power (2.2), srgb or linear."""
    sensor: Annotated[Sensor, option("PRESET")] = "clean"
    """Event camera, as of 'evsplat simulate'."""
    contrast: Annotated[float | None, AtLeast(0.01), option("C", default="the sensor's")] = None
    """Contrast threshold of events."""
    seed: Annotated[int, AtLeast(0), option("N")] = 0
    """Seed of all noise."""
    read_noise: Annotated[float, Within(0, 1), option("SIGMA")] = 0.0
    """Noise of frames, in linear light."""
    events: Annotated[Literal["simulate", "source", "none"], option("WHICH")] = "simulate"
    """Events: simulate, source or none."""
    split: Annotated[Literal["modulo", "source"], option("HOW")] = "modulo"
    """Split of the frames: modulo or source."""

    def __post_init__(self) -> None:
        check_options(self)
        exposures = [f"--{n.replace('_', '-')}" for n in _EXPOSURES if getattr(self, n) is not None]
        if len(exposures) > 1:
            raise ConfigError(f"{' and '.join(exposures)}: give one length of the exposures.")
        recipe = _NONE if self.recipe is None else RECIPES[self.recipe]
        given = self.contrast not in (None, recipe.contrast)
        if self.events != "simulate" and (self.sensor != "clean" or given):
            name = "contrast" if self.sensor == "clean" else "sensor"
            raise ConfigError(f"--{name}: goes with --events simulate; leave --{name} out.")
        for name, value in asdict(recipe).items():
            if getattr(self, name) is None and not (name == "duty" and exposures):
                object.__setattr__(self, name, value)
        if self.interpolation == "none" and self.upsample != _UPSAMPLE:
            raise ConfigError(
                "--upsample: --interpolation none makes no sub-frames in between; leave one out."
            )

    @property
    def factor(self) -> int:
        """Sub-frames per source picture that are really made."""
        return 1 if self.interpolation == "none" else self.upsample


CameraMotion = Literal["static", "orbit", "handheld"]
NovelViews = Literal["test", "all", "none"]
_ORBIT_DEG = 30.0
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
    """Number of frames."""
    fps: Annotated[float, Within(0.1, 1000), option("HZ")] = 25.0
    """Frames per second."""
    exposure_ms: Annotated[float, Within(0.05, 10_000), option("MS")] = 30.0
    """Exposure of each frame."""
    start_s: Annotated[float, Within(0, 1e6), option("S", name="start")] = 0.0
    """Time in the motion to begin at."""
    yaw_deg: Annotated[float, Within(-360, 360), option("DEG", name="yaw")] = 0.0
    """Turn of the person about the vertical."""
    in_place: Flag = False
    """Leave out travel across the floor."""
    camera: Annotated[CameraMotion, option("HOW")] = "static"
    """Tripod (static), arc round the person (orbit) or handheld."""
    orbit_deg: Annotated[float, Within(-80, 80), option("DEG", name="orbit")] = _ORBIT_DEG
    """Arc of an orbiting camera, up to 80."""
    shadows: Annotated[Flag, option(name="shadow")] = True
    """Leave out the person's shadow on the room."""
    lamp_azimuth_deg: Annotated[
        float | None,
        Within(-360, 360),
        option("DEG", default="22", name="lamp-azimuth"),
    ] = None
    """Lamp round the person from the camera: 90 is right, 180 behind."""
    lamp_elevation_deg: Annotated[
        float | None,
        Within(5, 90),
        option("DEG", default="56", name="lamp-elevation"),
    ] = None
    """Lamp above the person's middle."""
    brightness: Annotated[float, Within(0.01, 100), option("X")] = 1.0
    """Factor of all light."""
    events: Annotated[Sensor, option("SENSOR")] = "clean"
    """clean, or the noise of davis346, dvxplorer or evk4."""
    pose_noise: Annotated[PoseNoise, option("P")] = "none"
    """Errors of the poses: none, mocap, estimated or estimated-blurry."""
    cloth_mm: Annotated[float, Within(0, 50), option("MM")] = 0.0
    """Wrinkles of garments, root mean square."""
    novel_views: Annotated[NovelViews, option("V")] = "test"
    """Frames with sharp pictures of two more cameras: test, all or none."""
    subframe_hz: Annotated[float, Within(1000, 100_000), option("HZ")] = 1000.0
    """Pictures per second that blur and events are made of, at least."""
    seed: Annotated[int, AtLeast(0), option("S")] = 0
    """Seed of every random number."""

    def __post_init__(self) -> None:
        check_options(self)
        if self.height is None:
            object.__setattr__(self, "height", self.width)
        if self.camera != "orbit" and self.orbit_deg != _ORBIT_DEG:
            raise ConfigError(
                f"--orbit {self.orbit_deg:g}: goes with --camera orbit; name it or leave --orbit "
                "out."
            )
        if self.exposure_ms > 1000 / self.fps + 1e-9:
            raise ConfigError(
                f"--exposure-ms {self.exposure_ms:g}: a frame comes every {1000 / self.fps:g} ms "
                f"at {self.fps:g} frames per second; shorten the exposure or lower --fps."
            )

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the pictures, pixels."""
        return self.width, self.height or self.width


@dataclass(frozen=True)
class PoseOptions:
    """Body poses to be found in a recording."""

    body: Annotated[Literal["default", "smpl"], option("MODEL")] = "default"
    """default (ships with evsplat) or smpl (your licensed file)."""
    height_m: Annotated[
        float | None, Within(0.5, 2.5), option("M", default="an adult's", name="height")
    ] = None
    """Stature of the person, metres: it alone tells how far away they are."""
    refine_s: Annotated[
        float | None, Within(0, 1e6), option("SECONDS", default="3 per frame", name="refine")
    ] = None
    """Time for their correction by drawing the person; 0: none."""
    use: Use = "training"
    """everything: held-out frames are looked at too."""
    held_out_events: Flag = False
    """Follow the person through held-out times by their events."""

    def __post_init__(self) -> None:
        check_options(self)


@dataclass(frozen=True)
class PoseSearch(PoseOptions):
    """Body poses to be found in a capture, and the focal length with them."""

    focal: Annotated[str | None, option("auto|PX", default="the capture's")] = None
    """Focal length in pixels, or auto: the one that fits best."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.focal not in (None, "auto") and self.focal_px is None:
            raise ConfigError(f"--focal {self.focal}: expected auto or pixels above 0.")

    @property
    def focal_px(self) -> float | None:
        """The focal length given in pixels; None where it is not."""
        try:
            focal = float(self.focal or "")
        except ValueError:
            return None
        return focal if 0 < focal < math.inf else None
