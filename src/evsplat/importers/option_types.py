"""Types of the options of several importers: what stands for their values, and their defaults."""

from pathlib import Path
from typing import Annotated, Literal

from evsplat.options.declare import option
from evsplat.pictures.light import Transfer
from evsplat.ranges import Above

FileOption = Annotated[Path | None, option("PATH", default="")]
"""A part of a recording, whose help says where it is looked for."""
HomographyOption = Annotated[Literal["auto"] | Path | None, option("FILE|auto", default="")]
"""Of a file, or to be found (`evsplat.importers.place_finder`)."""
FrameRange = Annotated[tuple[int, int] | None, option("FIRST STOP", default="")]
Shrink = Annotated[int, option("N")]
Rate = Annotated[float, Above(0), option("HZ")]
OwnRate = Annotated[float | None, Above(0), option("HZ", default="")]
Focal = Annotated[float | None, Above(0), option("PX", default="")]
Exposure = Annotated[float | None, Above(0), option("US", default="")]
TimeUs = Annotated[int, option("US")]
ClockOffset = Annotated[int | Literal["auto"], option("US|auto")]
"""Microseconds, or to be found (`add_recorded_events`)."""
Contrast = Annotated[tuple[float, float] | None, option("C+ C-", default="unknown")]
Curve = Annotated[Transfer | None, option(default="power")]
Name = Annotated[str | None, option("NAME", default="")]
