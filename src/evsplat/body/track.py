"""The body's pose at any time: smooth rotation and translation splines through the key poses."""

import copy
from collections.abc import Iterator, Sequence
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline
from torch import Tensor

from evsplat.body.body import Body, skin
from evsplat.body.canonical import find_legs
from evsplat.body.pose_errors import PoseErrors
from evsplat.body.rotations import axis_angle_to_matrix
from evsplat.devices import send
from evsplat.errors import DataError

_MOST_KEYS = 24
"""Key poses that tell which way is up, at most."""
_CAMERA_UP_WEIGHT = 0.5
_KEPT_KEYS = 2_048
"""Keys up to which the polynomials between them are kept."""
_TIMES_AT_ONCE = 1_024
"""On the way to a pose there are ten times as many numbers as in it."""


class BodyTrack:
    """Pose of a body over time, twice continuously differentiable between first and last key.

    Rotations: per joint, ``R(t) = R_i exp(p_i(t - t_i))`` with a cubic polynomial p_i of axis-angle
    vectors (scipy's RotationSpline). Translation: a cubic spline. With two keys both are linear
    (slerp), with one constant. Outside the keys the nearest key pose is held.
    """

    def __init__(
        self,
        body: Body,
        times_us: Int[np.ndarray, "P"],
        poses: Float[np.ndarray, "P J 3"],
        transl: Float[np.ndarray, "P 3"],
        *,
        source: str = "body track",
        errors: PoseErrors | None = None,
        camera_up: Float[Tensor, "3"] | None = None,
        up: Float[Tensor, "3"] | None = None,
    ) -> None:
        times = np.asarray(times_us, dtype=np.int64)
        # As they are given: an hour's are kept once, in the file's float32.
        self._poses = np.asarray(poses)
        if self._poses.dtype != np.float32:
            self._poses = self._poses.astype(np.float64, copy=False)
        poses = self.poses
        transl = np.asarray(transl, dtype=np.float64)
        _check(body, times, poses, transl, source)
        if errors is not None:
            errors.check(len(times), len(body.parents), source)
        self.body = body
        self.errors = errors
        """How far the key poses err; None where nobody says."""
        self.camera_up = camera_up
        """Mean of the unit vectors in the world that lie upwards in the pictures of the cameras
        that recorded the body; None where none did."""
        self.up = up
        """Upwards in the world, of any length; None where nobody says, and `up_axis` finds it."""
        self.times_us = times
        self.transl = transl
        seconds = (times - times[0]) * 1e-6
        # On the host, since a GPU would take a launch per operation for a few hundred numbers.
        # Those of an hour are many: of its turns only the rates at the keys are kept, in float32,
        # which errs by less than 1e-6 rad; the polynomials would be three times as much.
        self._seconds = torch.from_numpy(seconds)
        moving = (poses != poses[:1]).any((0, 2))
        self._moving = torch.from_numpy(np.flatnonzero(moving))
        """Joints that turn at all; the others' rates are not kept."""
        self._rates = torch.from_numpy(_rates(seconds, poses[:, moving]))
        self._places = torch.from_numpy(_places(seconds, transl))
        self._known: Tensor | None = None
        if 1 < len(seconds) <= _KEPT_KEYS:
            self._known = self._cubics(torch.arange(len(seconds) - 1))

    @property
    def poses(self) -> Float[np.ndarray, "P J 3"]:
        """Key poses, axis-angle, float64."""
        return self._poses.astype(np.float64, copy=False)

    def to(self, device: torch.device | str) -> "BodyTrack":
        """The same track, whose poses are for ``device``."""
        moved = copy.copy(self)
        moved.body = self.body.to(device)
        return moved

    def with_body(self, body: Body) -> "BodyTrack":
        """The same motion of a body with the same joints and another surface."""
        other = copy.copy(self)
        other.body = body
        return other

    def with_keys(
        self,
        times_us: Int[np.ndarray, "P"],
        poses: Float[np.ndarray, "P J 3"],
        transl: Float[np.ndarray, "P 3"],
        *,
        source: str = "body track",
        errors: PoseErrors | None = None,
    ) -> "BodyTrack":
        """Another motion of the same body in the same world, as `BodyTrack` takes it."""
        return BodyTrack(
            self.body,
            times_us,
            poses,
            transl,
            source=source,
            errors=errors,
            camera_up=self.camera_up,
            up=self.up,
        )

    def with_errors(self, errors: PoseErrors) -> "BodyTrack":
        """The same motion, whose key poses err so."""
        errors.check(len(self.times_us), len(self.body.parents), "body track")
        other = copy.copy(self)
        other.errors = errors
        return other

    @property
    def device(self) -> torch.device:
        """Of the body, and of the poses that `at` gives."""
        return self.body.rest_joints.device

    def at(
        self, times_us: Int[Tensor, "T"] | Sequence[int]
    ) -> tuple[Float[Tensor, "T J 3 3"], Float[Tensor, "T 3"]]:
        """Rotations local to the parent (root: in the world) and root translation, float32."""
        times = torch.as_tensor(times_us, dtype=torch.int64, device="cpu")
        if len(times) <= _TIMES_AT_ONCE:
            rotations, places = self._at(times)
        else:
            parts = zip(*map(self._at, times.split(_TIMES_AT_ONCE)), strict=True)
            rotations, places = (torch.cat(part) for part in parts)
        return send(rotations, self.device), send(places, self.device)

    def _at(self, times: Int[Tensor, "T"]) -> tuple[Float[Tensor, "T J 3 3"], Float[Tensor, "T 3"]]:
        seconds = (times - int(self.times_us[0])).double() * 1e-6
        seconds = seconds.clamp(self._seconds[0], self._seconds[-1])
        index = torch.searchsorted(self._seconds, seconds, right=True) - 1
        index = index.clamp(0, len(self._places) - 1)
        step = seconds - self._seconds[index]
        poses = torch.from_numpy(self._poses)[index].double()
        turned = torch.zeros_like(poses)
        if len(self._seconds) > 1:
            turned[:, self._moving] = self._turned(index, step)
        key, since = axis_angle_to_matrix(torch.stack([poses, turned]))
        c3, c2, c1, c0 = self._places[index].unbind(-2)
        since_s = step[:, None]
        places = ((c3 * since_s + c2) * since_s + c1) * since_s + c0
        return (key @ since).float(), places.float()

    def _turned(self, index: Int[Tensor, "T"], step: Float[Tensor, "T"]) -> Float[Tensor, "T M 3"]:
        """Turns of the moving joints in ``step`` seconds since a key, axis-angle."""
        cubics = self._cubics(index) if self._known is None else self._known[index]
        c3, c2, c1 = cubics.unbind(-2)
        since_s = step[:, None, None]
        return ((c3 * since_s + c2) * since_s + c1) * since_s

    def _cubics(self, index: Int[Tensor, "I"]) -> Float[Tensor, "I M 3 3"]:
        """Coefficients (highest first) of the turns since a key, by seconds; the constant is zero.

        The cubics that have the turn to the next key, and the rates at both, as their ends.
        """
        keys = torch.from_numpy(self._poses)
        first, second = (keys[at][:, self._moving].double() for at in (index, index + 1))
        whole = _turn_between(first, second)
        gap_s = (self._seconds[index + 1] - self._seconds[index])[:, None, None]
        before, after = (self._rates[at].double() for at in (index, index + 1))
        mean, after = whole / gap_s, _vector_rate(whole, after)
        cubics = (before + after - 2 * mean) / gap_s**2, (3 * mean - 2 * before - after) / gap_s
        return torch.stack([*cubics, before], -2)

    def bones(self, times_us: Int[Tensor, "T"] | Sequence[int]) -> Float[Tensor, "T J 4 4"]:
        """Bone transforms, canonical pose to world, at the given times."""
        return self.body.canonical_to_world(*self.at(times_us))

    def vertices(self, time_us: int) -> Float[Tensor, "V 3"]:
        """The posed body's vertices in the world at one time."""
        return next(self.vertices_at([time_us]))

    def vertices_at(self, times_us: Sequence[int]) -> Iterator[Float[Tensor, "V 3"]]:
        """`vertices` at each of the times, one after the other; poses are asked for at once."""
        body = self.body
        for bones in self.bones(times_us).split(1):
            yield skin(body.canonical_vertices(), body.weights, bones)[0][0]


