"""Parts that importers share: finding files, checking numbers, cameras, pictures, masks."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from jaxtyping import Float

from evsplat.capture.parse_cameras import SMALLEST_PX
from evsplat.capture.write import CaptureWriter
from evsplat.errors import ConfigError, DataError
from evsplat.options.declare import LAST, Flag, check_options
from evsplat.pictures.files import read_image
from evsplat.pictures.light import Transfer
from evsplat.pictures.squares import square_means
from evsplat.untrusted.pictures import image_size

GUIDE = "docs/import.md shows the tree"
SHARP_EXPOSURE_US = 1_000
"""Exposure of pictures that are taken as sharp: the data set gives none."""
PICTURES = (".png", ".jpg", ".jpeg", ".webp")
# Rotations of data sets are rounded; further off than this they are something else.
_ROTATION_TOLERANCE = 1e-2
_MOST_DIGITS = 18
_SHORT_US = 100
"""Shutters of cameras are open for longer: 125 us are an eight-thousandth of a second."""


@dataclass(frozen=True, kw_only=True)
class Importer:
    """Options of one kind of source; `write` turns the source into a capture."""

    no_poses: Annotated[Flag, LAST] = False
    """Leave out poses that are there: the capture has no body."""

    blur_recipe: ClassVar[str | None] = None
    """Recipe of `evsplat.synthesize` that makes the paper's blurry version of this data set."""

    brings_masks: ClassVar[bool] = False
    """Whether masks come with the data set, so that missing ones are told."""

    def __post_init__(self) -> None:
        check_options(self)

    def write(self, source: Path, writer: CaptureWriter, smpl: Path | None) -> list[str]:
        """Read ``source`` into ``writer``; gives notes for the user.

        ``smpl`` is the user's SMPL file or the folder that holds it, None where there is none.
        """
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class SourceCamera:
    """A camera as a data set gives it, without the size of its pictures."""

    K: Float[np.ndarray, "3 3"]
    """Pixels of the pictures as stored; the centre of the first pixel is (0.5, 0.5)."""
    world_to_camera: Float[np.ndarray, "4 4"]
    distortion: tuple[float, ...] | None = None

    def add_to(
        self,
        writer: CaptureWriter,
        name: str,
        picture: Path | tuple[int, int],
        shrink: int,
        *,
        transfer: Transfer | None = None,
    ) -> None:
        """Declare the camera of pictures made smaller by ``shrink`` (`shrunk`).

        ``picture`` is one of them as stored, or its width and height.
        """
        width, height = image_size(picture) if isinstance(picture, Path) else picture
        K, size = shrunk_view(self.K, (width, height), shrink)
        writer.add_camera(
            name,
            *size,
            K,
            self.world_to_camera,
            distortion=self.distortion,
            transfer=transfer,
        )

    def moved(self, world_from_new: Float[np.ndarray, "4 4"]) -> "SourceCamera":
        """The same camera seen from another world."""
        return replace(self, world_to_camera=self.world_to_camera @ world_from_new)


def shrunk_view(
    K: Float[np.ndarray, "3 3"], size: tuple[int, int], factor: int
) -> tuple[Float[np.ndarray, "3 3"], tuple[int, int]]:
    """Intrinsics, and width and height, of pictures of ``size`` made smaller by ``factor``.

    Raises:
        ConfigError: The factor is not positive, or captures have no pictures as small as that.
    """
    check_positive(shrink=factor)
    width, height = size[0] // factor, size[1] // factor
    if min(width, height) < SMALLEST_PX:
        raise ConfigError(
            f"--shrink {factor}: of pictures of {size[0]}x{size[1]} pixels would be left "
            f"{width}x{height}, expected at least {SMALLEST_PX} either way; give a smaller factor."
        )
    smaller = np.array(K, dtype=np.float64)
    smaller[:2] /= factor
    return smaller, (width, height)


