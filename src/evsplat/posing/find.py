"""`evsplat poses`: from a capture without body poses to one with them."""

import logging
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

import evsplat
from evsplat.body import Body, BodyTrack
from evsplat.body.make import rig_arrays
from evsplat.body.smpl import smpl_body
from evsplat.camera import Camera
from evsplat.capture import Capture, Frame, Policy, TrainingCapture, load_capture
from evsplat.capture.derive import Derivation, derived_capture
from evsplat.commands import command
from evsplat.config import to_dict
from evsplat.errors import ConfigError
from evsplat.files import refuse_existing, try_target, write_text
from evsplat.landmarks import (
    LandmarkNetwork,
    Landmarks,
    SharpPicture,
    find_landmarks,
    read_keypoints,
    sharp_pictures,
)
from evsplat.options import PoseSearch
from evsplat.options.declare import given
from evsplat.posing.bridging import bridged
from evsplat.posing.fit import FocalFit, PoseFit, fit_focal, fit_landmarks
from evsplat.posing.page import poses_page
from evsplat.posing.problem import FitSettings
from evsplat.posing.refine import FOUND_STEPS, Refined, refine
from evsplat.posing.rig import Rig, default_rig, make_rig
from evsplat.wording import counted

logger = logging.getLogger(__name__)

_USUAL_FOCAL = 1.0
"""Focal length from which `--focal auto` begins, in longer sides of the pictures."""
_FRAME_S = 3.0
"""Time for the refinement, per frame."""
_BETAS = 10
_QUARTERS = (0.25, 0.5, 0.75)


@dataclass(frozen=True, eq=False)
class FoundPoses:
    """Poses found in a capture, and the way to them."""

    path: Path
    """The capture with them."""
    track: BodyTrack = field(repr=False)
    """Key poses at all frames and at the quarters between, with their errors."""
    fitted: PoseFit = field(repr=False)
    """The motion behind them."""
    landmarks: Landmarks = field(repr=False)
    seconds: dict[str, float]
    """By stage: landmarks, with the pictures that they are in, fit, refinement."""
    summary: str
    """Some lines of text."""


