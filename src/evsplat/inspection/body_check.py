"""Warnings about a body that does not belong to its recording; its outline over what moves."""

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float
from PIL import Image, ImageDraw
from torch import Tensor

from evsplat.body import BodyTrack, track_silhouette
from evsplat.camera import Camera
from evsplat.capture import Capture, Frame, TrainingCapture, load_body_track
from evsplat.capture.finding import Finding, Findings
from evsplat.commands import command
from evsplat.errors import DataError
from evsplat.events import count_map
from evsplat.inspection.belonging import Belonging, judge_body
from evsplat.inspection.drawing import (
    DETAIL_PX,
    Tile,
    draw_outline,
    events_over,
    fit,
    save_drawings,
    sheet,
    to_picture,
)
from evsplat.inspection.elsewhere import EXPECTED, REMEDY
from evsplat.inspection.movement import event_window
from evsplat.pictures import shown
from evsplat.spread import evenly_spread

logger = logging.getLogger(__name__)

_TILES = 8
_GIVEN, _BEST, _ELSEWHERE = (60, 255, 120), (255, 225, 80), (255, 110, 220)
FIT_SHEET = "body_fit"
"""Name of the picture."""


def check_body(
    capture: TrainingCapture, *, refuse: bool, body_models: Path | None = None
) -> Belonging:
    """Judge the body that a training is given; a right one is said nothing of.

    ``body_models`` is as of `evsplat.capture.body_track.load_body`.

    Raises:
        DataError: a body that is in no training picture; with ``refuse``, also one that follows
            nothing of what moves.
    """
    found = judge_body(capture, load_body_track(capture, body_models=body_models))
    if found.in_no_training_frame:
        raise DataError(
            f"{capture.body_file.path}: the posed body is in none of the "
            f"{len(capture.train_frames)} training pictures, expected it in view of the camera; "
            f"correct poses or camera ({command('inspect', capture.path)} draws them)."
        )
    if found.verdict == "another" and refuse:
        raise DataError(
            f"{capture.body_file.path}: {found.sentence}; give the body of this recording "
            f"({command('inspect', capture.path)} draws it), or pass --any-body to train on this "
            "one."
        )
    if found.verdict != "belongs":
        logger.warning("%s: %s.", capture.body_file.path, found.sentence)
    for finding in _elsewhere_findings(found):
        logger.warning("%s", finding)
    if found.in_no_held_out_frame:
        logger.warning("%s: the person is in no test frame; check camera and poses.", capture.path)
    return found


def body_findings(capture: TrainingCapture, found: Belonging) -> list[Finding]:
    """A warning where the body does not belong to the recording, or cannot be judged."""
    findings = Findings()
    if found.verdict != "belongs":
        findings.warning(
            capture.body_file.path,
            "",
            found.sentence,
            "a body whose outline lies on what moves",
            f"Look at {FIT_SHEET}.png; correct poses, their times, or the camera.",
        )
    return findings.items + _elsewhere_findings(found)


def _elsewhere_findings(found: Belonging) -> list[Finding]:
    """A warning where something else moves than the person."""
    findings = Findings()
    if found.elsewhere is not None:
        folder = found.frames[0].image.parent
        findings.warning(folder, "", found.elsewhere.sentence, EXPECTED, REMEDY)
    return findings.items


def body_mask_overlap(capture: Capture, track: BodyTrack, frames: Sequence[Frame]) -> list[float]:
    """Intersection over union of posed body and person mask, for the frames that have a mask.

    Frames with neither in the picture, as after somebody has left, tell nothing and are passed
    over.
    """
    overlaps = []
    for frame in frames:
        mask = capture.mask(frame)
        if mask is not None:
            body = track_silhouette(track, frame.mid_us, capture.camera(frame)).numpy()
            person = mask.numpy() > 0.5
            if (either := int((body | person).sum())) > 0:
                overlaps.append(float((body & person).sum() / either))
    return overlaps


def save_fit_sheet(capture: TrainingCapture, found: Belonging, folder: Path) -> Path:
    """Write `fit_sheet` into a folder; gives the file."""
    return save_drawings({FIT_SHEET: fit_sheet(capture, found)}, folder)[0]


def fit_sheet(capture: TrainingCapture, found: Belonging) -> Image.Image:
    """The body's outline over events about mid-exposure, or over pictures where there are none.

    Green where it is; yellow where it would fit best, if that is elsewhere. What else moves is in a
    pink box.
    """
    track = load_body_track(capture)
    tiles = []
    for frame in evenly_spread(found.frames, _TILES):
        camera = capture.camera(frame)
        size = fit(camera.width, camera.height, DETAIL_PX)
        picture = to_picture(_moving(capture, frame), size)
        if found.verdict == "off":
            _outline(picture, track, frame.mid_us + found.delay_us, camera, found.shift_px, _BEST)
        _outline(picture, track, frame.mid_us, camera, (0.0, 0.0), _GIVEN)
        if found.elsewhere is not None:
            scale = picture.width / camera.width
            box = [side * scale for side in found.elsewhere.box_px]
            ImageDraw.Draw(picture).rectangle(box, outline=_ELSEWHERE, width=2)
        tiles.append(Tile(picture, f"{frame.name}   {frame.mid_us / 1e6:.3f} s", frame.split))
    said = "posed body (green) over what moves"
    if found.verdict == "off":
        said = f"posed body (green), {found.place} what moves; where it would fit best (yellow)"
    if found.elsewhere is not None:
        said += f"; what else moves, {found.elsewhere.where} (pink)"
    return sheet(f"{capture.name}: fit of the body", said, tiles, columns=4)


def _moving(capture: TrainingCapture, frame: Frame) -> Float[Tensor, "H W 3"]:
    image = shown(capture.image(frame), capture.transfer(frame))
    if capture.events is None:
        return image
    return events_over(image, count_map(event_window(capture.events, frame), *image.shape[:2]))


def _outline(
    picture: Image.Image,
    track: BodyTrack,
    time_us: int,
    camera: Camera,
    shift_px: tuple[float, float],
    colour: tuple[int, int, int],
) -> None:
    """Draw the body at a time, moved right and down, on a picture of any size."""
    K = camera.K.clone()
    K[:2, 2] += torch.tensor(shift_px)
    drawn = replace(camera, K=K).resized(picture.width, picture.height)
    draw_outline(picture, track_silhouette(track, time_us, drawn).numpy(), colour)
