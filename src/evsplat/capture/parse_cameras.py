"""The cameras of capture.json."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from evsplat.camera import Camera
from evsplat.capture.distortion import Distortion, are_coefficients
from evsplat.capture.fields import MISSING, RENAME, Fields
from evsplat.names import NAME_RULE, is_name
from evsplat.pictures.light import TRANSFERS, Transfer
from evsplat.untrusted.faults import brief

# Rotations written as rounded decimals are accepted down to about five digits.
_ROTATION_TOLERANCE = 1e-4
# Training and evaluation compare pictures by SSIM, whose window has this side.
SMALLEST_PX = 11
_LARGEST_PX = 16_384
# From a fish eye's middle to a telescope.
_FOCAL_IN_SIDES = (0.05, 200.0)
# 72 degrees; the widest lenses that keep lines straight reach 65 in the corner of all they see.
_OFF_AXIS_IN_FOCALS = 3.0


def parse_cameras(
    top: Fields,
) -> tuple[dict[str, Camera], dict[str, Distortion], dict[str, Transfer]]:
    """Cameras without errors by name, and the lens and transfer curve of those that have one."""
    cameras: dict[str, Camera] = {}
    distortions: dict[str, Distortion] = {}
    transfers: dict[str, Transfer] = {}
    entries = top.get("cameras")
    if not isinstance(entries, dict) or not entries:
        if entries is not None:
            top.fail("cameras", brief(entries), "at least one named camera", "Add a camera.")
        return cameras, distortions, transfers
    keys = ("width", "height", "K", "world_to_camera", "distortion", "transfer")
    for name, value in entries.items():
        if not is_name(name):
            top.fail("cameras", brief(name), f"names: {NAME_RULE}", RENAME)
            continue
        entry = top.inner(f"cameras.{name}", value, keys)
        width, height = _pixels(entry, "width"), _pixels(entry, "height")
        K, pose = intrinsics(entry, width, height), rigid(entry, "world_to_camera")
        coefficients, transfer = _distortion(entry), entry.choice("transfer", TRANSFERS)
        if not entry.valid or K is None or pose is None:
            continue
        K32 = torch.from_numpy(K.astype(np.float32))
        cameras[name] = Camera(width, height, K32, pose)
        if coefficients and any(coefficients):
            distortions[name] = lens = Distortion(width, height, K, coefficients)
            _check_unfolded(entry, lens)
        if transfer is not None:
            transfers[name] = transfer
    return cameras, distortions, transfers


def _pixels(entry: Fields, key: str) -> int:
    """A side of the camera's pictures."""
    count = entry.integer(key, minimum=1)
    if count > _LARGEST_PX:
        entry.fail(key, f"{count} pixels", f"at most {_LARGEST_PX}", "Shrink the pictures.")
    if 0 < count < SMALLEST_PX:
        entry.fail(
            key,
            f"{count} pixels",
            f"at least {SMALLEST_PX}, the side of SSIM's window",
            "Record larger pictures, or shrink them less.",
        )
    return count


def intrinsics(entry: Fields, width: int, height: int) -> np.ndarray | None:
    """K of a camera of pictures of that size as float64 [3, 3], None after a finding."""
    K = entry.numbers("K", (3, 3))
    if K is None:
        return None
    pinhole = K[0, 0] > 0 and K[1, 1] > 0 and K[0, 1] == 0 and K[1, 0] == 0
    if not pinhole or K[2].tolist() != [0, 0, 1]:
        entry.fail(
            "K",
            brief(K.tolist()),
            "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels with fx and fy above 0",
            "Give the camera's intrinsics (no skew).",
        )
        return None
    (low, high), focal = _FOCAL_IN_SIDES, K[[0, 1], [0, 1]]
    shorter, longer = min(width, height), max(width, height)
    if shorter > 0 and not ((focal >= low * shorter) & (focal <= high * longer)).all():
        entry.fail(
            "K",
            f"focal lengths of {focal[0]:g} and {focal[1]:g} pixels",
            f"{low:g} times the shorter to {high:g} times the longer side of {width}x{height}",
            "Give the focal length in pixels: that in millimetres over a pixel's size.",
        )
        return None
    return K if _sees_ahead(entry, K, width, height) else None


def _sees_ahead(entry: Fields, K: np.ndarray, width: int, height: int) -> bool:
    """Whether the pictures are near enough to the principal point; a finding if not within them."""
    point, size = K[:2, 2], np.array([width, height])
    outside = np.maximum(np.maximum(-point, point - size), 0)
    found = (
        f"a principal point of ({point[0]:g}, {point[1]:g}) pixels, outside the "
        f"{width}x{height} picture"
    )
    focals = float(np.linalg.norm(outside / K[[0, 1], [0, 1]]))
    if focals > _OFF_AXIS_IN_FOCALS:
        entry.fail(
            "K",
            f"{found} by {focals:.3g} focal lengths",
            f"one within the pictures, or at most {_OFF_AXIS_IN_FOCALS:g} focal lengths beside "
            "them where they were cut out of larger ones",
            "Give cx and cy in pixels of these pictures.",
        )
    elif focals > 0:
        entry.findings.warning(
            entry.file,
            entry.field("K"),
            found,
            "one within the pictures, unless they were cut out of larger ones",
            "If they were made smaller, K has to be made so with them.",
        )
    return focals <= _OFF_AXIS_IN_FOCALS


def _check_unfolded(entry: Fields, lens: Distortion) -> None:
    """A warning where the lens puts two places of the scene into one pixel, which none does."""
    radius_px, share = lens.fold()
    if share > 0:
        entry.findings.warning(
            entry.file,
            entry.field("distortion.coefficients"),
            f"a lens that folds over itself {radius_px:.0f} pixels from the principal point, so "
            f"that {max(share, 0.001):.1%} of the picture shows again what is nearer to it",
            f"one that folds nowhere in the {lens.width}x{lens.height} picture",
            "Calibrate with points out to its corners or with fewer coefficients, or crop it.",
        )


def rigid(entry: Fields, key: str, default: Any = MISSING) -> Tensor | None:
    """A rotation and a translation as float32 [4, 4], None after a finding."""
    matrix = entry.numbers(key, (4, 4), default)
    if matrix is None:
        return None
    rotation = matrix[:3, :3]
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if error > _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        kind = (
            "a mirrored rotation"
            if error <= _ROTATION_TOLERANCE
            else (f"a rotation part that is not orthonormal (off by {error:.2g})")
        )
        entry.fail(key, kind, "a rotation and a translation", "Give the 4x4 world to camera.")
        return None
    if matrix[3].tolist() != [0, 0, 0, 1]:
        entry.fail(key, f"last row {matrix[3].tolist()}", "[0, 0, 0, 1]", "Transpose it?")
        return None
    return torch.from_numpy(matrix.astype(np.float32))


def _distortion(entry: Fields) -> tuple[float, ...] | None:
    value = entry.get("distortion", None)
    if value is None:
        return None
    inner = entry.inner(f"{entry.where}.distortion", value, ("model", "coefficients"))
    if inner.valid and inner.text("model") != "opencv":
        inner.fail("model", brief(inner.value.get("model")), "'opencv'", "Undistort first.")
    coefficients = inner.entries("coefficients")
    if inner.valid and not are_coefficients(coefficients):
        inner.fail(
            "coefficients",
            brief(coefficients),
            "4, 5 or 8 numbers: k1, k2, p1, p2, k3, k4, k5, k6",
            "Give OpenCV's coefficients or null.",
        )
    entry.valid &= inner.valid
    return tuple(float(c) for c in coefficients) if inner.valid else None