@dataclass
class _Stages:
    """Progress bar and stop watch of the stages."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def __call__(self, bar: Any, name: str) -> Iterator[None]:
        bar.set_postfix_str(name)
        start = time.perf_counter()
        yield
        self.seconds[name] = time.perf_counter() - start
        bar.update()


def find_poses(
    path: Path | str,
    out: Path | str,
    search: PoseSearch | None = None,
    *,
    keypoints: Path | str | None = None,
    policy: Policy | None = None,
    overwrite: bool = False,
    warn: bool = True,
    **changes: Any,
) -> FoundPoses:
    """Find the person's poses in a capture and write a new one with them, whole or not at all.

    Landmarks on sharpened pictures (`evsplat.landmarks`; or the key points of a file), and a motion
    fitted to them (`fit_landmarks`), corrected by drawing the person (`refine`), which is taken
    where it explains pictures better that it has not seen. Frames before the person enters, after
    they have left and while they are away are left out. Of the capture is seen what its policy
    shows: by default no picture, mask or event of a held-out interval. Poses that the capture has
    are ignored; its true poses between keys, of another body, are left out of the new one.
    ``poses.html`` in the new capture shows what was found. ``overwrite`` replaces a folder that is
    at ``out``; ``warn`` as of `load_capture`; ``changes`` are options of `PoseSearch`.

    Raises:
        ConfigError: An option is out of range.
        DataError: ``out`` exists, or no person, or too little of one, is found.
        WeightsError: The body model or the network's weights are missing.
    """
    search = given(PoseSearch, search, changes)
    out = Path(out)
    if not overwrite:
        refuse_existing(out)
    try_target(out)
    rig = _rig(search.body)
    capture = load_capture(path, needs_body=False, warn=warn)
    policy = policy or Policy(use=search.use, held_out_events=search.held_out_events)
    stages = _Stages()
    motion = _found(capture, policy, rig, search, keypoints, stages)
    made = {
        "from": "key points of a file" if keypoints else "landmarks of BlazePose",
        **to_dict(search),
        **motion.made(),
        "evsplat": evsplat.__version__,
    }
    landmarks, fitted, track = motion.landmarks, motion.fitted, motion.track
    with derived_capture(capture, out, replace=overwrite) as making:
        shown = {frame.name for frame in motion.seen.frames}
        if len(shown) < len(capture.frames):
            making.keep([frame for frame in capture.frames if frame.name in shown])
        _write_body(making, track, fitted, motion.dressed)
        if motion.focal_px is not None:
            _set_focal(making, motion.focal_px)
        making.document["provenance"] = {**capture.provenance, "poses": made}
        page = poses_page(
            capture.name, motion.seen, motion.pictures, landmarks, track, fitted, made
        )
        write_text(making.folder / "poses.html", page)
    said = _summary(out, track, motion, stages.seconds)
    return FoundPoses(out, track, fitted, landmarks, stages.seconds, said)


@dataclass(frozen=True, eq=False)
class _Motion:
    """What was found, before any of it is written."""

    seen: TrainingCapture
    """The recording through the camera that it was found with."""
    pictures: Sequence[SharpPicture]
    landmarks: Landmarks
    fitted: PoseFit
    track: BodyTrack
    refined: Refined | None
    """None where nothing was refined."""
    dressed: Body | None
    """The body with what it wears, where that is known and ours to write."""
    focal_px: float | None
    """None where the capture's camera says it."""
    focal: FocalFit | None
    """Where it was fitted."""

    def made(self) -> dict[str, Any]:
        """What the provenance says of it."""
        said: dict[str, Any] = {
            "pictures": len(self.landmarks.times_us),
            "in_doubt": [doubt.part for doubt in self.fitted.doubts],
            "policy": to_dict(self.seen.policy),
        }
        if self.refined is not None:
            gain, seconds = round(self.refined.gain, 4), round(self.refined.seconds, 1)
            taken = self.refined.better
            said["refinement"] = {"gain": gain, "taken": taken, "seconds": seconds}
        if self.focal_px is not None:
            said["focal_px"] = round(self.focal_px, 2)
        if self.focal is not None:
            said["focal_std_share"] = round(self.focal.std_share, 3)
        return said


def _found(
    capture: Capture,
    policy: Policy,
    rig: Rig,
    search: PoseSearch,
    keypoints: Path | str | None,
    stages: _Stages,
) -> _Motion:
    """Landmarks, the motion fitted to them, and its refinement."""
    focal: FocalFit | None = None
    focal_px = _first_focal(capture) if search.focal == "auto" else search.focal_px
    seen = _seen(capture, policy, focal_px)
    limit_s = _refinement_s(seen, search)
    with tqdm(total=2 + (limit_s > 0), desc="poses", unit="stage") as bar:
        with stages(bar, "landmarks"):
            pictures = sharp_pictures(seen)
            landmarks = _landmarks(seen, pictures, keypoints)
            looked_at, told = pictures, landmarks
            if keypoints is not None:
                # a file tells of training frames alone, and has rows of those without anybody
                looked_at = [one for one in pictures if one.frame.split == "train"]
                told = landmarks.of_pictures(np.asarray(landmarks.seen.any(1)))
            shown = _with_somebody(capture, looked_at, told, nobody_in_between=keypoints is None)
            if shown is not capture:
                capture, seen = shown, _seen(shown, policy, focal_px)
                kept_us = [frame.mid_us for frame in seen.train_frames]
                if keypoints is not None:
                    landmarks = landmarks.of_pictures(np.isin(landmarks.times_us, kept_us))
        with stages(bar, "fit"):
            fitted = _fit(seen, landmarks, rig, search)
            if search.focal == "auto":
                assert focal_px is not None
                focal = fit_focal(fitted, focal_px)
                focal_px, fitted = focal.focal_px, focal.fit
                seen = _seen(capture, policy, focal_px)
                logger.warning("%s", _rough(focal))
        track = fitted.track(key_times(seen))
        shown_us = landmarks.times_us[landmarks.seen.any(1)].tolist()
        refined: Refined | None = None
        dressed: Body | None = None
        if limit_s > 0:
            with stages(bar, "refinement"):
                refined = refine(track, seen, seconds=limit_s, progress=True, steps=FOUND_STEPS)
            if refined.better:
                track = refined.track
                names = {frame.name for frame in seen.frames}
                shown_us = [one.time_us for one in pictures if one.frame.name in names]
                if rig.model == "default":  # the vertices of a licensed model are not ours to write
                    dressed = refined.dressed
                    track = track.with_body(dressed)
        track = bridged(track, shown_us)
    return _Motion(seen, pictures, landmarks, fitted, track, refined, dressed, focal_px, focal)


