"""``evsplat export``: a run as a file for other programs."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from evsplat.cli.options import Device, Flag, RunFolder, option


def export(
    run: RunFolder,
    kind: Annotated[
        tyro.conf.Positional[Literal["ply", "spz", "splat", "gltf", "html", "avatar"]],
        tyro.conf.arg(metavar="KIND"),
    ],
    /,
    *,
    out: Annotated[Path | None, option("PATH", default="in RUN/exports")] = None,
    time: Annotated[float | None, option("S", default="the middle of the recording")] = None,
    frame: Annotated[str | None, option("NAME", default="see --time")] = None,
    canonical: Flag = False,
    parts: Annotated[
        Literal["all", "human", "scene"] | None,
        option("{all,human,scene}", default="all; human for avatar"),
    ] = None,
    camera: Annotated[str | None, option("NAME", default="the recording one")] = None,
    up: Annotated[
        Literal["y", "z"] | None, option("{y,z}", default="the capture's axes; y for spz, gltf")
    ] = None,
    motion: Annotated[str | None, option("NAME", default="the recorded one alone")] = None,
    fps: Annotated[float, option("HZ", default="24")] = 24.0,
    device: Device = "auto",
) -> None:
    """Write a run as a file for other programs, in metres: docs/export.md.

    ply, spz, splat and gltf hold the Gaussians of one instant.

    html is a page that plays the recording in 3D.

    avatar is a page with a person to play and to pose.

    Args:
        run: Run folder written by 'evsplat train'.
        kind: ply, spz, splat, gltf, html or avatar.
        out: The file to write; avatar: a page NAME.html, or a new folder.
        time: Seconds from the first mid-exposure.
        frame: The mid-exposure of this frame.
        canonical: The person at rest instead of an instant.
        parts: The person and the scene, or one of them.
        camera: The camera that sees the colours, which depend on the direction of view.
        up: Turn the world so that this axis points up.
        motion: Another motion for the avatar, as 'evsplat render' takes it.
        fps: Pictures per second of html.
        device: Where to compute.
    """
    from evsplat.export import export_run

    path = export_run(
        run,
        kind,
        out=out,
        time_s=time,
        frame=frame,
        canonical=canonical,
        parts=parts,
        camera=camera,
        up=up,
        motion=motion,
        fps=fps,
        device=device,
    )
    print(f"written: {path}")
