"""Body poses that other tools estimated: what the file holds names the format."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evsplat.body.pose_files import data_sets, easymocap, gvhmr, in_camera, tram
from evsplat.body.pose_files.documents import Document, Request, open_document, pose_paths
from evsplat.body.pose_files.sequence import PoseSequence
from evsplat.body.pose_files.transfer import skeleton_motion, to_default_body
from evsplat.errors import DataError

__all__ = ["PoseSequence", "read_poses", "skeleton_motion", "to_default_body"]


@dataclass(frozen=True)
class PoseFormat:
    """A tool's files: their test and their reader."""

    name: str
    fits: Callable[[Any], bool]
    read: Callable[[list[Document], Request], PoseSequence]
    many: bool = False
    """A folder of files makes one sequence."""


FORMATS = (
    PoseFormat("GVHMR", gvhmr.fits, gvhmr.read),
    PoseFormat("WHAM", in_camera.fits_wham, in_camera.read_wham),
    PoseFormat("TRAM", tram.fits, tram.read, many=True),
    PoseFormat("PHALP", in_camera.fits_phalp, in_camera.read_phalp),
    PoseFormat("ROMP", in_camera.fits_romp, in_camera.read_romp, many=True),
    PoseFormat("EasyMocap", easymocap.fits, easymocap.read, many=True),
    PoseFormat("ARAH", data_sets.fits_arah, data_sets.read_arah, many=True),
    PoseFormat("AMASS", data_sets.fits_amass, data_sets.read_amass),
    PoseFormat("MMHPSD", data_sets.fits_mmhpsd, data_sets.read_mmhpsd, many=True),
)


def read_poses(
    path: Path | str,
    *,
    person: str | int | None = None,
    world: bool = False,
    image_size: tuple[int, int] | None = None,
    rest_pelvis: tuple[float, float, float] | None = None,
    body_models: Path | str | None = None,
) -> PoseSequence:
    """Poses from a file of `FORMATS`, or from a folder with one file per frame (or person).

    Args:
        path: the file or folder.
        person: the tool's number of the person; needed where a file holds several.
        world: in the tool's static world instead of the camera, where the file has one.
        image_size: width and height of the video in pixels, for tools whose intrinsics follow
            from it (WHAM, ROMP).
        rest_pelvis: rest root joint of the subject in the model's axes, for files that turn the
            body about another point; by default from the user's SMPL model, else approximate.
        body_models: where the user's licensed SMPL files lie (default: EVSPLAT_BODY_MODELS).

    Raises:
        DataError: missing or damaged, no known format, or several people and none chosen.
    """
    path = Path(path)
    paths = pose_paths(path)
    first = open_document(paths[0])
    chosen = next((form for form in FORMATS if form.fits(first.content)), None)
    if chosen is None:
        raise DataError(
            f"{first.path}: not a pose file of {', '.join(form.name for form in FORMATS)}; "
            f"it holds {_summary(first.content)}."
        )
    if len(paths) > 1 and not chosen.many:
        raise DataError(
            f"{path}: {len(paths)} files of {chosen.name}, one of which is a whole video; give one."
        )
    documents = [first]
    for other in paths[1:]:
        document = open_document(other)
        if not chosen.fits(document.content):
            raise DataError(f"{other}: not {chosen.name} like {paths[0].name} beside it.")
        documents.append(document)
    request = Request(path, person, world, image_size, rest_pelvis, body_models)
    return chosen.read(documents, request)


def _summary(content: Any) -> str:
    if isinstance(content, dict):
        keys = [str(key) for key in content]
        return f"the keys {', '.join(keys[:8])}{' ...' if len(keys) > 8 else ''}"
    return f"a {type(content).__name__}"
