"""``evsplat stage``: make a synthetic capture with complete ground truth."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from evsplat.cli.options import Flag, Threads, option
from evsplat.errors import ConfigError


def stage(
    out: Annotated[
        tyro.conf.Positional[Path | None],
        tyro.conf.arg(metavar="CAPTURE", help_behavior_hint=""),
    ] = None,
    /,
    *,
    character: Annotated[str, option("NAME", default="man")] = "man",
    motion: Annotated[str, option("NAME", default="dance_b")] = "dance_b",
    size: Annotated[int, option("PX", default="256")] = 256,
    height: Annotated[int | None, option("PX", default="the width")] = None,
    frames: Annotated[int | None, option("N", default="what the motion gives, to 100")] = None,
    fps: Annotated[float, option("HZ", default="25")] = 25.0,
    exposure_ms: Annotated[float, option("MS", default="30")] = 30.0,
    start: Annotated[float, option("S", default="0")] = 0.0,
    in_place: Flag = False,
    camera: Annotated[
        Literal["static", "orbit", "handheld"], option("HOW", default="static")
    ] = "static",
    orbit: Annotated[float, option("DEG", default="30")] = 30.0,
    shadow: Flag = True,
    brightness: Annotated[float, option("X", default="1")] = 1.0,
    events: Annotated[
        Literal["clean", "davis346", "dvxplorer", "evk4"], option("SENSOR", default="clean")
    ] = "clean",
    pose_noise: Annotated[
        Literal["none", "mocap", "estimated", "estimated-blurry"], option("P", default="none")
    ] = "none",
    cloth_mm: Annotated[float, option("MM", default="0")] = 0.0,
    novel_views: Annotated[Literal["test", "all", "none"], option("V", default="test")] = "test",
    seed: Annotated[int, option("S", default="0")] = 0,
    threads: Threads = None,
    list: Flag = False,  # noqa: A002 - the option's name
) -> None:
    """Film a synthetic person in a room, with complete ground truth.

    Blur and events are made from at least 1000 pictures per second.

    Args:
        out: New capture folder.
        character: One of --list, or an .npz of your own.
        motion: One of --list, or a .bvh, .amc or DeepMimic file.
        size: Width of the pictures.
        height: Height of the pictures.
        frames: How many frames.
        fps: Frames per second.
        exposure_ms: Exposure of each frame.
        start: Where in the motion to begin.
        in_place: Leave out travel across the floor.
        camera: static, orbit (an arc round the person) or handheld.
        orbit: Arc of an orbiting camera.
        shadow: Keep the person's shadow off the room.
        brightness: Multiplies all light.
        events: clean, or the noise of davis346, dvxplorer or evk4.
        pose_noise: Errors of the poses: none, mocap, estimated or estimated-blurry.
        cloth_mm: Wrinkles that garments throw, root mean square.
        novel_views: Sharp pictures of other cameras: test, all or none.
        seed: Seed of every random number.
        threads: CPU threads.
        list: Say which characters and motions ship.
    """
    from evsplat import staging

    if list:
        print(f"characters: {', '.join(staging.characters())}")
        print(f"motions: {', '.join(staging.motions())}")
        return
    if out is None:
        raise ConfigError("stage needs a folder for the capture: evsplat stage my_capture.")
    settings = staging.StageSettings(
        character=character,
        motion=motion,
        width=size,
        height=height or size,
        frames=frames,
        fps=fps,
        exposure_ms=exposure_ms,
        start_s=start,
        in_place=in_place,
        camera=camera,
        orbit_deg=orbit,
        shadows=shadow,
        brightness=brightness,
        events=events,
        pose_noise=pose_noise,
        cloth_mm=cloth_mm,
        novel_views=novel_views,
        seed=seed,
    )
    path = staging.stage(out, settings, threads=threads)
    print(f"capture: {path}")
