"""The body and its key poses as they stand in ``body.npz``."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Int64
from numpy.typing import ArrayLike

from evsplat.body.pose_errors import PoseErrors, PoseSource


@dataclass(frozen=True, eq=False)
class BodyFile:
    """Raw arrays of ``body.npz``; what a body model does not have is None.

    P key poses, J joints, V vertices, F triangles.
    """

    path: Path
    model: str
    """"rig", "default", "smpl", "smplh" or "smplx"."""
    times_us: Int64[np.ndarray, "P"]
    poses: Float[np.ndarray, "P J 3"]
    """Axis-angle, local to the parent; the root's is the orientation in the world."""
    transl: Float[np.ndarray, "P 3"]
    """Posed root joint minus rest root joint, metres."""
    joint_names: tuple[str, ...] | None = None
    parents: Int[np.ndarray, "J"] | None = None
    rest_joints: Float[np.ndarray, "J 3"] | None = None
    rest_vertices: Float[np.ndarray, "V 3"] | None = None
    faces: Int[np.ndarray, "F 3"] | None = None
    weights: Float[np.ndarray, "V J"] | None = None
    betas: Float[np.ndarray, "B"] | None = None
    gender: str | None = None
    source: PoseSource | None = None
    """Where the poses come from; None where the capture does not say."""
    pose_std_rad: Float[np.ndarray, "P J"] | None = None
    """Standard deviation of each joint's rotation, radians per axis."""
    transl_std_m: Float[np.ndarray, "P 3"] | None = None
    """Standard deviation of ``transl``, metres."""

    @property
    def errors(self) -> PoseErrors | None:
        """How far the poses err, joints in the file's order; None where the source is unknown."""
        if self.source is None:
            return None
        if self.pose_std_rad is None or self.transl_std_m is None:
            return PoseErrors.typical_of(self.source, *self.poses.shape[:2])
        return PoseErrors(self.source, self.pose_std_rad, self.transl_std_m)

    def at_keys(self, kept: Bool[np.ndarray, "P"]) -> "BodyFile":
        """The same body with those of the key poses."""
        keyed = ("times_us", "poses", "transl", "pose_std_rad", "transl_std_m")
        values = {name: getattr(self, name) for name in keyed}
        return replace(
            self, **{name: value[kept] for name, value in values.items() if value is not None}
        )

    @property
    def rig(self) -> dict[str, Any] | None:
        """The arrays that make a rig, by name; None for other models."""
        if self.model != "rig":
            return None
        return {name: getattr(self, name) for name in RIG_ARRAYS}


RIG_ARRAYS = ("joint_names", "parents", "rest_joints", "rest_vertices", "faces", "weights")


def body_from_arrays(
    path: Path, arrays: dict[str, np.ndarray], model: str, source: PoseSource | None = None
) -> BodyFile:
    """A `BodyFile` of well-formed arrays; ``model`` where they name none."""
    names = arrays.get("joint_names")
    gender = arrays.get("gender")
    return BodyFile(
        path=path,
        model=str(arrays["model"]) if "model" in arrays else model,
        times_us=arrays["times_us"].astype(np.int64),
        poses=arrays["poses"],
        transl=arrays["transl"],
        joint_names=None if names is None else tuple(str(name) for name in names),
        gender=None if gender is None else str(gender),
        source=source,
        pose_std_rad=arrays.get("pose_std_rad"),
        transl_std_m=arrays.get("transl_std_m"),
        betas=None if "betas" not in arrays else np.ravel(arrays["betas"]),
        **{key: arrays.get(key) for key in RIG_ARRAYS if key != "joint_names"},
    )


def write_body(
    folder: Path,
    model: str,
    times_us: ArrayLike,
    poses: ArrayLike,
    transl: ArrayLike,
    *,
    rig: Mapping[str, Any] | None = None,
    betas: ArrayLike | None = None,
    gender: str | None = None,
    source: PoseSource | None = None,
    pose_std_rad: ArrayLike | None = None,
    transl_std_m: ArrayLike | None = None,
) -> dict[str, str]:
    """Write ``body.npz``, as `CaptureWriter.set_body` says; gives ``body`` of capture.json."""
    arrays: dict[str, Any] = {"model": model, **key_poses(times_us, poses, transl)}
    if rig is not None:
        arrays |= {key: np.asarray(rig[key]) for key in RIG_ARRAYS}
    if betas is not None:
        arrays["betas"] = np.asarray(betas, dtype=np.float64).ravel()
    if gender is not None:
        arrays["gender"] = gender
    for key, value in (("pose_std_rad", pose_std_rad), ("transl_std_m", transl_std_m)):
        if value is not None:
            arrays[key] = np.asarray(value, dtype=np.float32)
    save_arrays(folder / "body.npz", arrays)
    entry = {"file": "body.npz", "model": model}
    return entry if source is None else {**entry, "source": source}


def key_poses(times_us: ArrayLike, poses: ArrayLike, transl: ArrayLike) -> dict[str, np.ndarray]:
    """Times and poses as they are stored."""
    return {
        "times_us": np.asarray(times_us, dtype=np.int64),
        "poses": np.asarray(poses, dtype=np.float32),
        "transl": np.asarray(transl, dtype=np.float32),
    }


def save_arrays(path: Path, arrays: dict[str, Any]) -> None:
    """Write an npz that holds nothing pickled."""
    np.savez_compressed(path, allow_pickle=False, **arrays)
