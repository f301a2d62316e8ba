"""Checks of body.npz and body_dense.npz."""

import os
from pathlib import Path

import numpy as np

from evsplat.body.pose_errors import POSE_SOURCES, PoseSource
from evsplat.body.rotations import look_like_degrees
from evsplat.capture.body_file import BodyFile, body_from_arrays
from evsplat.capture.finding import Findings, reason_and_remedy
from evsplat.capture.metadata import Metadata
from evsplat.capture.parse import BODY_MODELS
from evsplat.errors import DataError
from evsplat.untrusted.arrays import read_plain_npz

_JOINTS = {"default": 31, "smpl": 24, "smplh": 52, "smplx": 55}
_WEIGHT_SUM_TOLERANCE = 1e-3
# A key pose that is missing leaves a frame a whole spacing away from the next one.
_COVERAGE_IN_SPACINGS = 0.6
_LARGEST = 1e6
"""Of metres, radians and weights."""
_FAR_M = 300.0
"""From the world's origin. 20 steps with float32 places lost 0.02 dB 100 m off, 0.34 at 2.2 km."""
_REWRITE = "Write body.npz anew with this shape."


def check_body(metadata: Metadata, findings: Findings, *, deep: bool) -> None:
    """The body, its key poses and whether every frame has one; ``deep`` reads the dense poses."""
    if not metadata.body_model:
        return
    before = findings.error_count()
    arrays = _read(metadata.body_file, findings)
    if arrays is None:
        return
    _check_model(metadata, arrays, findings)
    check = _Check(metadata.body_file, arrays, findings)
    check.body(metadata.body_model, metadata.body_source)
    if findings.error_count() == before:
        _check_coverage(metadata, arrays, findings)
        _check_distance(metadata.body_file, arrays["transl"], findings)
    dense = metadata.path / "body_dense.npz"
    if deep and dense.exists():
        check_dense(dense, _read(dense, findings), check.joint_count(), findings)


def stated_body(path: Path, source: PoseSource | None) -> BodyFile:
    """Read a body.npz outside of a capture; the user states the ``source`` of its poses.

    Raises:
        DataError: It is not what a capture may have (docs/capture-format.md).
    """
    arrays = read_plain_npz(path)
    if source is None and "pose_std_rad" in arrays:
        raise DataError(
            f"{path}: says how far its poses err (pose_std_rad), expected their source as well; "
            f"give --pose-source ({', '.join(POSE_SOURCES)})."
        )
    model = str(arrays.get("model", ""))
    if model not in BODY_MODELS:
        raise DataError(
            f"{path}: model: found {model[:80]!r}, expected one of {', '.join(BODY_MODELS)}, with "
            "the arrays of body.npz (docs/capture-format.md); add it."
        )
    findings = Findings()
    _Check(path, arrays, findings).body(model, source)
    for finding in findings.items:
        raise DataError(f"{finding}")
    return body_from_arrays(path, arrays, model, source)


def check_dense(
    path: Path, arrays: dict[str, np.ndarray] | None, joints: int | None, findings: Findings
) -> None:
    """The arrays of body_dense.npz: poses of as many joints as the body has."""
    if arrays is not None:
        _Check(path, arrays, findings).poses(joints)


def _read(path: Path, findings: Findings) -> dict[str, np.ndarray] | None:
    if not os.path.exists(path):
        findings.error(path, "", "no such file", "the body and its poses", "Restore the file.")
        return None
    try:
        return read_plain_npz(path)
    except DataError as error:
        reason, remedy = reason_and_remedy(error, path)
        reason = reason.split(", expected")[0]
        findings.error(path, "", reason, "an npz of plain arrays", remedy)
        return None


def _check_model(metadata: Metadata, arrays: dict[str, np.ndarray], findings: Findings) -> None:
    stored = str(arrays["model"]) if "model" in arrays else None
    if stored != metadata.body_model:
        findings.error(
            metadata.body_file,
            "model",
            "nothing" if stored is None else repr(stored),
            f"{metadata.body_model!r} as body.model of capture.json says",
            "Correct the one that is wrong.",
        )


