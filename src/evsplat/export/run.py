"""`export_run`: a trained run as a file for other programs."""

import logging
from pathlib import Path
from typing import Any

from evsplat.capture import load_body_track
from evsplat.errors import ConfigError, DataError
from evsplat.export.bake import at_rest, export_avatar
from evsplat.export.clip import export_clip
from evsplat.export.cloud import cloud_of
from evsplat.export.gaussians import (
    ALWAYS_Y_UP,
    cloud_at,
    facts_of,
    file_rotation,
    instant_of,
    rest_track,
    write_file,
)
from evsplat.export.low_pass import VIEWERS_LOW_PASS, for_viewer
from evsplat.export.skeleton import export_motion
from evsplat.files import refuse_existing, try_target
from evsplat.options import ExportOptions
from evsplat.options.declare import given
from evsplat.options.runs import FileKind, Kind
from evsplat.training.run import Run, folder_of, opened

logger = logging.getLogger(__name__)

_SUFFIXES: dict[Kind, tuple[str, ...]] = {
    "ply": (".ply",),
    "spz": (".spz",),
    "splat": (".splat",),
    "gltf": (".glb",),
    "html": (".html",),
    "avatar": ("", ".html"),
    "bvh": (".bvh",),
    "skeleton": (".glb",),
}
"""Endings that ``out`` may have; the first is the default. No ending: a folder."""
_CLIP_FPS = 24.0


def export_run(
    run: Run | Path | str, kind: Kind, options: ExportOptions | None = None, **changes: Any
) -> Path:
    """Write a run as ``kind`` and return the file; ``changes`` are fields of `ExportOptions`.

    ``run``: its folder, or what `load_run` read of it.
    ``ply``, ``spz``, ``splat`` and ``gltf`` hold the Gaussians of one instant: ``time_s`` (seconds
    from the first mid-exposure) or the mid-exposure of ``frame``, else the middle of the recording;
    with ``canonical`` the person at rest. Colours are a network's, which sees the direction of
    view; in the file they are those seen from ``camera`` (default: the recording one) at that
    instant. Axes are the capture's unless ``up`` turns them; .spz and .glb are always y up.

    A viewer that adds ``low_pass`` px^2 (default: `VIEWERS_LOW_PASS`) to each Gaussian shows what
    training saw, at the size and the distance of that camera.

    ``html`` is one page that plays the recording (``fps`` pictures per second) in 3D without a
    network; it needs the extra ``view``. ``avatar`` is the person for any browser, to play and to
    pose, with ``motion`` (what `render_run` takes) beside the recorded one: one page where ``out``
    ends in .html, else a folder with the data around it. ``bvh`` and ``skeleton`` (glTF) hold the
    motion alone: the recorded one as the method corrected it, or ``motion``; metres, y up.

    ``parts`` are person and scene or one of them; by default all, of an avatar the person.
    Lengths are metres. Without ``out`` the file goes to ``run/exports/``.

    Raises:
        ConfigError: an unknown ``kind``, or an option that is out of range or of no use to it.
        DataError: no run that can be read, or a folder where the file shall be.
    """
    if kind not in _SUFFIXES:
        raise ConfigError(f"{kind}: unknown format; choose one of {', '.join(_SUFFIXES)}.")
    options = given(ExportOptions, options, changes)
    parts, camera = options.parts, options.camera
    _check_use(kind, options)
    target = _checked(options.out, kind)
    folder = folder_of(run) / "exports"
    try_target(target or folder)
    avatar = target or folder / "avatar"
    if kind == "avatar" and not avatar.suffix:
        refuse_existing(avatar)  # before minutes of work, whose folder is a new one
    loaded = opened(run, device=options.device)
    if kind == "avatar":
        return export_avatar(loaded, avatar, parts or "human", camera, options)
    if kind == "bvh" or kind == "skeleton":
        name = "recorded" if options.motion is None else Path(options.motion).stem
        file = target or folder / f"{name}{_SUFFIXES[kind][0]}"
        return export_motion(loaded, file, kind, options)
    if kind == "html":
        page = target or folder / "clip.html"
        return export_clip(loaded, page, parts or "all", camera, options.fps or _CLIP_FPS)
    return _export_instant(loaded, kind, target, options)


def _export_instant(run: Run, kind: FileKind, target: Path | None, options: ExportOptions) -> Path:
    capture, parts = run.capture, options.parts
    facts = facts_of(run)
    if options.canonical:
        gaussians = at_rest(run, options.camera)
        cloud = cloud_of(gaussians.at_rest(), seen=run.reconstruction.certainties())
        rotation = file_rotation(rest_track(gaussians.body), kind, options.up)
        label, when = (
            "canonical",
            "at rest, colours as their mean over the training frames, without known light",
        )
        facts |= {"pose": "canonical"}
    else:
        rotation = file_rotation(load_body_track(capture), kind, options.up)
        instant = instant_of(
            capture, time_s=options.time_s, frame=options.frame, camera=options.camera
        )
        source = run.reconstruction.elsewhere()
        cloud = cloud_at(source, instant.camera, instant.time_us, parts or "all")
        viewers = VIEWERS_LOW_PASS if options.low_pass is None else options.low_pass
        cloud = for_viewer(cloud, instant.camera, source.low_pass, viewers)
        which = "" if parts in (None, "all") else f"{parts}-"
        label = f"{which}{instant.label}"
        when = f"at {instant.time_us} us, colours as camera {instant.camera_name} sees them"
        facts |= {"time_us": instant.time_us, "colours_seen_by": instant.camera_name}
        facts |= {"viewer_low_pass_px2": viewers}
    if target is None:
        target = run.path / "exports" / f"{label}{_SUFFIXES[kind][0]}"
    cloud = cloud.shown(capture.transfer(capture.frames[0]))
    write_file(target, kind, cloud, rotation, facts)
    human = int((cloud.semantic > 0.5).sum())
    upright = "y" if kind in ALWAYS_Y_UP else options.up
    logger.info(
        "%d Gaussians (person %d, scene %d) %s; metres, %s.",
        len(cloud),
        human,
        len(cloud) - human,
        when,
        "axes of the capture" if upright is None else f"{upright} up",
    )
    return target


def _check_use(kind: Kind, options: ExportOptions) -> None:
    """Refuse options that a format has no use for."""
    skeletal = kind in ("bvh", "skeleton")
    moving = kind in ("html", "avatar") or skeletal
    unused = {
        "--time": moving and options.time_s is not None,
        "--frame": moving and options.frame is not None,
        "--canonical": moving and options.canonical,
        "--up": moving and options.up is not None,
        "--low-pass": moving and options.low_pass is not None,
        "--motion": kind != "avatar" and not skeletal and options.motion is not None,
        "--fps": kind != "html" and options.fps is not None,
        "--parts": skeletal and options.parts is not None,
        "--camera": skeletal and options.camera is not None,
    }
    for name, given_in_vain in unused.items():
        if given_in_vain:
            raise ConfigError(f"{name}: format {kind} has no use for it; leave it out.")
    if options.parts == "scene" and (options.canonical or kind == "avatar"):
        raise ConfigError("--parts scene: the scene has no rest pose and no skeleton; use human.")


def _checked(out: Path | str | None, kind: Kind) -> Path | None:
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
