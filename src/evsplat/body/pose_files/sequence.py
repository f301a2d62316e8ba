"""Body poses of a video as one type, whatever tool they come from."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from evsplat.body.pose_errors import PoseSource
from evsplat.body.rotations import look_like_degrees, nearest_axis_angle
from evsplat.body.smpl_skeleton import JOINTS
from evsplat.errors import DataError


@dataclass(frozen=True, eq=False)
class PoseSequence:
    """One person's SMPL-family poses at some frames of a video. T poses, J joints of the model."""

    model: str
    """"smpl", "smplh" or "smplx"."""
    frames: Int[np.ndarray, "T"]
    """Index of each pose's frame in the video (or of its file), ascending."""
    poses: Float[np.ndarray, "T J 3"]
    """Axis-angle, local to the parent; the root's is the orientation in the world, about the
    pelvis. Successive vectors never jump by a whole turn."""
    transl: Float[np.ndarray, "T 3"]
    """Posed root joint minus rest root joint, metres."""
    betas: Float[np.ndarray, "B"]
    """One shape for the person: the mean where the tool gives one per frame."""
    gender: str
    source: str
    """The file or folder, for messages."""
    world: str
    """Axes of root orientation and translation: "camera" (OpenCV), "y up" and "z up" (a static
    world of the tool's) or "calibration" (the world of the data set's cameras)."""
    pose_source: PoseSource | None = None
    """Where such poses come from; None where the format does not tell."""
    person: str = ""
    """The tool's name of the person."""
    fps: float | None = None
    """Frames per second where the file says."""
    K: Float[np.ndarray, "3 3"] | None = None
    """Intrinsics the tool assumed, pixels of the video."""
    world_to_camera: Float[np.ndarray, "T 4 4"] | None = None
    """Per frame, where the file has cameras and the world is not the camera."""
    notes: tuple[str, ...] = ()
    """Gaps of the file, one sentence each."""

    def turned(
        self, turn: Float[np.ndarray, "3 3"], root_at_rest: Float[np.ndarray, "3"]
    ) -> "PoseSequence":
        """In a world whose axes are turned; ``root_at_rest`` is the root joint's place at rest."""
        poses, cameras = self.poses.copy(), self.world_to_camera
        poses[:, 0] = (Rotation.from_matrix(turn) * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
        if cameras is not None:
            cameras = cameras.copy()
            cameras[:, :3, :3] = cameras[:, :3, :3] @ turn.T
        return replace(
            self,
            poses=nearest_axis_angle(poses),
            transl=(self.transl + root_at_rest) @ turn.T - root_at_rest,
            world_to_camera=cameras,
        )

    def times_us(self, fps: float | None = None) -> Int[np.ndarray, "T"]:
        """Times of the poses at a constant rate, by default the file's own; frame 0 is at 0.

        Raises:
            DataError: no rate, or one that is not above zero and finite.
        """
        rate = fps if fps is not None else self.fps
        if rate is None or not np.isfinite(rate) or rate <= 0:
            raise DataError(f"{self.source}: the file has no frame rate; give fps= (found {rate}).")
        return np.rint(self.frames * (1e6 / rate)).astype(np.int64)


def make_sequence(
    *,
    model: str,
    frames: Sequence[int] | np.ndarray,
    poses: Float[np.ndarray, "T J 3"],
    transl: Float[np.ndarray, "T 3"],
    betas: np.ndarray,
    source: str,
    world: str,
    gender: str = "neutral",
    K: np.ndarray | None = None,
    world_to_camera: np.ndarray | None = None,
    **details,
) -> PoseSequence:
    """A sequence in ascending order of frames, with fingers and face at rest where not given."""
    frames = np.asarray(frames, np.int64)
    if len(frames) == 0:
        raise DataError(f"{source}: holds no pose.")
    if gender not in ("neutral", "male", "female"):
        raise DataError(f"{source}: gender is '{gender}', expected neutral, male or female.")
    degrees = look_like_degrees(poses)
    if degrees:
        raise DataError(
            f"{source}: has {degrees}: they look like degrees, expected axis-angle vectors in "
            "radians, of each joint relative to its parent; multiply them by pi / 180."
        )
    order = np.argsort(frames, kind="stable")
    frames = frames[order]
    if (np.diff(frames) == 0).any():
        twice = int(frames[np.argmax(np.diff(frames) == 0)])
        raise DataError(f"{source}: frame {twice} has two poses of the same person.")
    rest = JOINTS[model] - poses.shape[1]
    full = np.pad(np.asarray(poses, np.float64), ((0, 0), (0, rest), (0, 0)))
    betas = np.atleast_2d(np.asarray(betas, np.float64))
    return PoseSequence(
        model=model,
        frames=frames,
        poses=nearest_axis_angle(full[order]),
        transl=np.asarray(transl, np.float64)[order],
        betas=betas.mean(0),
        gender=gender,
        source=source,
        world=world,
        K=None if K is None else np.asarray(K, np.float64),
        world_to_camera=None if world_to_camera is None else world_to_camera[order],
        **details,
    )


def moved(
    poses: Float[np.ndarray, "T J 3"],
    transl: Float[np.ndarray, "T 3"],
    rotation: Float[np.ndarray, "*T 3 3"],
    shift: Float[np.ndarray, "*T 3"],
    pelvis: Float[np.ndarray, "3"],
) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T 3"]]:
    """Poses and translation in a world where points x of the old one are ``rotation x + shift``.

    The root turns about the pelvis and not about the origin, so that its rest position matters:
    ``pelvis + transl' = rotation (pelvis + transl) + shift``.
    """
    turned = poses.copy()
    root = Rotation.from_matrix(rotation) * Rotation.from_rotvec(poses[:, 0])
    turned[:, 0] = root.as_rotvec()
    placed = (rotation @ (pelvis + transl)[:, :, None])[:, :, 0] + shift
    return turned, placed - pelvis