class _Check:
    """Checks of the arrays of one npz."""

    def __init__(self, path: Path, arrays: dict[str, np.ndarray], findings: Findings) -> None:
        self.path, self.arrays, self.findings = path, arrays, findings

    def error(self, field: str, found: str, expected: str, remedy: str = _REWRITE) -> None:
        self.findings.error(self.path, field, found, expected, remedy)

    def array(self, key: str, shape: tuple[int | None, ...], kinds: str) -> np.ndarray | None:
        """The array where it exists with that shape (None: any length) and kind, else a finding."""
        wanted = "x".join("?" if size is None else str(size) for size in shape)
        kind = {"f": "real numbers", "i": "whole numbers", "U": "text"}[kinds[0]]
        array = self.arrays.get(key)
        if array is None:
            self.error(key, "nothing", f"an array of {kind}, {wanted}", f"Add {key!r}.")
            return None
        fits = array.ndim == len(shape) and all(
            want in (None, size) for want, size in zip(shape, array.shape, strict=True)
        )
        if not fits or array.dtype.kind not in kinds:
            found = f"{'x'.join(map(str, array.shape)) or 'a single value'} of {array.dtype}"
            self.error(key, found, f"{wanted} {kind}")
            return None
        # As float64, which halves are compared in: as one of those the limit is infinite.
        limit = np.float64(_LARGEST)
        wrong = ~(np.abs(array) <= limit) if array.dtype.kind == "f" else np.zeros(0, bool)
        if wrong.any():
            index = tuple(int(i) for i in np.argwhere(wrong)[0])
            count = int(wrong.sum())
            self.error(
                f"{key}[{', '.join(map(str, index))}]",
                f"{array[index]}{self.pose_words(key, index)} ({count} such values)",
                f"finite numbers up to {_LARGEST:g}",
                "Interpolate or fit these again, or remove the frames.",
            )
            return None
        return array

    def pose_words(self, key: str, index: tuple[int, ...]) -> str:
        """Pose and joint of an index, in words."""
        if key not in ("poses", "transl"):
            return ""
        times = self.arrays.get("times_us")
        words = f" in pose {index[0]}"
        if times is not None and times.ndim == 1 and times.dtype.kind in "iu":
            words += f" at {int(times[index[0]])} us" if index[0] < len(times) else ""
        if key == "poses":
            names = self.arrays.get("joint_names")
            words += f", joint {index[1]}"
            if names is not None and names.ndim == 1 and index[1] < len(names):
                words += f" {str(names[index[1]])!r}"
        return words

    def joint_count(self) -> int | None:
        """J of the poses, None where they are not well-formed."""
        poses = self.arrays.get("poses")
        return poses.shape[1] if poses is not None and poses.ndim == 3 else None

    def body(self, model: str, source: PoseSource | None) -> None:
        self.poses(_JOINTS.get(model))
        self.errors(source)
        if model == "rig":
            self.rig()
        else:
            self.shape_parameters(with_gender=model != "default")

    def poses(self, joints: int | None) -> None:
        times = self.array("times_us", (None,), "iu")
        count = None if times is None else len(times)
        rig_joints = self.arrays.get("rest_joints")
        if joints is None and rig_joints is not None and rig_joints.ndim == 2:
            joints = len(rig_joints)
        poses = self.array("poses", (count, joints, 3), "f")
        degrees = None if poses is None else look_like_degrees(poses)
        if degrees:
            self.error(
                "poses",
                f"{degrees}: they look like degrees",
                "axis-angle vectors in radians, of each joint relative to its parent",
                "Multiply them by pi / 180.",
            )
        self.array("transl", (count, 3), "f")
        if times is None:
            return
        if count == 0:
            self.error("times_us", "no pose", "at least one key pose", "Add the poses.")
        elif (np.diff(times.astype(np.int64)) <= 0).any():
            at = int(np.argmax(np.diff(times.astype(np.int64)) <= 0)) + 1
            self.error(
                f"times_us[{at}]",
                f"{int(times[at])} after {int(times[at - 1])}",
                "strictly ascending times",
                "Sort the poses by time and remove doubles.",
            )

    def errors(self, source: PoseSource | None) -> None:
        """How far the poses are said to err."""
        given = [key for key in ("pose_std_rad", "transl_std_m") if key in self.arrays]
        if not given:
            return
        if source is None:
            self.error(
                given[0],
                "an array, while body.source of capture.json says nothing",
                f"one of {list(POSE_SOURCES)} there",
                "Say where the poses come from, or leave the array out.",
            )
        times = self.arrays.get("times_us")
        count = None if times is None or times.ndim != 1 else len(times)
        shapes = {"pose_std_rad": (count, self.joint_count()), "transl_std_m": (count, 3)}
        for key, shape in shapes.items():
            array = self.array(key, shape, "f")
            wrong = None if array is None else (array < 0) | ((array > 0) & (source == "exact"))
            if array is not None and wrong is not None and wrong.any():
                index = tuple(int(i) for i in np.argwhere(wrong)[0])
                self.error(
                    f"{key}[{', '.join(map(str, index))}]",
                    f"{array[index]:.4g} ({int(wrong.sum())} such values)",
                    "0 of exact poses" if source == "exact" else "numbers of at least 0",
                    "Give standard deviations, or leave both arrays out.",
                )

    def rig(self) -> None:
        joints = self.joint_count()
        vertices = self.array("rest_vertices", (None, 3), "f")
        count = None if vertices is None else len(vertices)
        self.array("joint_names", (joints,), "U")
        self.array("rest_joints", (joints, 3), "f")
        parents = self.array("parents", (joints,), "iu")
        faces = self.array("faces", (None, 3), "iu")
        weights = self.array("weights", (count, joints), "f")
        if parents is not None:
            self.parents(parents)
        if faces is not None and count is not None:
            outside = (faces < 0) | (faces >= count)
            if len(faces) == 0 or outside.any():
                row = int(np.argmax(outside.any(axis=1))) if len(faces) else 0
                found = f"{faces[row].tolist()}" if len(faces) else "no face"
                self.error(f"faces[{row}]", found, f"vertex indices 0..{count - 1}")
        if weights is not None and count:
            self.weights(weights)

    def parents(self, parents: np.ndarray) -> None:
        parents = parents.astype(np.int64)
        if len(parents) == 0 or parents[0] != -1:
            found = str(int(parents[0])) if len(parents) else "no joint"
            self.error("parents[0]", found, "-1, the root", "Put the root joint first.")
            return
        wrong = (parents[1:] < 0) | (parents[1:] >= np.arange(1, len(parents)))
        if wrong.any():
            joint = int(np.argmax(wrong)) + 1
            self.error(
                f"parents[{joint}]",
                str(int(parents[joint])),
                f"a joint before it (0..{joint - 1})",
                "Sort the joints so that parents come first (with their poses and weights).",
            )

    def weights(self, weights: np.ndarray) -> None:
        sums = weights.sum(axis=1, dtype=np.float64)
        wrong = (np.abs(sums - 1) > _WEIGHT_SUM_TOLERANCE) | (weights < 0).any(axis=1)
        if wrong.any():
            row = int(np.argmax(wrong))
            low = float(weights[row].min())
            found = f"a sum of {sums[row]:.4g}" + (f" and a weight of {low:.4g}" if low < 0 else "")
            self.error(
                f"weights[{row}]",
                f"{found} ({int(wrong.sum())} of {len(weights)} vertices)",
                "weights of at least 0 that sum to 1",
                "Clip and normalise the rows.",
            )

    def shape_parameters(self, *, with_gender: bool) -> None:
        betas = self.arrays.get("betas")
        self.array("betas", (None,) if betas is None or betas.ndim == 1 else (1, None), "f")
        if with_gender:
            gender = self.arrays.get("gender")
            if gender is None or str(gender) not in ("neutral", "male", "female"):
                self.error(
                    "gender",
                    "nothing" if gender is None else repr(str(gender)),
                    "'neutral', 'male' or 'female'",
                    "Say which model file the shape belongs to.",
                )


