"""Pose sliders: which joints they turn, about which axes, and a body held in a pose."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation
from torch import Tensor

from evsplat.body import Body, BodyTrack
from evsplat.body.retarget import trunk_axes
from evsplat.body.skeleton import Skeleton, find_skeleton
from evsplat.errors import DataError


@dataclass(frozen=True, eq=False)
class PoseSlider:
    """One angle in degrees; 0 leaves the motion as it is."""

    group: str
    label: str
    joints: tuple[int, ...]
    """Share the angle evenly."""
    axis: Float[np.ndarray, "3"]
    """Unit vector in the axes of the rest pose; positive angles turn right-handed about it."""
    within_bone: bool
    """The axis turns with the bone itself (bending, twisting); else it stays with the parent."""
    limit: float
    """Largest angle to either side."""


def pose_sliders(body: Body) -> tuple[PoseSlider, ...]:
    """Sliders of head, torso, arms and legs; none for a body whose limbs are not recognised."""
    try:
        skeleton = find_skeleton(body.parents.tolist(), body.joint_names)
    except DataError:
        return ()
    rest = body.rest_joints.cpu().double().numpy()
    left, up, ahead = trunk_axes(skeleton, rest).T
    sliders = []
    for group, joints in (("Torso", skeleton.spine), ("Head", skeleton.neck)):
        if joints:
            sliders += [
                PoseSlider(group, "forward", joints, left, False, 60),
                PoseSlider(group, "to the left", joints, -ahead, False, 45),
                PoseSlider(group, "turn left", joints, up, False, 80),
            ]
    for side, outward in (("left", ahead), ("right", -ahead)):
        sliders += _limb(skeleton, rest, side, "arm", (-left, outward), ahead)
        sliders += _limb(skeleton, rest, side, "leg", (-left, outward), -ahead)
    return tuple(sliders)


def turned(
    sliders: tuple[PoseSlider, ...], angles: tuple[float, ...], rotations: Float[Tensor, "J 3 3"]
) -> Float[Tensor, "J 3 3"]:
    """Local joint rotations with every slider's angle on top."""
    rotations = rotations.clone()
    for slider, angle in zip(sliders, angles, strict=True):
        if angle == 0:
            continue
        share = np.radians(angle) / len(slider.joints)
        turn = torch.from_numpy(Rotation.from_rotvec(share * slider.axis).as_matrix())
        turn = turn.to(rotations)
        for joint in slider.joints:
            old = rotations[joint]
            rotations[joint] = old @ turn if slider.within_bone else turn @ old
    return rotations


class HeldPose(BodyTrack):
    """A track that stands in the pose that was set last."""

    def __init__(self, track: BodyTrack) -> None:
        """Take the body of ``track``, in its first pose."""
        joints = len(track.body.parents)
        super().__init__(track.body, np.zeros(1), np.zeros((1, joints, 3)), np.zeros((1, 3)))
        # Copies of this track share the dictionary and so the pose.
        self._held: dict[str, Tensor] = {}
        self.hold(*track.at([int(track.times_us[0])]))

    def hold(self, rotations: Float[Tensor, "1 J 3 3"], transl: Float[Tensor, "1 3"]) -> None:
        """Stand in a pose from now on, at all times."""
        self._held.update(rotations=rotations, transl=transl)

    def at(
        self, times_us: Int[Tensor, "T"] | Sequence[int]
    ) -> tuple[Float[Tensor, "T J 3 3"], Float[Tensor, "T 3"]]:
        """The pose that is held, at each of the times."""
        count = len(times_us)
        rotations, transl = (self._held[name].to(self.device) for name in ("rotations", "transl"))
        return rotations.expand(count, -1, -1, -1), transl.expand(count, -1)


def _limb(
    skeleton: Skeleton,
    rest: Float[np.ndarray, "J 3"],
    side: str,
    kind: str,
    axes: tuple[np.ndarray, np.ndarray],
    bends: Float[np.ndarray, "3"],
) -> list[PoseSlider]:
    """Shoulder or hip about the trunk's axes and the bone, elbow or knee towards ``bends``."""
    parts = ("upper_arm", "forearm", "hand") if kind == "arm" else ("thigh", "shin", "foot")
    first, second, last = (skeleton.limbs[f"{side}_{part}"] for part in parts)
    bones = [rest[second] - rest[first], rest[last] - rest[second]]
    along, below = (bone / np.linalg.norm(bone) for bone in bones)
    # A turn about bone x direction takes the bone towards the direction.
    hinge = np.cross(below, bends)
    hinge = hinge / max(float(np.linalg.norm(hinge)), 1e-6)
    group = f"{side.capitalize()} {kind}"
    forward, outward = axes
    reach = 150 if kind == "arm" else 90
    return [
        PoseSlider(group, "forward", (first,), forward, False, reach),
        PoseSlider(group, "outward", (first,), outward, False, reach),
        PoseSlider(group, "twist", (first,), along, True, 90),
        PoseSlider(group, "bend", (second,), hinge, True, 130),
    ]