def opencv_intrinsics(K: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """K of a library that puts the first pixel's centre at (0, 0), in the capture's convention."""
    moved = np.array(K, dtype=np.float64)
    moved[:2, 2] += 0.5
    moved[0, 1] = 0.0
    return moved


def rigid(
    rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"], where: str
) -> Float[np.ndarray, "4 4"]:
    """4x4 transform of a rotation, freed from rounding, and a translation in metres."""
    u, _, v = np.linalg.svd(rotation)
    clean = u @ v
    if np.linalg.det(clean) < 0 or np.abs(clean - rotation).max() > _ROTATION_TOLERANCE:
        raise DataError(f"{where}: found a matrix that is no rotation, expected world to camera.")
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = clean, translation
    return transform


def add_picture(
    writer: CaptureWriter,
    name: str,
    path: Path,
    time_us: float,
    shrink: int,
    *,
    camera: str = "main",
    exposure_us: float | None = None,
    **details: Any,
) -> None:
    """Add a picture file, made smaller by ``shrink``, as the frame whose mid-exposure is given.

    Without ``exposure_us`` it is taken as sharp. ``details`` are further arguments of
    `CaptureWriter.add_frame`.
    """
    if exposure_us is None:
        exposure_us = SHARP_EXPOSURE_US
        details["sharp"] = True
    exposure = exposure_around(time_us, exposure_us)
    writer.add_frame(name, camera, picture(path, shrink), exposure, **details)


def picture(path: Path, shrink: int = 1) -> np.ndarray | Path:
    """The pixels made smaller by the mean over squares, or the file itself where all stays."""
    return path if shrink == 1 else shrunk(read_image(path), shrink)


def shrunk(pixels: np.ndarray, factor: int) -> np.ndarray:
    """Means over squares of ``factor`` pixels; what is left at the right and below is cut off.

    With a factor of 1 the pixels themselves.
    """
    if factor == 1:
        return pixels
    # with the axes turned about, channels come before columns and rows
    means = square_means(pixels.T, factor, np.float64).T
    return means if pixels.dtype.kind == "f" else (means + 0.5).astype(pixels.dtype)


def human_mask(
    path: Path | None, shrink: int = 1, *, person_is: str = "nonzero"
) -> np.ndarray | None:
    """(H, W) share of the person in [0, 1] of a label picture; None where there is no file.

    A label is 0 on the background; with ``person_is`` "zero" it is 0 on the person.
    """
    if path is None or not path.exists():
        return None
    labels = read_image(path)
    labels = labels if labels.ndim == 2 else labels.max(axis=2)
    person = labels == 0 if person_is == "zero" else labels != 0
    return shrunk(person.astype(np.float32), shrink)


def need(path: Path, what: str) -> Path:
    """``path``, or a `DataError` that says what was expected there."""
    if not path.exists():
        raise DataError(f"{path}: not found, expected {what}; {GUIDE}.")
    return path


def whole_number(digits: str, name: str) -> int:
    """The number of decimal ``digits`` in ``name``; a `DataError` for none or too many."""
    if not 0 < len(digits) <= _MOST_DIGITS:
        raise DataError(
            f"{name[:60]!r} has a number of {len(digits)} digits, expected 1 to {_MOST_DIGITS}; "
            "rename it."
        )
    return int(digits)


def numbered(folder: Path, what: str, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """Files of a folder by the last number in their names, in that order."""
    need(folder, f"the folder of {what}")
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        digits = "".join(c if c.isdecimal() else " " for c in path.stem).split()
        if path.suffix.lower() not in suffixes or not digits:
            continue
        number = whole_number(digits[-1], str(path))
        if number in found:
            raise DataError(
                f"{path}: has the number {number} as has {found[number].name}, expected one file "
                "per number; remove one."
            )
        found[number] = path
    if not found:
        kinds = ", ".join(suffixes)
        raise DataError(f"{folder}: holds no numbered {kinds} file, expected {what}; {GUIDE}.")
    return dict(sorted(found.items()))


def table(container: Any, where: str, what: str) -> Mapping[str, Any]:
    """A dictionary read from a file, or a `DataError` that says what it should hold."""
    if not isinstance(container, Mapping):
        raise DataError(f"{where}: found a {type(container).__name__}, expected {what}; {GUIDE}.")
    return container


def chosen_frames(frames: tuple[int, int] | None, available: list[int], source: Path) -> list[int]:
    """The numbers of ``available`` in [start, stop); all of them without a choice."""
    if frames is None:
        return available
    start, stop = frames
    if stop <= start:
        raise ConfigError(
            f"--frames {start} {stop}: expected the first frame and the one after the last, above "
            "it; correct them."
        )
    kept = [number for number in available if start <= number < stop]
    if not kept:
        raise ConfigError(
            f"{source}: no frame in {start}..{stop - 1}; there are {available[0]}..{available[-1]}."
        )
    return kept


def check_positive(**values: float) -> None:
    """Options that must be above zero, and finite."""
    for name, value in values.items():
        if not 0 < value < math.inf:
            raise ConfigError(f"--{name.replace('_', '-')} {value:g}: expected a number above 0.")


def short_exposure(exposure_us: float | None) -> list[str]:
    """A note where an exposure was meant in other units than microseconds, by its length."""
    if exposure_us is None or exposure_us >= _SHORT_US:
        return []
    return [
        f"exposure: {exposure_us:g} microseconds, in which nothing blurs; --exposure-us 20000 is a "
        "fiftieth of a second"
    ]


def exposure_around(time_us: float, exposure_us: float) -> tuple[int, int]:
    """Start and end of an exposure whose middle is ``time_us``."""
    start = round(time_us - exposure_us / 2)
    return start, start + max(1, round(exposure_us))
