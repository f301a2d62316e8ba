"""Options of ``evsplat export``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from evsplat.config import Within
from evsplat.errors import ConfigError
from evsplat.options.declare import Device, Flag, Parts, check_options, option

UpAxis = Literal["y", "z"]
FileKind = Literal["ply", "spz", "splat", "gltf"]
Kind = Literal["ply", "spz", "splat", "gltf", "html", "avatar"]


@dataclass(frozen=True)
class ExportOptions:
    """What of a run a file for other programs holds."""

    out: Annotated[Path | None, option("PATH", default="in RUN/exports")] = None
    """The file to write; avatar: a page NAME.html, or a new folder."""
    time_s: Annotated[
        float | None, option("S", default="the middle of the recording", name="time")
    ] = None
    """Seconds from the first mid-exposure."""
    frame: Annotated[str | None, option("NAME", default="see --time")] = None
    """The mid-exposure of this frame."""
    canonical: Flag = False
    """The person at rest instead of an instant."""
    parts: Annotated[Parts | None, option("{all,human,scene}", default="all; human for avatar")] = (
        None
    )
    """The person and the scene, or one of them."""
    camera: Annotated[str | None, option("NAME", default="the recording one")] = None
    """The camera that sees the colours, which depend on the direction of view."""
    up: Annotated[UpAxis | None, option("{y,z}", default="the capture's axes; y for spz, gltf")] = (
        None
    )
    """Turn the world so that this axis points up."""
    motion: Annotated[str | None, option("NAME", default="the recorded one alone")] = None
    """Another motion for the avatar, as 'evsplat render' takes it."""
    fps: Annotated[float, Within(1, 120), option("HZ")] = 24.0
    """Pictures per second of html."""
    device: Device = "auto"
    """Where to compute."""

    def __post_init__(self) -> None:
        check_options(self)
        if self.time_s is not None and self.frame is not None:
            raise ConfigError("--time and --frame both say when; give one of them.")
        if self.canonical and (self.time_s is not None or self.frame is not None):
            raise ConfigError(
                "--canonical is the person at rest, at no time; leave out --time, --frame."
            )
