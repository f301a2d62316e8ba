"""`export_run`: a trained run as a file for other programs."""

import logging
from pathlib import Path
from typing import Literal

from evsplat.capture import load_body_track
from evsplat.errors import ConfigError, DataError
from evsplat.export.avatar import at_rest, export_avatar
from evsplat.export.clip import export_clip
from evsplat.export.cloud import cloud_of
from evsplat.export.gaussians import (
    ALWAYS_Y_UP,
    FileKind,
    UpAxis,
    cloud_at,
    facts_of,
    file_rotation,
    instant_of,
    rest_track,
    splat_source,
    write_file,
)
from evsplat.methods.reconstruction import Parts
from evsplat.training.run import Run, load_run

logger = logging.getLogger(__name__)

Kind = Literal[FileKind, "html", "avatar"]
_SUFFIXES: dict[str, tuple[str, ...]] = {
    "ply": (".ply",),
    "spz": (".spz",),
    "splat": (".splat",),
    "gltf": (".glb",),
    "html": (".html",),
    "avatar": ("", ".html"),
}
"""What ``out`` may end in; the first is the default. No suffix: a folder."""


def export_run(
    run: Path | str,
    kind: Kind,
    *,
    out: Path | str | None = None,
    time_s: float | None = None,
    frame: str | None = None,
    canonical: bool = False,
    parts: Parts | None = None,
    camera: str | None = None,
    up: UpAxis | None = None,
    motion: str | None = None,
    fps: float = 24.0,
    device: str = "auto",
) -> Path:
    """Write a run as ``kind`` and return the file.

    ``ply``, ``spz``, ``splat`` and ``gltf`` hold the Gaussians of one instant: ``time_s`` (seconds
    from the first mid-exposure) or the mid-exposure of ``frame``, else the middle of the recording;
    with ``canonical`` the person at rest. Colours are a network's, which sees the direction of
    view; in the file they are those seen from ``camera`` (default: the recording one) at that
    instant. Axes are the capture's unless ``up`` turns them; .spz and .glb are always y up.

    ``html`` is one page that plays the recording (``fps`` pictures per second) in 3D without a
    network; it needs the extra ``view``. ``avatar`` is the person for any browser, to play and to
    pose, with ``motion`` (what `render_run` takes) beside the recorded one: one page where ``out``
    ends in .html, else a folder with the data around it.

    ``parts`` are person and scene or one of them; by default all, of an avatar the person.
    Lengths are metres. Without ``out`` the file goes to ``run/exports/``.
    """
    if kind not in _SUFFIXES:
        raise ConfigError(f"{kind}: unknown format; choose one of {', '.join(_SUFFIXES)}.")
    moving = kind in ("html", "avatar")
    _refuse(moving and (time_s is not None or frame is not None), kind, "--time and --frame")
    _refuse(moving and canonical, kind, "--canonical")
    _refuse(moving and up is not None, kind, "--up")
    _refuse(kind != "avatar" and motion is not None, kind, "--motion")
    if canonical and (time_s is not None or frame is not None):
        raise ConfigError(
            "--canonical is the person at rest, at no time; leave out --time, --frame."
        )
    if parts == "scene" and (canonical or kind == "avatar"):
        raise ConfigError("--parts scene: the scene has no rest pose and no skeleton; use human.")
    target = _checked(out, kind)
    loaded = load_run(Path(run), device=device)
    folder = loaded.path / "exports"
    if kind == "avatar":
        return export_avatar(loaded, target or folder / "avatar", parts or "human", camera, motion)
    if kind == "html":
        return export_clip(loaded, target or folder / "clip.html", parts or "all", camera, fps)
    return _export_instant(loaded, kind, target, time_s, frame, canonical, parts, camera, up)


def _export_instant(
    run: Run,
    kind: FileKind,
    target: Path | None,
    time_s: float | None,
    frame: str | None,
    canonical: bool,
    parts: Parts | None,
    camera: str | None,
    up: UpAxis | None,
) -> Path:
    capture = run.capture
    facts = facts_of(run)
    if canonical:
        gaussians = at_rest(run, camera)
        cloud = cloud_of(gaussians.at_rest())
        rotation = file_rotation(rest_track(gaussians.body), kind, up)
        label, when = (
            "canonical",
            "at rest, colours as their mean over the training frames, without known light",
        )
        facts |= {"pose": "canonical"}
    else:
        rotation = file_rotation(load_body_track(capture), kind, up)
        instant = instant_of(capture, time_s=time_s, frame=frame, camera=camera)
        cloud = cloud_at(splat_source(run), instant, parts or "all")
        which = "" if parts in (None, "all") else f"{parts}-"
        label = f"{which}{instant.label}"
        when = f"at {instant.time_us} us, colours as camera {instant.camera_name} sees them"
        facts |= {"time_us": instant.time_us, "colours_seen_by": instant.camera_name}
    if target is None:
        target = run.path / "exports" / f"{label}{_SUFFIXES[kind][0]}"
    write_file(target, kind, cloud, rotation, facts)
    people = int((cloud.semantic > 0.5).sum())
    upright = "y" if kind in ALWAYS_Y_UP else up
    logger.info(
        "%d Gaussians (person %d, scene %d) %s; metres, %s.",
        len(cloud),
        people,
        len(cloud) - people,
        when,
        "axes of the capture" if upright is None else f"{upright} up",
    )
    return target


def _refuse(given: bool, kind: str, options: str) -> None:
    if given:
        raise ConfigError(f"{options}: format {kind} has no use for it; leave it out.")


def _checked(out: Path | str | None, kind: str) -> Path | None:
    if out is None:
        return None
    path = Path(out)
    endings = _SUFFIXES[kind]
    if path.suffix.lower() not in endings:
        what = " or is a folder (no ending)" if "" in endings else ""
        ending = [e for e in endings if e][0]
        raise ConfigError(f"--out {path}: the format {kind} ends in {ending}{what}.")
    if path.is_dir():
        raise DataError(f"{path}: is a folder that is there already; give another name.")
    return path
