"""``evsplat export``: a run as a file for other programs."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from evsplat.cli.options import Device, RunFolder, option


def export(
    run: RunFolder,
    kind: Annotated[
        tyro.conf.Positional[Literal["ply", "spz", "splat", "gltf"]],
        tyro.conf.arg(metavar="{ply,spz,splat,gltf}"),
    ],
    /,
    *,
    out: Annotated[Path | None, option("PATH", default="in RUN/exports")] = None,
    time: Annotated[float | None, option("S", default="the middle of the recording")] = None,
    frame: Annotated[str | None, option("NAME", default="see --time")] = None,
    parts: Literal["all", "human", "scene"] = "all",
    camera: Annotated[str | None, option("NAME", default="the recording one")] = None,
    up: Annotated[
        Literal["y", "z"] | None, option("{y,z}", default="the capture's axes; y for spz, gltf")
    ] = None,
    device: Device = "auto",
) -> None:
    """Write a run's Gaussians as a file for other programs: docs/export.md.

    Lengths are metres.

    Args:
        run: Run folder written by 'evsplat train'.
        kind: ply (3D Gaussian splatting), spz, splat, or gltf (.glb with KHR_gaussian_splatting).
        out: The file to write.
        time: Seconds from the first mid-exposure.
        frame: The mid-exposure of this frame.
        parts: The person and the scene, or one of them.
        camera: The camera that sees the colours, which depend on the direction of view.
        up: Turn the world so that this axis points up.
        device: Where to compute.
    """
    from evsplat.export import export_run

    path = export_run(
        run,
        kind,
        out=out,
        time_s=time,
        frame=frame,
        parts=parts,
        camera=camera,
        up=up,
        device=device,
    )
    print(f"written: {path}")