def up_axis(track: BodyTrack) -> Float[Tensor, "3"]:
    """The signed world axis nearest to ``track.up``; without it, to the body's own up direction.

    That is on average over the track. Somebody who turns cartwheels points nowhere on average; so
    what the cameras show upwards counts as well, half as much, since cameras may be turned by 90
    degrees. Somebody who lies in all of the recording looks to a level camera as somebody who
    stands looks to one on its side, contact with the floor included (on one's side as standing with
    closed legs): no motion of theirs tells which it is, and cameras on their side are the more
    usual ones. Hence ``track.up``.
    """
    if track.up is not None:
        return nearest_axis(track.up)
    body = track.body
    legs = find_legs(body.parents.tolist(), body.joint_names)
    rest = body.canonical_vertices()
    if legs is None:
        tallest = int((rest.amax(0) - rest.amin(0)).argmax())
        below = rest[:, tallest] < rest[:, tallest].mean()
    else:
        below = _leg_share(body, (legs.left, legs.right)) > 0.5
    times = track.times_us[:: -(-len(track.times_us) // _MOST_KEYS)]
    posed = track.vertices_at(times.tolist())
    directions = torch.stack([v[~below].mean(0) - v[below].mean(0) for v in posed]).cpu()
    direction = torch.nn.functional.normalize(directions, dim=1).mean(0)
    if track.camera_up is not None:
        direction = direction + _CAMERA_UP_WEIGHT * track.camera_up.to(direction)
    return nearest_axis(direction)


def nearest_axis(direction: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """The signed world axis that is nearest to a direction."""
    nearest = torch.zeros(3)
    axis = int(direction.abs().argmax())
    nearest[axis] = direction[axis].sign()
    return nearest


def _rates(
    seconds: Float[np.ndarray, "P"], poses: Float[np.ndarray, "P M 3"]
) -> Float[np.ndarray, "P M 3"]:
    """Angular rates at the keys, radians per second about each joint's own axes, float32."""
    if len(poses) > _KEPT_KEYS:
        return _found_rates(seconds, poses)
    return _known_rates(seconds.tobytes(), poses.tobytes(), poses.shape).copy()


@lru_cache(maxsize=4)
def _known_rates(
    seconds: bytes, poses: bytes, shape: tuple[int, int, int]
) -> Float[np.ndarray, "P M 3"]:
    """As `_rates` of float64: a capture's motion is read several times in one command."""
    # Copied, since scipy takes no array that is read-only.
    return _found_rates(np.frombuffer(seconds).copy(), np.frombuffer(poses).reshape(shape).copy())


def _found_rates(
    seconds: Float[np.ndarray, "P"], poses: Float[np.ndarray, "P M 3"]
) -> Float[np.ndarray, "P M 3"]:
    rates = np.zeros(poses.shape, np.float32)
    if len(poses) == 1:
        return rates
    for joint in range(poses.shape[1]):
        spline = RotationSpline(seconds, Rotation.from_rotvec(poses[:, joint]))
        c3, c2, c1, _ = spline.interpolator.c
        rates[:-1, joint] = c1
        gap_s = seconds[-1] - seconds[-2]
        whole = ((c3[-1] * gap_s + c2[-1]) * gap_s + c1[-1]) * gap_s
        end = (3 * c3[-1] * gap_s + 2 * c2[-1]) * gap_s + c1[-1]
        columns = _vector_rate(torch.from_numpy(whole).expand(3, 3), torch.eye(3).double())
        rates[-1, joint] = np.linalg.solve(columns.T.numpy(), end)
    return rates


def _turn_between(
    first: Float[Tensor, "*batch 3"], second: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """Turns from one rotation to another about the first one's axes, axis-angle vectors each."""
    from_first, to_second = (
        Rotation.from_rotvec(each.reshape(-1, 3).numpy()) for each in (first, second)
    )
    return torch.from_numpy((from_first.inv() * to_second).as_rotvec()).view_as(first)


def _vector_rate(
    turn: Float[Tensor, "*batch 3"], rates: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """Rates of axis-angle vectors at angular rates (as scipy's RotationSpline has them)."""
    angle = turn.norm(dim=-1, keepdim=True)
    half = 0.5 * angle.clamp_min(1e-4)
    share = torch.where(
        angle > 1e-4, (1 - half / half.tan()) / (2 * half).square(), 1 / 12 + angle.square() / 720
    )
    about = torch.linalg.cross(turn, rates)
    return rates + 0.5 * about + share * torch.linalg.cross(turn, about)


def _places(
    seconds: Float[np.ndarray, "P"], transl: Float[np.ndarray, "P 3"]
) -> Float[np.ndarray, "I 4 3"]:
    """Cubic coefficients (highest first) of places in each interval."""
    if len(transl) == 1:
        places = np.zeros((1, 4, 3))
        places[0, -1] = transl[0]
        return places
    return np.ascontiguousarray(CubicSpline(seconds, transl).c.transpose(1, 0, 2))


def _check(
    body: Body, times: np.ndarray, poses: np.ndarray, transl: np.ndarray, source: str
) -> None:
    joints = len(body.parents)
    expected = {"poses": (len(times), joints, 3), "transl": (len(times), 3)}
    if times.ndim != 1 or len(times) == 0:
        raise DataError(f"{source}: times_us has shape {times.shape}, expected (P,) with P >= 1.")
    for name, value in (("poses", poses), ("transl", transl)):
        if value.shape != expected[name]:
            raise DataError(f"{source}: {name} has shape {value.shape}, expected {expected[name]}.")
        if not np.isfinite(value).all():
            key = int(np.argwhere(~np.isfinite(value))[0, 0])
            raise DataError(
                f"{source}: {name}[{key}] is not finite; remove or repair that key pose."
            )
    if (np.diff(times) <= 0).any():
        key = int(np.argmax(np.diff(times) <= 0)) + 1
        raise DataError(
            f"{source}: times_us[{key}] = {times[key]} does not follow {times[key - 1]}; "
            "times must increase strictly. Sort the key poses and drop repeated ones."
        )


def _leg_share(body: Body, thighs: tuple[int, int]) -> Tensor:
    """Share of each vertex's weight that belongs to the joints from the thighs down."""
    chain = set(thighs)
    for joint, parent in enumerate(body.parents.tolist()):
        if parent in chain:
            chain.add(joint)
    return body.weights[:, sorted(chain)].sum(-1)
