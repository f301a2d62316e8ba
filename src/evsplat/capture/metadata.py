"""Content of capture.json, as checked values."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from jaxtyping import Float
from torch import Tensor

from evsplat.body.pose_errors import PoseSource
from evsplat.camera import Camera
from evsplat.capture.distortion import Distortion
from evsplat.pictures.light import Transfer

Gain = tuple[float, ...]
"""Factor of light, of all colours or of red, green and blue."""


@dataclass(frozen=True, eq=False, slots=True)  # an hour has 45,000
class Frame:
    """One blurry picture and what goes with it."""

    name: str
    index: int
    """Position in ``capture.frames``."""
    camera: str
    image_file: str
    """Path of the picture; an object of one would be four times as large."""
    exposure_us: tuple[int, int]
    """Start and end of the exposure on the camera's clock."""
    split: Literal["train", "test"]
    sharp: Path | None = None
    """Sharp truth at mid-exposure; opened by `Capture.sharp` only."""
    mask: Path | None = None
    world_to_camera: Float[Tensor, "4 4"] | None = None
    """Pose of a moving camera at mid-exposure; None where the camera stands."""
    gain: Gain | None = None
    """Light in picture and truth against other frames' pictures; None where it is the same."""

    @property
    def image(self) -> Path:
        """The picture."""
        return Path(self.image_file)

    @property
    def mid_us(self) -> int:
        """Middle of the exposure."""
        return (self.exposure_us[0] + self.exposure_us[1]) // 2


@dataclass(frozen=True)
class NovelView:
    """A sharp picture by another camera, for evaluation."""

    index: int
    """Position in the list of capture.json."""
    camera: str
    frame: str
    """Name of the frame at whose time it was taken."""
    time_us: int
    image: Path


@dataclass(frozen=True)
class EventsEntry:
    """The ``events`` part of capture.json."""

    file: Path
    width: int
    height: int
    contrast_threshold: tuple[float, float] | None
    """C+ and C- in log intensity."""
    simulated: bool
    clock_offset_us: int
    """Added to the event file's times to get the camera's clock."""


@dataclass(frozen=True, eq=False)
class Metadata:
    """All that capture.json holds."""

    path: Path
    name: str
    cameras: dict[str, Camera]
    distortions: dict[str, Distortion]
    transfers: dict[str, Transfer]
    """From the values of pictures to light, of cameras for which capture.json says it."""
    frames: tuple[Frame, ...]
    novel_views: tuple[NovelView, ...]
    body_file: Path
    body_model: str
    """Empty where the capture has no body yet."""
    body_source: PoseSource | None
    """Where its poses come from; None where the capture does not say."""
    events: EventsEntry | None
    up: tuple[float, float, float] | None
    """Upwards in the world, of any length; None where capture.json does not say."""
    provenance: dict[str, Any]
