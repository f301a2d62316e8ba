"""``evsplat render``: draw a run as video or pictures."""

from pathlib import Path
from typing import Annotated, Literal

from evsplat.cli.options import Device, Flag, RunFolder, option


def render(
    run: RunFolder,
    /,
    *,
    what: Literal["sequence", "test"] = "sequence",
    show: Literal["rgb", "semantic", "depth", "events"] = "rgb",
    parts: Literal["all", "human", "scene"] = "all",
    camera: Annotated[str | None, option("NAME", default="that of the frames")] = None,
    path: Annotated[str | None, option("PATH", default="it stays")] = None,
    motion: Annotated[str | None, option("NAME", default="none")] = None,
    motion_fps: Annotated[float | None, option("HZ", default="the file's")] = None,
    in_place: Flag = False,
    at: Annotated[float | None, option("S", default="no")] = None,
    seconds: Annotated[float | None, option("S", default="all; 4 with --at")] = None,
    fps: Annotated[float, option("HZ", default="30")] = 30.0,
    slow: Annotated[float, option("FACTOR", default="1")] = 1.0,
    beside: Flag = False,
    transparent: Flag = False,
    sensor: Annotated[
        Literal["clean", "davis346", "dvxplorer", "evk4"], option("NAME", default="clean")
    ] = "clean",
    event_hz: Annotated[float, option("HZ", default="1000")] = 1000.0,
    events: Annotated[Path | None, option("FILE", default="no")] = None,
    out: Annotated[Path | None, option("PATH", default="in RUN/renders")] = None,
    device: Device = "auto",
) -> None:
    """Film a run, the recording or another motion, as video or pictures.

    When stopped, the same command goes on where it was. More: docs/render.md.

    Args:
        run: Run folder written by 'evsplat train'.
        what: The whole recording, or the held-out frames at mid-exposure.
        show: Events are those of a simulated sensor.
        parts: The person and the scene, or one of them.
        camera: A camera of the capture.
        path: Move it: orbit, swing, interpolate or a JSON file.
        motion: Another motion: walk, run, spin, dance_a ... or a motion or pose file.
        motion_fps: Poses per second of a pose file.
        in_place: Leave out the motion's travel along the floor.
        at: Hold the person at this time of the recording.
        seconds: Film so much of it.
        fps: Pictures per second that the video plays.
        slow: Times slower than life: draws FPS x SLOW pictures a second.
        beside: Put the blurry input frame (or the recorded events) at the left.
        transparent: Transparent where nothing is (.webp, .gif, PNG).
        sensor: Event camera of --show events.
        event_hz: Pictures per second that it is shown.
        events: Write its events as well, such as to events.h5.
        out: NAME.mp4, .webp or .gif, or a new folder for PNG.
        device: Where to draw.
    """
    from evsplat.events import sensor_settings
    from evsplat.export import render_run
    from evsplat.film import Film

    film = Film(
        what=what,
        show=show,
        parts=parts,
        camera=camera,
        path=path,
        motion=motion,
        motion_fps=motion_fps,
        in_place=in_place,
        at=at,
        seconds=seconds,
        fps=fps,
        slow=slow,
        beside=beside,
        transparent=transparent,
        event_hz=event_hz,
        sensor=sensor_settings(sensor),
    )
    written = render_run(run, film=film, out=out, events_out=events, device=device)
    print(f"written: {written}")
