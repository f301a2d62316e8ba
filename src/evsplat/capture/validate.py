"""The validator: everything that can be wrong with a capture, found before it costs a training."""

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from evsplat.capture.check_body import check_body
from evsplat.capture.check_events import check_events
from evsplat.capture.finding import Finding, Findings, reason_and_remedy
from evsplat.capture.metadata import Metadata
from evsplat.capture.parse import read_metadata
from evsplat.errors import DataError
from evsplat.pictures.files import read_image
from evsplat.untrusted.pictures import image_size

_KIND_NAMES = {"image": "blurry picture", "sharp": "sharp picture", "mask": "person mask"}


def validate_capture(path: Path | str, *, deep: bool = True) -> list[Finding]:
    """All faults of the capture at ``path``, errors and warnings.

    ``deep`` decodes every picture and scans every event; without it only descriptions, headers
    and poses are read (and sharp pictures are not opened at all).
    """
    return check_capture(Path(path), deep=deep)[1]


def check_capture(path: Path, *, deep: bool) -> tuple[Metadata | None, list[Finding]]:
    """`validate_capture` together with the metadata it read, None where that cannot be used."""
    findings = Findings()
    metadata = read_metadata(path, findings)
    if metadata is not None:
        _check_images(metadata, findings, deep=deep)
        check_body(metadata, findings, deep=deep)
        check_events(metadata, findings, deep=deep)
    return metadata, findings.items


@dataclass(frozen=True)
class _Picture:
    field: str
    kind: str
    path: Path
    camera: str
    owner: str
    """Its frame or view, in words."""


def _check_images(metadata: Metadata, findings: Findings, *, deep: bool) -> None:
    """Existence and size of every picture; ``deep`` decodes them and opens the sharp ones too."""
    pictures: Iterable[_Picture] = _pictures(metadata)
    if deep:  # which takes half a second of a picture of 8 megapixels
        count = sum(1 for _ in _pictures(metadata))
        pictures = tqdm(pictures, "pictures", count, unit="picture", leave=False, disable=None)
    for picture in pictures:
        if not os.path.isfile(picture.path):
            findings.error(
                picture.path,
                picture.field,
                f"no such file (the {picture.kind} of {picture.owner})",
                "a picture",
                "Restore the file or remove its entry from capture.json.",
            )
        elif deep or picture.kind != _KIND_NAMES["sharp"]:
            _check_picture(picture, metadata, findings, deep=deep)
    _check_pairing(metadata, findings)


def _pictures(metadata: Metadata) -> Iterator[_Picture]:
    """One by one: an hour has 45,000."""
    for frame in metadata.frames:
        for key, kind in _KIND_NAMES.items():
            path = getattr(frame, key)
            if path is not None:
                field, owner = f"frames[{frame.index}].{key}", f"frame {frame.name!r}"
                yield _Picture(field, kind, path, frame.camera, owner)
    for view in metadata.novel_views:
        field = f"novel_views[{view.index}].image"
        owner = f"camera {view.camera!r} at frame {view.frame!r}"
        yield _Picture(field, "novel view", view.image, view.camera, owner)


def _check_picture(
    picture: _Picture, metadata: Metadata, findings: Findings, *, deep: bool
) -> None:
    camera = metadata.cameras[picture.camera]
    try:
        width, height = image_size(picture.path)
        if deep:
            read_image(picture.path)
    except DataError as error:
        findings.error(
            picture.path,
            picture.field,
            f"a {picture.kind} of {picture.owner} that cannot be decoded ({error.__cause__})",
            "a readable picture",
            reason_and_remedy(error, picture.path)[1],
        )
        return
    if (width, height) != (camera.width, camera.height):
        findings.error(
            picture.path,
            picture.field,
            f"{width}x{height} pixels (the {picture.kind} of {picture.owner})",
            f"{camera.width}x{camera.height} pixels of camera {picture.camera!r}",
            "Resize the picture, or correct the camera's width, height and K.",
        )


def _check_pairing(metadata: Metadata, findings: Findings) -> None:
    """Masks and truth named like another frame's picture are probably paired by sort order."""
    owner_of_stem = {frame.image.stem: frame for frame in metadata.frames}
    for frame in metadata.frames:
        for key in ("mask", "sharp"):
            path = getattr(frame, key)
            other = None if path is None else owner_of_stem.get(path.stem)
            if other is not None and other is not frame:
                findings.warning(
                    metadata.path / "capture.json",
                    f"frames[{frame.index}].{key}",
                    f"{path.name!r}, named like the picture of frame {other.name!r}",
                    f"a file named like {frame.image.name!r}",
                    "Pair files by name, not by sort order.",
                )
    first_use: dict[Path, str] = {}
    again = [
        picture
        for picture in _pictures(metadata)
        if first_use.setdefault(picture.path, picture.field) != picture.field
    ]
    if again:
        of_how_many = f" (the first of {len(again)} such pictures)" if len(again) > 1 else ""
        findings.warning(
            metadata.path / "capture.json",
            again[0].field,
            f"{again[0].path.name!r}, which {first_use[again[0].path]} names too{of_how_many}",
            "a file of its own",
            "Check which of the two is right.",
        )
