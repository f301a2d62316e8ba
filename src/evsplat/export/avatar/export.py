"""``export avatar``: from a run to a page that plays its person."""

import logging
from dataclasses import asdict
from pathlib import Path

from evsplat.errors import ConfigError, DataError
from evsplat.export.avatar.figure import Clip, clip_of, figure_of, recorded_clip
from evsplat.export.avatar.loss import measure_loss
from evsplat.export.avatar.package import write_avatar
from evsplat.export.gaussians import cloud_at, facts_of, instant_of
from evsplat.film import camera_at, load_motion_of
from evsplat.methods.reconstruction import Bakeable, Parts
from evsplat.models.at_rest import SkinnedGaussians
from evsplat.training.run import Run

logger = logging.getLogger(__name__)


def at_rest(run: Run, camera: str | None) -> SkinnedGaussians:
    """The person's mean over the training frames; colours as ``camera`` (or theirs) sees them."""
    capture = run.capture
    if camera is not None and camera not in capture.cameras:
        known = ", ".join(capture.cameras)
        raise ConfigError(f"--camera {camera}: the capture has no such camera, only {known}.")
    views = [
        (frame.mid_us, camera_at(capture, camera or frame.camera, frame.mid_us))
        for frame in capture.train_frames
    ]
    return bakeable(run).at_rest(views)


def bakeable(run: Run) -> Bakeable:
    """The run's reconstruction, where its person can be taken apart from its poses."""
    if not isinstance(run.reconstruction, Bakeable):
        raise DataError(
            f"{run.path}: method {run.method} has no Gaussians that follow a skeleton; there is no "
            "avatar to export. Use 'evsplat render'."
        )
    return run.reconstruction


def export_avatar(
    run: Run, path: Path, parts: Parts, camera: str | None, motion: str | None
) -> Path:
    """Write the avatar of a run, say what it drops, and return its page."""
    capture, source = run.capture, bakeable(run)
    track = source.track
    clips: list[Clip] = []
    if motion is not None:
        clips.append(clip_of(Path(motion).stem, load_motion_of(motion, track)))
    gaussians = at_rest(run, camera)
    figure = figure_of(gaussians)
    mids = [frame.mid_us for frame in capture.frames]
    clips.insert(0, recorded_clip(source, gaussians, (min(mids), max(mids))))
    loss = measure_loss(source, figure, capture)
    instant = instant_of(capture, time_s=None, frame=None, camera=camera)
    scene = cloud_at(source, instant, "scene") if parts == "all" else None
    facts = {**facts_of(run), "note": loss.sentence(), "loss_db": asdict(loss)}
    facts["low_pass_px2"] = source.low_pass
    page = write_avatar(
        path, figure, clips, track=track, camera=instant.camera, scene=scene, facts=facts
    )
    logger.info("%s", loss.sentence())
    logger.info(
        "%d Gaussians, %d joints, %s; metres, axes of the capture.",
        len(figure.bones),
        len(gaussians.body.parents),
        " and ".join(f"motion {clip.name}" for clip in clips),
    )
    return page
