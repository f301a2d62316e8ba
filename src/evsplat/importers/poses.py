"""Poses that another tool estimated, given to a capture: ``evsplat import poses``."""

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from evsplat.body.pose_errors import PoseSource
from evsplat.body.pose_files import PoseSequence, read_poses
from evsplat.body.pose_files.sequence import moved
from evsplat.body.smpl_skeleton import approximate_rest_joints, rest_pelvis
from evsplat.camera import Camera
from evsplat.capture import Capture, CaptureWriter, load_capture
from evsplat.capture.body_file import BodyFile
from evsplat.capture.check_body import stated_body
from evsplat.capture.derive import Derivation, derived_capture
from evsplat.errors import DataError
from evsplat.files import remove_file
from evsplat.importers.smpl import add_body, chosen_poses, model_file
from evsplat.inspection import warn_of_capture
from evsplat.wording import counted

logger = logging.getLogger(__name__)

Motion = PoseSequence | BodyFile
_OTHER_FOCAL = 0.02
"""Share by which focal lengths differ that is told."""


def attach_poses(
    path: Path | str,
    file: Path | str,
    out: Path | str,
    *,
    person: str | None = None,
    pose_source: PoseSource | None = None,
    smpl: Path | str | None = None,
    overwrite: bool = False,
) -> Path:
    """Write a capture anew with poses of a file in place of any that it has; gives ``out``.

    ``file`` is any that `evsplat.body.pose_files` reads, whose poses belong to the frames by their
    index, or ``body.npz`` of a capture, by its times. Frames that it has no pose for are left out.
    The capture's cameras stay: poses about the camera are put before them, as far away as makes
    them look the same where the tool took another focal length; others are in their world.

    Args:
        path: The capture.
        file: The poses.
        out: The capture to write, whole or not at all.
        person: Choice among several people in the file.
        pose_source: Where the poses come from; by default what the tool is known for.
        smpl: As of `import_capture`.
        overwrite: Replace a capture that is there already.

    Raises:
        DataError: The capture or the file cannot be read, or has no pose of any frame.
    """
    out, file = Path(out), Path(file)
    smpl = None if smpl is None else Path(smpl)
    CaptureWriter(out, overwrite=overwrite)  # refuses what must not be replaced
    capture = load_capture(path, needs_body=False)
    first = capture.camera(capture.frames[0])
    motion = read_motion(file, person, pose_source, (first.width, first.height), smpl)
    middles = np.array([frame.mid_us for frame in capture.frames])
    kept = sorted(frames_with_poses(motion, middles))
    if not kept:
        raise DataError(f"{file}: has no pose of a frame of {path}; give poses of its pictures.")
    notes = []
    if len(kept) < len(middles):
        lacking = counted(len(middles) - len(kept), "frame")
        notes.append(f"left out: {lacking} without a pose")
    if isinstance(motion, PoseSequence):
        motion = chosen_poses(motion, kept)
        if motion.world == "camera":
            motion, moved_by = _before_cameras(motion, capture, kept, smpl)
            notes += moved_by
    with derived_capture(capture, out, replace=overwrite) as making:
        making.keep([capture.frames[index] for index in kept])
        notes += add_motion(making, motion, middles[kept].tolist(), smpl)
        made = {"file": file.name, "notes": notes}
        making.document["provenance"] = {**capture.provenance, "poses": made}
        remove_file(making.folder / "poses.html")  # it shows others
    for note in notes:
        logger.info("%s", note)
    warn_of_capture(out, smpl)
    return out


def read_motion(
    path: Path,
    person: str | None,
    pose_source: PoseSource | None,
    size: tuple[int, int],
    smpl: Path | None,
) -> Motion:
    """Poses of any known tool, or those of a capture's ``body.npz``."""
    if path.name == "body.npz":
        return stated_body(path, pose_source)
    sequence = read_poses(path, person=person, image_size=size, body_models=smpl)
    return replace(sequence, pose_source=pose_source or sequence.pose_source)


def frames_with_poses(motion: Motion | None, middles: Int64[np.ndarray, "N"]) -> set[int]:
    """Indices of pictures whose moment the poses cover; all where there are no poses."""
    if motion is None:
        return set(range(len(middles)))
    if isinstance(motion, PoseSequence):
        return set(motion.frames.tolist()) & set(range(len(middles)))
    first, last = motion.times_us[0], motion.times_us[-1]
    return set(np.flatnonzero((middles >= first - 1) & (middles <= last + 1)).tolist())


def add_motion(
    writer: CaptureWriter | Derivation, motion: Motion, times_us: Sequence[int], smpl: Path | None
) -> list[str]:
    """Give a capture its body; ``times_us`` are those of the sequence's poses. Gives notes."""
    if isinstance(motion, PoseSequence):
        return [*motion.notes, *add_body(writer, times_us, motion, smpl)]
    writer.set_body(
        motion.model,
        motion.times_us,
        motion.poses,
        motion.transl,
        rig=motion.rig,
        betas=motion.betas,
        gender=motion.gender,
        source=motion.source,
        pose_std_rad=motion.pose_std_rad,
        transl_std_m=motion.transl_std_m,
    )
    return []


def _before_cameras(
    sequence: PoseSequence, capture: Capture, frames: Sequence[int], smpl: Path | None
) -> tuple[PoseSequence, list[str]]:
    """Poses about the camera as poses in the capture's world, and a note on another focal length.

    The root is moved along its ray by the ratio of the focal lengths, so that the person looks as
    large as the tool saw them.
    """
    model, gender = sequence.model, sequence.gender
    known = model_file(smpl, model, gender)
    pelvis = (
        approximate_rest_joints(model)[0]
        if known is None
        else rest_pelvis(model, sequence.betas, gender, body_models=known, source=sequence.source)
    )
    cameras = [capture.camera(capture.frames[index]) for index in frames]
    poses = np.stack([camera.world_to_camera.double().numpy() for camera in cameras])
    places, note = _seen_alike(sequence, cameras, pelvis + sequence.transl)
    back = poses[:, :3, :3].swapaxes(1, 2)
    shift = -(back @ poses[:, :3, 3:])[..., 0]
    turned, transl = moved(sequence.poses, places - pelvis, back, shift, pelvis)
    return replace(sequence, poses=turned, transl=transl, world="calibration"), note


def _seen_alike(
    sequence: PoseSequence, cameras: Sequence[Camera], places: np.ndarray
) -> tuple[np.ndarray, list[str]]:
    """Places in camera axes at which the capture's cameras see what the tool's camera saw."""
    if sequence.K is None:
        return places, []
    own = np.stack([camera.K.double().numpy() for camera in cameras])
    ratio = own[:, 1, 1] / sequence.K[1, 1]
    rays = np.linalg.solve(own, (places @ sequence.K.T)[..., None])[..., 0]
    note = []
    if abs(float(ratio[0]) - 1) > _OTHER_FOCAL:
        note.append(
            f"poses: of a focal length of {sequence.K[1, 1]:.0f} px, and the camera has "
            f"{own[0, 1, 1]:.0f} px, so the person stands {ratio[0]:.2f} times as far away"
        )
    return rays * ratio[:, None], note