def _first_focal(capture: Capture) -> float:
    camera = capture.camera(capture.frames[0])
    return _USUAL_FOCAL * max(camera.width, camera.height)


def _landmarks(
    capture: TrainingCapture, pictures: Sequence[SharpPicture], keypoints: Path | str | None
) -> Landmarks:
    """Of the network; or those of a file, which has a row for each frame, at training frames."""
    if keypoints is None:
        return find_landmarks(capture, pictures, network=LandmarkNetwork())
    frames = sorted(capture.frames, key=lambda frame: frame.mid_us)
    points = read_keypoints(keypoints, [frame.mid_us for frame in frames])
    points = _as_read(capture, frames, points)
    # Those of held-out frames were found in pictures that are not to be seen.
    return points.of_pictures(np.array([frame.split == "train" for frame in frames]))


def _as_read(capture: TrainingCapture, frames: Sequence[Frame], points: Landmarks) -> Landmarks:
    """Points of the pictures as recorded, in those that are read, whose lens does not distort."""
    pairs = zip(frames, points.places, strict=True)
    places = np.stack([capture.undistort(frame.camera, found) for frame, found in pairs])
    inside = np.isfinite(places).all(-1)
    places = np.where(inside[..., None], places, 0.0)
    return replace(points, places=places, seen=np.where(inside, points.seen, 0.0))


def _with_somebody(
    capture: Capture,
    pictures: Sequence[SharpPicture],
    landmarks: Landmarks,
    *,
    nobody_in_between: bool,
) -> Capture:
    """Without the frames before the person enters, and after they have left.

    With ``nobody_in_between`` those between others that show nobody are left out as well; in a
    file of key points somebody may only have been missed there, and poses follow from the rest.
    """
    looked_at = {picture.frame.name for picture in pictures}
    times = set(landmarks.times_us.tolist())
    told = {picture.frame.name for picture in pictures if picture.time_us in times}
    frames = sorted(capture.frames, key=lambda frame: frame.mid_us)
    runs = [(shows, list(run)) for shows, run in groupby(frames, lambda one: one.name in told)]
    empty: set[str] = set()
    said = []
    for index, (shows, run) in enumerate(runs):
        at_an_end = index in (0, len(runs) - 1)
        if shows or not told or not (at_an_end or nobody_in_between):
            continue
        if any(frame.name in looked_at for frame in run):
            empty |= {frame.name for frame in run}
            when = "before the person enters" if index == 0 else "after they have left"
            when = when if at_an_end else "while they are away"
            said.append(f"{counted(len(run), 'frame')} {when} ({_from_to(run)})")
    if not empty:
        return capture
    logger.warning("images: nobody is seen in %s, which are left out.", ", ".join(said))
    return capture.of_frames([frame for frame in capture.frames if frame.name not in empty])


def _from_to(frames: Sequence[Frame]) -> str:
    first, last = frames[0].name, frames[-1].name
    return first if first == last else f"{first} to {last}"


def key_times(capture: TrainingCapture) -> list[int]:
    """Times of key poses: each mid-exposure, the quarters between, and where the recording ends."""
    mids = np.unique([frame.mid_us for frame in capture.frames])
    between = [mids[:-1] + share * np.diff(mids) for share in _QUARTERS]
    times = np.concatenate([mids, *between, _span(capture)]).round().astype(np.int64)
    return np.unique(times).tolist()


