"""``evsplat convert``: an event recording of any format into one that evsplat writes."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from evsplat.cli.options import Flag, option


def convert(
    recording: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="IN")],
    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")],
    /,
    *,
    repair: Flag = False,
    from_zero: Flag = False,
    to: Annotated[
        Literal["hdf5", "npz", "csv", "evt2"] | None, option("FORMAT", default="by OUT's suffix")
    ] = None,
    columns: Annotated[str | None, option("t,x,y,p", default="as the file says")] = None,
    time_unit: Annotated[
        Literal["s", "ms", "us", "ns"] | None, option("UNIT", default="as the file says")
    ] = None,
    width: Annotated[int | None, option("PX", default="as the file says")] = None,
    height: Annotated[int | None, option("PX", default="as the file says")] = None,
) -> None:
    """Read any event recording and write it as HDF5, .npz, .csv or EVT 2 (.raw).

    What is read: docs/event-formats.md.

    Args:
        recording: AEDAT4, AEDAT2, RAW, DAT, HDF5, .npz, text, .es or a ROS bag.
        out: The file to write.
        repair: Read on where the file is cut, out of order or wrapped, and say what was repaired.
        from_zero: Let the first event be at 0.
        to: Format to write.
        columns: Columns of a text file in order, '-' for one to pass over; or 'mmhpsd'.
        time_unit: What the times of a table are in.
        width: Columns of the sensor.
        height: Rows of the sensor.
    """
    from evsplat.events.convert import convert_recording

    conversion = convert_recording(
        recording,
        out,
        repair=repair,
        from_zero=from_zero,
        to=to,
        columns=columns,
        time_unit=time_unit,
        width=width,
        height=height,
    )
    print(conversion.summary)
