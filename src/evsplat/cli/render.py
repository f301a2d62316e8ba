"""``evsplat render``: draw a run as video or pictures."""

from pathlib import Path
from typing import Annotated, Literal

from evsplat.cli.options import Device, Flag, RunFolder, option


def render(
    run: RunFolder,
    /,
    *,
    what: Literal["sequence", "test"] = "sequence",
    out: Annotated[Path | None, option("PATH", default="in RUN/renders")] = None,
    fps: Annotated[float, option("HZ", default="30")] = 30.0,
    slow: Annotated[float, option("FACTOR", default="1")] = 1.0,
    parts: Literal["all", "human", "scene"] = "all",
    camera: Annotated[str | None, option("NAME", default="the recording one")] = None,
    beside: Flag = False,
    device: Device = "auto",
) -> None:
    """Draw a run: the whole recording at any frame rate, or its test frames.

    Args:
        run: Run folder written by 'evsplat train'.
        what: The whole recording as mp4, or the held-out frames at mid-exposure as PNG.
        out: A video NAME.mp4, or a new folder for PNG pictures.
        fps: Pictures per second that the video plays.
        slow: Times slower than life: FPS x SLOW pictures are drawn per recorded second.
        parts: The person and the scene, or one of them.
        camera: A camera of the capture; it need not have recorded anything.
        beside: Put the blurry input frame at the left.
        device: Where to draw.
    """
    from evsplat.export import render_run

    path = render_run(
        run,
        what=what,
        out=out,
        fps=fps,
        slow=slow,
        parts=parts,
        camera=camera,
        beside=beside,
        device=device,
    )
    print(f"written: {path}")
