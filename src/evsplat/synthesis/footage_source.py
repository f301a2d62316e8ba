"""A video or a folder of pictures as a source."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, NoReturn

import numpy as np

from evsplat.capture import BodyFile, CaptureWriter
from evsplat.capture.body_file import RIG_ARRAYS, body_from_arrays, read_arrays
from evsplat.capture.write import read_camera
from evsplat.errors import ConfigError, DataError
from evsplat.footage import Footage
from evsplat.synthesis.source import RecordedEvents, set_body

logger = logging.getLogger(__name__)

# Field of view across the longer side of a camera that nobody has described.
_NOMINAL_FOV_DEG = 60.0
_CAMERA_KEYS = ("width", "height", "K", "world_to_camera")


class FootageSource:
    """Footage with a camera and body poses, if the user has them (`Source`).

    ``body`` is an npz like body.npz of a capture, on the footage's clock; ``camera`` a JSON file
    with one camera as in capture.json.
    """

    camera = "main"

    def __init__(self, footage: Footage, body: Path | None, camera: Path | None) -> None:
        if body is not None and camera is None:
            raise ConfigError(
                f"{body}: poses mean nothing without the camera that saw them; give its "
                "description with --camera."
            )
        self.footage: Footage = footage
        self._body = None if body is None else _read_body(body)
        self._camera = None
        if camera is not None:
            self._camera = read_camera(camera, footage.width, footage.height, _CAMERA_KEYS)

    def describe(self) -> dict[str, Any]:
        """See `Source`."""
        return {"footage": self.footage.path.name, "camera_known": self._camera is not None}

    def declare(self, writer: CaptureWriter) -> None:
        """See `Source`."""
        width, height = self.footage.width, self.footage.height
        if self._camera is not None:
            writer.add_camera(self.camera, width, height, **self._camera)
            return
        logger.warning(
            "No camera is given: one with %g degrees of view is written. Correct it in "
            "capture.json before you fit poses.",
            _NOMINAL_FOV_DEG,
        )
        focal = max(width, height) / 2 / np.tan(np.radians(_NOMINAL_FOV_DEG) / 2)
        K = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
        writer.add_camera(self.camera, width, height, K)

    def extras(self, index: int) -> dict[str, Any]:
        """See `Source`."""
        return {}

    def split(self, index: int) -> Literal["train", "test"]:
        """See `Source`."""
        self._has_no("split")

    def events(self) -> RecordedEvents:
        """See `Source`."""
        self._has_no("events")

    def complete(self, writer: CaptureWriter, frames: Mapping[str, int]) -> None:
        """See `Source`."""
        if self._body is None:
            logger.warning("No body poses are given; 'evsplat train' will need them.")
            writer.leave_out_body()
            return
        set_body(writer, self._body, None, np.array(list(frames.values())))

    def _has_no(self, what: str) -> NoReturn:
        raise ConfigError(
            f"--{what} source: {self.footage.path} is no capture and has no {what} of its own."
        )


def _read_body(path: Path) -> BodyFile:
    arrays = read_arrays(path)
    needed: tuple[str, ...] = ("model", "times_us", "poses", "transl")
    if "model" in arrays and str(arrays["model"]) == "rig":
        needed += RIG_ARRAYS
    missing = [name for name in needed if name not in arrays]
    if missing:
        raise DataError(
            f"{path}: {', '.join(missing)} missing, expected the arrays of body.npz "
            "(docs/capture-format.md); add them."
        )
    count = len(np.atleast_1d(arrays["times_us"]))
    for name in ("poses", "transl"):
        if arrays[name].ndim < 2 or len(arrays[name]) != count:
            raise DataError(
                f"{path}: {name} has shape {arrays[name].shape}, expected one row for each of the "
                f"{count} times_us."
            )
    if count == 0:
        raise DataError(f"{path}: times_us is empty, expected at least one pose.")
    return body_from_arrays(path, arrays, "")
