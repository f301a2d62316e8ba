"""Turning other people's data sets, and your own recording, into captures."""

import logging
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from evsplat.capture.masked import masks_command
from evsplat.capture.write import CaptureWriter
from evsplat.commands import command
from evsplat.errors import ConfigError
from evsplat.files import remove_folder
from evsplat.importers.base import Importer
from evsplat.importers.davis import Davis
from evsplat.importers.folder import Folder
from evsplat.importers.mmhpsd import Mmhpsd
from evsplat.importers.neuman import Neuman
from evsplat.importers.people_snapshot import PeopleSnapshot
from evsplat.importers.poses import attach_poses
from evsplat.importers.video import Video
from evsplat.importers.zju_mocap import ZjuMocap
from evsplat.importers.zju_mocap_blur import ZjuMocapBlur
from evsplat.inspection import warn_of_capture
from evsplat.landmarks.keypoint_files import read_points
from evsplat.options import PoseOptions, PoseSearch
from evsplat.options.declare import given

__all__ = ["KINDS", "Blur", "attach_poses", "import_capture", "run_importer"]

logger = logging.getLogger(__name__)

KINDS: dict[str, type[Importer]] = {
    "folder": Folder,
    "video": Video,
    "davis": Davis,
    "zju-mocap": ZjuMocap,
    "mmhpsd": Mmhpsd,
    "neuman": Neuman,
    "people-snapshot": PeopleSnapshot,
    "zju-mocap-blur": ZjuMocapBlur,
}


@dataclass(frozen=True)
class Blur:
    """The step from an import to blurry frames; None: as the recipe of the paper says."""

    interpolation: str | None = None
    """"super-slomo" or "flow"."""
    weights: Path | None = None
    """Checkpoint of Super SloMo."""


def import_capture(
    kind: str,
    source: Path | str,
    out: Path | str,
    *,
    smpl: Path | str | None = None,
    overwrite: bool = False,
    blur: Blur | bool = False,
    find_poses: PoseOptions | bool = False,
    keypoints: Path | str | None = None,
    **options: Any,
) -> Path:
    """Turn a data set's sequence into a capture and give its folder (docs/import.md).

    Args:
        kind: One of `KINDS`.
        source: The folder of one sequence.
        out: The capture to write; it appears when it is whole and valid.
        smpl: The user's SMPL file, or the folder that holds it; by default what the environment
            variable EVSPLAT_BODY_MODELS leads to. Without a model the free body is used.
        overwrite: Replace a capture that is there already.
        blur: Go on to the paper's version of the data set, with blurry frames and simulated events
            (`evsplat.synthesize`); the sharp capture stays beside it as ``<out>_sharp``.
        find_poses: Find the person's poses (`evsplat.find_poses`), whatever poses there are.
            Where none are found, a capture without them stays as ``<out>_unposed``.
        keypoints: A file of key points to find them by, a row for each frame of the capture.
        options: Fields of the kind's class in `KINDS`.

    Raises:
        DataError: The source is not what the kind says it is.
        ConfigError: An unknown kind or option, or a value out of range.
    """
    if kind not in KINDS:
        near = get_close_matches(kind, KINDS, 1, cutoff=0.0)[0]
        raise ConfigError(f"{kind!r} is no kind of source; did you mean {near!r}?")
    chosen = (Blur() if blur else None) if isinstance(blur, bool) else blur
    poses = (PoseOptions() if find_poses else None) if isinstance(find_poses, bool) else find_poses
    if keypoints is not None and poses is None:
        raise ConfigError(
            f"keypoints {keypoints}: no poses are to be found by them; leave them out, or give "
            "find_poses=True as well."
        )
    importer = given(KINDS[kind], None, options)
    return run_importer(
        importer,
        source,
        out,
        smpl=smpl,
        overwrite=overwrite,
        blur=chosen,
        poses=poses,
        keypoints=None if keypoints is None else Path(keypoints),
    )


