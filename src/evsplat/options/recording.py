"""Options of ``evsplat convert`` and of whatever else reads an event recording."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

from evsplat.config import Within
from evsplat.options.declare import Flag, check_options, option


@dataclass(frozen=True)
class ReadOptions:
    """What the caller says about a recording; None where the file is to tell."""

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

    def __post_init__(self) -> None:
        check_options(self)
        if isinstance(self.columns, str):
            object.__setattr__(self, "columns", tuple(self.columns.split(",")))
        elif isinstance(self.columns, Sequence):
            object.__setattr__(self, "columns", tuple(self.columns))