def _span(capture: TrainingCapture) -> tuple[int, int]:
    exposures = [frame.exposure_us for frame in capture.frames]
    return min(start for start, _ in exposures), max(end for _, end in exposures)


def _rig(model: str) -> Rig:
    if model == "default":
        return default_rig()
    return make_rig(lambda betas: smpl_body("smpl", betas), "smpl", _BETAS)


def _seen(capture: Capture, policy: Policy, focal_px: float | None) -> TrainingCapture:
    """What a policy shows of a capture; with a focal length where one is given."""
    return (capture if focal_px is None else capture.with_focal(focal_px)).for_training(policy)


def _refinement_s(capture: TrainingCapture, search: PoseSearch) -> float:
    """Time for the refinement, 0 for none; a moving camera has none, as it needs a background."""
    if capture.is_static_camera:
        return _FRAME_S * len(capture.frames) if search.refine_s is None else search.refine_s
    if search.refine_s:
        raise ConfigError(
            f"--refine {search.refine_s:g}: {capture.path} has a moving camera or several, and "
            "poses are corrected by what differs from a background that stands still; leave it out."
        )
    return 0.0


def _fit(capture: TrainingCapture, landmarks: Landmarks, rig: Rig, search: PoseSearch) -> PoseFit:
    cameras = _cameras(capture, landmarks.times_us.tolist())
    settings = FitSettings(height_m=search.height_m)
    return fit_landmarks(landmarks, cameras, _span(capture), rig=rig, settings=settings)


def _rough(focal: FocalFit) -> str:
    return (
        f"focal length: {focal.focal_px:.0f} pixels by the person's own perspective, give or take "
        f"{focal.std_share:.0%}, and the distance with it; --focal PX of a calibration, or of the "
        "EXIF data of a picture taken alike, is better."
    )


def _cameras(capture: TrainingCapture, times_us: Sequence[int]) -> list[Camera]:
    """The camera of the training frame nearest to each time.

    Of frames of one time, as cameras with one trigger have, each has its turn.
    """
    frames = sorted(capture.train_frames, key=lambda frame: frame.mid_us)
    mids = np.array([frame.mid_us for frame in frames])
    cameras: list[Camera] = []
    turns: Counter[int] = Counter()
    for time_us in times_us:
        apart = np.abs(mids - time_us)
        alike = np.flatnonzero(apart == apart.min())
        cameras.append(capture.camera(frames[int(alike[turns[time_us] % len(alike)])]))
        turns[time_us] += 1
    return cameras


def _write_body(
    making: Derivation, track: BodyTrack, fitted: PoseFit, dressed: Body | None
) -> None:
    """With the surface of ``dressed`` as a rig of its own, else as shape coefficients."""
    assert track.errors is not None
    model = fitted.rig.model if dressed is None else "rig"
    making.set_body(
        model,
        track.times_us,
        track.poses,
        track.transl,
        betas=fitted.betas if dressed is None else None,
        rig=None if dressed is None else rig_arrays(dressed),
        gender="neutral" if model == "smpl" else None,
        source="estimated",
        pose_std_rad=track.errors.joint_rad,
        transl_std_m=track.errors.root_m,
    )


def _set_focal(making: Derivation, focal_px: float) -> None:
    for name in {frame.camera for frame in making.source.frames}:
        K = making.document["cameras"][name]["K"]
        K[0][0] = K[1][1] = focal_px


def _summary(out: Path, track: BodyTrack, motion: _Motion, seconds: dict[str, float]) -> str:
    # a frame has several sharpened pictures
    times = set(motion.landmarks.times_us.tolist())
    frames = {one.frame.name for one in motion.pictures if one.time_us in times}
    stages = ", ".join(f"{name} {value:.0f} s" for name, value in seconds.items())
    return (
        f"written: {out} ({counted(len(track.times_us), 'key pose')} from "
        f"{counted(len(frames), 'frame')}; {stages})\nlook at it: {out / 'poses.html'}\n"
        f"then: {command('train', out)}"
    )