def _check_coverage(metadata: Metadata, arrays: dict[str, np.ndarray], findings: Findings) -> None:
    """Every frame needs a key pose near its mid-exposure; far ones are not interpolated."""
    times = arrays["times_us"].astype(np.int64)
    spacing = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    bare = []
    for frame in metadata.frames:
        half_exposure = (frame.exposure_us[1] - frame.exposure_us[0]) / 2
        tolerance = max(half_exposure, _COVERAGE_IN_SPACINGS * spacing)
        distance = int(np.abs(times - frame.mid_us).min())
        if distance > tolerance:
            bare.append((frame, distance, tolerance))
    if not bare:
        return
    frame, distance, tolerance = bare[0]
    others = [other.name for other, _, _ in bare[1:]]
    also = f" (and {len(others)} more frames: {', '.join(others[:5])}" if others else ""
    also += ("…)" if len(others) > 5 else ")") if others else ""
    findings.error(
        metadata.body_file,
        "times_us",
        f"no pose for frame {frame.name!r} at {frame.mid_us} us, the nearest is {distance} us "
        f"away{also}",
        f"a pose within {tolerance:.0f} us of every mid-exposure; the {len(times)} poses cover "
        f"{int(times[0])}..{int(times[-1])} us",
        "Add the poses, or remove these frames from capture.json.",
    )


def _check_distance(path: Path, transl: np.ndarray, findings: Findings) -> None:
    """A warning where places of the person have too few digits left, as in a map's coordinates."""
    place = np.median(transl.astype(np.float64), axis=0)
    distance_m = float(np.linalg.norm(place))
    if distance_m > _FAR_M:
        step_mm = float(np.spacing(np.float32(distance_m))) * 1000
        near = ", ".join(f"{value:.0f}" for value in place)
        findings.warning(
            path,
            "transl",
            f"a person {distance_m:,.0f} m from the origin of the world, where places are known "
            f"to {step_mm:.2g} mm and training moves nothing by less",
            f"one within {_FAR_M:.0f} m of it",
            f"Move the origin there: subtract p = ({near}) from transl and points.ply, and add "
            "R p to t of each world_to_camera [R t].",
        )