def run_importer(
    importer: Importer,
    source: Path | str,
    out: Path | str,
    *,
    smpl: Path | str | None = None,
    overwrite: bool = False,
    blur: Blur | None = None,
    poses: PoseOptions | None = None,
    keypoints: Path | None = None,
) -> Path:
    """`import_capture` with the options as a checked object; errors are the same."""
    source, out = Path(source), Path(out)
    smpl = None if smpl is None else Path(smpl)
    if blur is not None and importer.blur_recipe is None:
        raise ConfigError(
            f"the pictures of {type(importer).__name__} are not made blurry by a recipe of the "
            "paper; import them and use 'evsplat synthesize'."
        )
    if blur is not None and poses is not None:
        raise ConfigError(
            f"{source}: is to be made blurry and its poses are to be found; import it without "
            "finding them, then use 'evsplat poses'."
        )
    # an existing target is better found before the long work than after it
    CaptureWriter(out, overwrite=overwrite)
    if poses is not None:
        importer = replace(importer, no_poses=True)
        if keypoints is not None:
            read_points(keypoints)  # a bad file is better found before the long work, too
        _import_and_pose(importer, source, out, smpl, poses, keypoints, overwrite=overwrite)
    elif blur is not None:
        _import_and_blur(importer, source, out, smpl, blur, overwrite=overwrite)
    else:
        _import(importer, source, CaptureWriter(out, overwrite=overwrite, gains=True), smpl)
    warn_of_capture(out, smpl)
    return out


def _import(
    importer: Importer,
    source: Path,
    target: CaptureWriter,
    smpl: Path | None,
    *,
    on_to: Path | None = None,
) -> None:
    """``on_to``: the capture that is made of this one next, with poses; this one does not stay."""
    with target as writer:
        notes = importer.write(source, writer, smpl)
        if importer.no_poses and writer.has_body:
            notes = [note for note in notes if not note.startswith("body:")]
            writer.leave_out_body()
        factor = writer.find_gains()
        if factor > 1:
            notes.append(
                f"light: the camera made some pictures {factor:.2f} times as bright as others; "
                "each has its gain in capture.json, and is read as if the camera had not"
            )
        found, frames = writer.with_mask
        if importer.brings_masks and found < frames:
            find = masks_command(on_to or writer.path, static_camera=not writer.camera_moves)
            notes.append(
                f"masks: {frames - found} of {frames} pictures have none where the data set keeps "
                f"them (docs/import.md); find the person with: {find}"
            )
        if not writer.has_body and on_to is None:
            find = command("poses", writer.path, "--out", "NEW")
            notes.append(f"body: none; find the person's poses with: {find}")
    for note in notes:
        logger.info("%s", note)


def _import_and_blur(
    importer: Importer,
    source: Path,
    out: Path,
    smpl: Path | None,
    blur: Blur,
    *,
    overwrite: bool,
) -> None:
    """By way of the sharp capture beside ``out``, which stays, also where it cannot be blurred."""
    from evsplat.synthesis import synthesize

    sharp = out.with_name(f"{out.name}_sharp")
    _import(importer, source, CaptureWriter(sharp, overwrite=overwrite, gains=True), smpl)
    recipe = importer.blur_recipe
    assert recipe is not None, "run_importer refuses kinds without one"
    try:
        synthesize(
            sharp,
            out,
            recipe=recipe,
            weights=blur.weights,
            overwrite=overwrite,
            interpolation=blur.interpolation,
        )
    except BaseException:
        logger.info(
            "sharp it is: %s; make it blurry with: %s",
            sharp,
            command("synthesize", sharp, "--recipe", recipe, "--out", out),
        )
        raise


def _import_and_pose(
    importer: Importer,
    source: Path,
    out: Path,
    smpl: Path | None,
    poses: PoseOptions,
    keypoints: Path | None,
    *,
    overwrite: bool,
) -> None:
    """By way of a capture without poses beside ``out``, which stays where none are found."""
    from evsplat.posing import find_poses

    unposed = out.with_name(f"{out.name}_unposed")
    writer = CaptureWriter(unposed, out.name, overwrite=overwrite, gains=True)
    _import(importer, source, writer, smpl, on_to=out)
    try:
        search = PoseSearch(**vars(poses))
        # what is odd about the capture is said of the one that stays
        find_poses(unposed, out, search, keypoints=keypoints, overwrite=overwrite, warn=False)
    except BaseException:
        logger.info(
            "without poses it is: %s; find them with: %s",
            unposed,
            command("poses", unposed, "--out", out),
        )
        raise
    remove_folder(unposed)
