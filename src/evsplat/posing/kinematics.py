"""Places of points on a rig at many times, and their derivatives by its degrees of freedom.

What describes a pose at one time is a vector of `SIZE` numbers: six for the root's orientation in
the world (`evsplat.body.rotations.six_to_matrix`), three for the root joint's place, and three for
each of `ROWS`, axis-angle.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from evsplat.body.rotations import six_to_matrix
from evsplat.posing.rig import ROWS, Rig, local_rotations

SIX, PLACE, TURNS = slice(0, 6), slice(6, 9), slice(9, 9 + 3 * len(ROWS))
SIZE = TURNS.stop


def row_slice(name: str) -> slice:
    """Where the three numbers of a row stand."""
    start = TURNS.start + 3 * ROWS.index(name)
    return slice(start, start + 3)


@dataclass(frozen=True)
class Posed:
    """A rig at T times, world axes."""

    vectors: Float[Tensor, "T S"]
    turned: Float[Tensor, "T J 3 3"]
    """World rotation of each joint, in the frames of the body that ships."""
    joints: Float[Tensor, "T J 3"]
    bones: Float[Tensor, "J 3"]


def pose(rig: Rig, vectors: Float[Tensor, "T S"], betas: Float[Tensor, "B"]) -> Posed:
    """Forward kinematics."""
    bones = rig.bones + torch.einsum("b,bjc->jc", betas, rig.bone_directions)
    rows = vectors[:, TURNS].unflatten(1, (-1, 3))
    local = local_rotations(rig, six_to_matrix(vectors[:, SIX]), rows)
    turned, joints = [local[:, 0]], [vectors[:, PLACE]]
    for joint, parent in enumerate(rig.parents[1:], start=1):
        joints.append(joints[parent] + turned[parent] @ bones[joint])
        still = int(rig.row[joint]) < 0
        turned.append(turned[parent] if still else turned[parent] @ local[:, joint])
    return Posed(vectors, torch.stack(turned, 1), torch.stack(joints, 1), bones)


@dataclass(frozen=True)
class Points:
    """L points of a rig: at joint ``origin``, plus an ``offset`` in the frame of ``turner``."""

    origin: Int64[Tensor, "L"]
    turner: Int64[Tensor, "L"]
    offset: Float[Tensor, "L 3"]

    def of(self, posed: Posed) -> Float[Tensor, "T L 3"]:
        """Places in the world."""
        return posed.joints[:, self.origin] + self._arm(posed)

    def jacobian(
        self, rig: Rig, posed: Posed
    ) -> tuple[Float[Tensor, "T L 3 S"], Float[Tensor, "T L 3 B"]]:
        """Derivatives of the places by the pose's numbers and by the shape coefficients."""
        times, count = len(posed.vectors), len(self.origin)
        above = _ancestors(rig.parents)
        arm = self._arm(posed)
        by_vector = posed.vectors.new_zeros(times, count, 3, SIZE)
        by_vector[..., PLACE] = torch.eye(3, dtype=torch.float64)
        place = posed.joints[:, self.origin]
        moving = [joint for joint in range(len(rig.parents)) if joint == 0 or rig.row[joint] >= 0]
        rates = _rates(rig, posed)
        for joint in moving:
            on_way, turns = above[self.origin, joint], above[self.turner, joint]
            reached = torch.nonzero(on_way | turns)[:, 0]
            if not len(reached):
                continue
            lever = on_way[reached, None] * (place[:, reached] - posed.joints[:, joint, None])
            lever = lever + turns[reached, None] * arm[:, reached]
            columns = SIX if joint == 0 else row_slice(ROWS[int(rig.row[joint])])
            # d(place) = (rate d(vector)) x lever
            moved = torch.linalg.cross(
                rates[joint][:, None].mT.expand(-1, len(reached), -1, -1), lever[:, :, None], dim=-1
            ).mT
            by_vector[:, reached, :, columns] += moved
        way = above[self.origin].double()
        way[:, 0] = 0
        parents = [max(parent, 0) for parent in rig.parents]
        grown = torch.einsum("tjac,bjc->tjab", posed.turned[:, parents], rig.bone_directions)
        return by_vector, torch.einsum("lj,tjab->tlab", way, grown)

    def _arm(self, posed: Posed) -> Float[Tensor, "T L 3"]:
        return (posed.turned[:, self.turner] @ self.offset[:, :, None])[..., 0]


def _rates(rig: Rig, posed: Posed) -> dict[int, Float[Tensor, "T 3 C"]]:
    """World rotation vector of each moving joint per change of its numbers."""
    rates = {0: six_rates(posed.vectors[:, SIX])}
    for joint, parent in enumerate(rig.parents):
        row = int(rig.row[joint])
        if row >= 0 and joint:
            share = rig.share[joint]
            vector = posed.vectors[:, row_slice(ROWS[row])] * share
            rates[joint] = posed.turned[:, parent] @ left_jacobian(vector) * share
    return rates


def left_jacobian(vectors: Float[Tensor, "*T 3"]) -> Float[Tensor, "*T 3 3"]:
    """Rotation vector, in outer axes, of ``exp(v + d) exp(v)^T`` per small ``d``.

    ``I + (1 - cos a) / a^2 [v] + (a - sin a) / a^3 [v]^2`` with ``a = |v|``.
    """
    squared = (vectors * vectors).sum(-1)[..., None, None]
    small = squared < 1e-6
    safe = torch.where(small, torch.ones_like(squared), squared)
    angle = safe.sqrt()
    first = torch.where(small, 0.5 - squared / 24, (1 - angle.cos()) / safe)
    second = torch.where(small, 1 / 6 - squared / 120, (angle - angle.sin()) / (safe * angle))
    cross = cross_matrix(vectors)
    eye = torch.eye(3, dtype=vectors.dtype)
    return eye + first * cross + second * cross @ cross


def six_rates(six: Float[Tensor, "T 6"]) -> Float[Tensor, "T 3 6"]:
    """World rotation vector of `six_to_matrix` per change of its six numbers."""
    rows = six_to_matrix(six)
    r1, r2, r3 = rows.unbind(1)
    a, b = six[:, :3], six[:, 3:]
    along = (r1 * b).sum(-1, keepdim=True)
    length = a.norm(dim=-1, keepdim=True)
    width = (b - along * r1).norm(dim=-1, keepdim=True)
    zero = torch.zeros_like(r1)
    by_a = torch.stack((along / (length * width) * r3, r3 / length, -r2 / length), 1)
    by_b = torch.stack((-r3 / width, zero, zero), 1)
    return torch.cat((by_a, by_b), 2)


def cross_matrix(vectors: Float[Tensor, "*T 3"]) -> Float[Tensor, "*T 3 3"]:
    """Matrices whose products are the cross products with ``vectors`` at their left."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).unflatten(-1, (3, 3))


def _ancestors(parents: tuple[int, ...]) -> Tensor:
    """[a, b]: b is a or above it."""
    above = torch.eye(len(parents), dtype=torch.bool)
    for joint, parent in enumerate(parents):
        if parent >= 0:
            above[joint] |= above[parent]
    return above
