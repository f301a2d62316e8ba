"""A camera in a file of its own, as capture.json has one, read for a capture that is written."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

from evsplat.capture.distortion import are_coefficients
from evsplat.capture.fields import Fields
from evsplat.capture.finding import Findings, refuse_errors
from evsplat.capture.parse_cameras import intrinsics, rigid
from evsplat.errors import DataError
from evsplat.pictures.light import TRANSFERS
from evsplat.untrusted.faults import brief
from evsplat.untrusted.text import read_json


def read_camera(
    path: Path, width: int, height: int, required: Collection[str] = ("K",)
) -> dict[str, Any]:
    """One camera as in capture.json, as arguments of `CaptureWriter.add_camera`.

    ``width`` and ``height`` are those of its pictures; a file that says otherwise is a `DataError`,
    as is one without the ``required`` keys.
    """
    entry = read_json(path)
    expected = "expected one camera as in capture.json (docs/capture-format.md)"
    if not isinstance(entry, dict):
        raise DataError(f"{path}: found {brief(entry)}, {expected}.")
    missing = [key for key in required if key not in entry]
    if missing:
        raise DataError(f"{path}: {', '.join(missing)} missing, {expected}.")
    for key, size in (("width", width), ("height", height)):
        if entry.get(key, size) != size:
            raise DataError(
                f"{path}: {key}: found {entry[key]}, expected {size} as the pictures have."
            )
    transfer = entry.get("transfer")
    if transfer is not None and transfer not in TRANSFERS:
        raise DataError(
            f"{path}: transfer: found {brief(transfer)}, expected one of "
            f"{', '.join(TRANSFERS)}; correct it or leave it out."
        )
    findings = Findings()
    fields = Fields(path, "", entry, tuple(entry), findings)
    K = intrinsics(fields, width, height)
    if "world_to_camera" in entry:
        rigid(fields, "world_to_camera")
    refuse_errors(findings.items)
    return {
        "K": K,
        "world_to_camera": entry.get("world_to_camera"),
        "distortion": _coefficients(path, entry.get("distortion")),
        "transfer": transfer,
    }


def _coefficients(path: Path, lens: Any) -> list[float] | None:
    """Of a lens as capture.json has it, or of OpenCV's numbers alone; None where there is none."""
    values = lens.get("coefficients") if isinstance(lens, dict) else lens
    if not lens:
        return None
    model = lens.get("model", "opencv") if isinstance(lens, dict) else "opencv"
    if model != "opencv":  # a fish eye's four numbers would pass for k1, k2, p1, p2
        raise DataError(
            f"{path}: distortion: model: found {brief(model)}, expected 'opencv'; undistort the "
            "pictures first (of a fish eye by cv2.fisheye.undistortImage) and give null."
        )
    numbers = values if isinstance(values, list) else []
    if not are_coefficients(numbers):
        raise DataError(
            f"{path}: distortion: found {brief(values)}, expected 4, 5 or 8 numbers: OpenCV's k1, "
            "k2, p1, p2, k3, k4, k5, k6; give them, or null."
        )
    return [float(value) for value in numbers]
