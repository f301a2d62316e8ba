"""`export_run`: a trained run as a file for other programs."""

import logging
from pathlib import Path
from typing import get_args

from evsplat.errors import ConfigError, DataError
from evsplat.export.gaussians import (
    ALWAYS_Y_UP,
    FileKind,
    UpAxis,
    cloud_at,
    file_rotation,
    instant_of,
    splat_source,
    write_file,
)
from evsplat.methods.reconstruction import Parts
from evsplat.training.run import Run, load_run

logger = logging.getLogger(__name__)

Kind = FileKind
_SUFFIX = {"ply": ".ply", "spz": ".spz", "splat": ".splat", "gltf": ".glb"}


def export_run(
    run: Path | str,
    kind: Kind,
    *,
    out: Path | str | None = None,
    time_s: float | None = None,
    frame: str | None = None,
    camera: str | None = None,
    parts: Parts = "all",
    up: UpAxis | None = None,
    device: str = "auto",
) -> Path:
    """Write a run's Gaussians in the format ``kind`` and return the file.

    The instant is ``time_s`` (seconds from the first mid-exposure) or the mid-exposure of
    ``frame``, else the middle of the recording. Colours are a network's, which sees the direction
    of view; in the file they are those seen from ``camera`` (default: the recording one) at that
    instant. Axes are the capture's unless ``up`` turns them; .spz and .glb are always y up. Lengths
    are metres. Without ``out`` the file goes to ``run/exports/``.
    """
    if kind not in get_args(Kind):
        raise ConfigError(f"{kind}: unknown format; choose one of {', '.join(get_args(Kind))}.")
    folder = Path(run)
    target = _checked(out, kind)
    loaded = load_run(folder, device=device)
    source = splat_source(loaded)
    capture = loaded.capture
    rotation = file_rotation(capture, kind, up)
    instant = instant_of(capture, time_s=time_s, frame=frame, camera=camera)
    if target is None:
        which = "" if parts == "all" else f"{parts}-"
        target = folder / "exports" / f"{which}{instant.label}{_SUFFIX[kind]}"
    cloud = cloud_at(source, instant, parts)
    facts = {
        **_facts(loaded),
        "parts": parts,
        "time_us": instant.time_us,
        "colours_seen_by": instant.camera_name,
    }
    write_file(target, kind, cloud, rotation, facts)
    people = int((cloud.semantic > 0.5).sum())
    upright = "y" if kind in ALWAYS_Y_UP else up
    logger.info(
        "%d Gaussians (person %d, scene %d) at %d us, colours as camera %s sees them; metres, %s.",
        len(cloud),
        people,
        len(cloud) - people,
        instant.time_us,
        instant.camera_name,
        "axes of the capture" if upright is None else f"{upright} up",
    )
    return target


def _facts(run: Run) -> dict[str, str]:
    return {"capture": run.capture.name, "method": run.method, "iteration": str(run.iteration)}


def _checked(out: Path | str | None, kind: str) -> Path | None:
    if out is None:
        return None
    path = Path(out)
    if path.suffix.lower() != _SUFFIX[kind]:
        raise ConfigError(f"--out {path}: a file of format {kind} ends in {_SUFFIX[kind]}.")
    if path.is_dir():
        raise DataError(f"{path}: is a folder; give a file name.")
    return path
