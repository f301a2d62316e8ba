"""The avatar: Gaussians with four bones each, and motion clips of the skeleton."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor

from evsplat.body import BodyTrack
from evsplat.body.rotations import matrix_to_quaternion
from evsplat.errors import DataError
from evsplat.methods.reconstruction import Bakeable
from evsplat.models.at_rest import SkinnedGaussians

BONES_EACH = 4
_MOST_JOINTS = 256
KEYS_PER_SECOND = 60.0


@dataclass(frozen=True, eq=False)
class Avatar:
    """A person whose every Gaussian follows at most four bones, as graphics cards like it."""

    gaussians: SkinnedGaussians
    """Gaussians at rest; their weights are those below, divided by 255."""
    bones: UInt8[np.ndarray, "H 4"]
    """Joint numbers, heaviest first."""
    weights: UInt8[np.ndarray, "H 4"]
    """Skinning weights; they sum to 255."""


@dataclass(frozen=True, eq=False)
class Clip:
    """A motion: poses at an even rate."""

    name: str
    rate_hz: float
    rotations: Float32[np.ndarray, "T J 4"]
    """Against the parent, (w, x, y, z); the root's in the world."""
    transl: Float32[np.ndarray, "T 3"]
    """Root joint's shift from its rest place, metres."""


def avatar_of(gaussians: SkinnedGaussians) -> Avatar:
    """Keep the four heaviest bones of each Gaussian, in 255ths; the rest is shared among them."""
    joints = gaussians.weights.shape[1]
    if joints > _MOST_JOINTS:
        raise DataError(f"The body has {joints} joints; an avatar holds up to {_MOST_JOINTS}.")
    kept, bones = gaussians.weights.double().topk(min(BONES_EACH, joints), dim=1)
    exact = kept / kept.sum(1, keepdim=True) * 255
    whole = exact.floor()
    # The largest remainders take what is missing to 255.
    missing = (255 - whole.sum(1, keepdim=True)).round()
    rank = (exact - whole).argsort(1, descending=True).argsort(1)
    weights = whole + (rank < missing)
    dense = torch.zeros_like(gaussians.weights).scatter_(1, bones, (weights / 255).float())
    padding = (0, BONES_EACH - bones.shape[1])
    return Avatar(
        gaussians=replace(gaussians, weights=dense),
        bones=torch.nn.functional.pad(bones, padding).to(torch.uint8).numpy(),
        weights=torch.nn.functional.pad(weights, padding).to(torch.uint8).numpy(),
    )


def recorded_clip(source: Bakeable, gaussians: SkinnedGaussians, times_us: tuple[int, int]) -> Clip:
    """The recorded motion from the first to the second time, as the method corrected it."""
    times = _even_times(*times_us)
    rotations, bones = source.pose(times)
    root = gaussians.body.rest_joints[0]
    # Canonical to world after rest to canonical: where the root's rest place goes.
    placed = bones[:, 0] @ gaussians.body.canonical_bone_transforms()[0]
    transl = placed[:, :3, :3] @ root + placed[:, :3, 3] - root
    return _clip("recorded", rotations, transl)


def clip_of(name: str, track: BodyTrack) -> Clip:
    """Any other motion of the same body."""
    times = _even_times(int(track.times_us[0]), int(track.times_us[-1]))
    return _clip(name, *track.at(times))


def _clip(name: str, rotations: Tensor, transl: Tensor) -> Clip:
    quaternions = matrix_to_quaternion(rotations.double()).numpy()
    # Neighbouring keys on the same side, so that a player may interpolate them as they are.
    turned = (quaternions[1:] * quaternions[:-1]).sum(-1) < 0
    flips = np.where(np.cumsum(turned, axis=0) % 2 == 1, -1.0, 1.0)
    quaternions[1:] *= flips[..., None]
    return Clip(name, KEYS_PER_SECOND, quaternions.astype(np.float32), transl.numpy())


def _even_times(first: int, last: int) -> list[int]:
    count = 1 + int((last - first) * KEYS_PER_SECOND / 1e6)
    return [first + round(k * 1e6 / KEYS_PER_SECOND) for k in range(count)]
