"""Limbs that look the same when they point as far towards the camera as away from it."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from evsplat.body.rotations import nearest_axis_angle
from evsplat.posing.kinematics import cross_matrix, pose, row_slice
from evsplat.posing.problem import Problem, State, descend

_BONES = {
    **{f"{side}_{limb}": (f"{side}_{limb}", f"{side}_{end}")
       for limb, end in (("thigh", "shin"), ("shin", "foot"),
                         ("upper_arm", "forearm"), ("forearm", "hand"))
       for side in ("left", "right")},
}  # fmt: skip
"""Parts that are turned over, with the part that begins where their bone ends."""
_WITH_NEXT = {f"{s}_{a}": f"{s}_{b}" for a, b in (("thigh", "shin"), ("upper_arm", "forearm"))
              for s in ("left", "right")}  # fmt: skip
_DEEP_M = 0.08
"""A stretch of time is looked at where the bone's end is this much nearer or farther somewhere."""
_TRIED, _STEPS = 4, 3
_DEAREST = 0.3
"""Stretches whose price grows by more than this share when turned over are not tried."""
_IN_DOUBT = 3.0
"""Logarithm of the odds below which the other depth stays possible."""


@dataclass(frozen=True)
class Doubt:
    """A limb that may as well point the other way in depth, for some time."""

    part: str
    start_us: int
    end_us: int
    odds_log: float
    """Natural logarithm of the odds for what was kept."""


@dataclass(frozen=True)
class _Stretch:
    part: str
    with_next: bool
    first: int
    last: int
    """Times of the grid, both included."""


def settle_flips(
    problem: Problem, state: State, price: float
) -> tuple[State, float, tuple[Doubt, ...]]:
    """Try limbs turned over in depth, one stretch of time each; keep what costs less.

    A bone seen from one camera has two depths that look alike; its mirror image about the plane
    through its joint that faces the camera is the other. The cheapest mirror images are fitted by a
    few steps. What comes out within a factor of ``exp(3)`` of equal odds is told as a doubt.
    """
    tried: list[tuple[float, _Stretch, State]] = []
    for stretch in _stretches(problem, state):
        other = _turned_over(problem, state, stretch)
        cost = problem.price(other)
        if cost < price * (1 + _DEAREST):
            tried.append((cost, stretch, other))
    tried.sort(key=lambda one: one[0])
    pictures = problem.independent_pictures
    doubts: list[Doubt] = []
    for _, stretch, _ in tried[:_TRIED]:
        other, cost = descend(problem, _turned_over(problem, state, stretch), _STEPS)
        odds = abs(cost - price) * pictures
        if odds < _IN_DOUBT and _differ(problem, state, other, stretch):
            grid = problem.grid_s
            start, end = (round(float(grid[i]) * 1e6) for i in (stretch.first, stretch.last))
            doubts.append(Doubt(stretch.part, start, end, odds))
        if cost < price:
            state, price = other, cost
    if tried:
        state, price = descend(problem, state, 4 * _STEPS)
    return state, price, tuple(doubts)


def _stretches(problem: Problem, state: State) -> Iterator[_Stretch]:
    """Runs of times in which a bone points one way in depth, and does so clearly somewhere."""
    rig = problem.rig
    posed = pose(rig, problem.grid.of(state.control), state.betas)
    away = problem.away(posed)
    for part, (begin, end) in _BONES.items():
        bone = posed.joints[:, rig.joint(end)] - posed.joints[:, rig.joint(begin)]
        depth = (bone * away).sum(-1)
        edges = [0, *(torch.nonzero(depth[1:] * depth[:-1] < 0)[:, 0] + 1).tolist(), len(depth)]
        for first, stop in zip(edges[:-1], edges[1:], strict=True):
            if float(depth[first:stop].abs().max()) > _DEEP_M:
                yield _Stretch(part, False, first, stop - 1)
                if part in _WITH_NEXT:
                    yield _Stretch(part, True, first, stop - 1)


def _turned_over(problem: Problem, state: State, stretch: _Stretch) -> State:
    """The motion with a bone (and the next one) mirrored in depth during a stretch of time."""
    rig, times = problem.rig, slice(stretch.first, stretch.last + 1)
    vectors = problem.grid.of(state.control)
    posed = pose(rig, vectors, state.betas)
    away = problem.away(posed)
    turned = posed.turned.clone()
    parts = [stretch.part] + ([_WITH_NEXT[stretch.part]] if stretch.with_next else [])
    for part in parts:
        begin, end = (rig.joint(name) for name in _BONES[part])
        bone = posed.joints[:, end] - posed.joints[:, begin]
        depth = (bone * away).sum(-1, keepdim=True)
        turn = _smallest_turns(bone, bone - 2 * depth * away)
        turned[times, begin] = (turn @ posed.turned[:, begin])[times]
    changed = vectors.clone()
    for part in _affected(parts):
        joint = rig.joint(part)
        local = turned[:, rig.parents[joint]].mT @ turned[:, joint]
        columns = row_slice(part)
        vector = Rotation.from_matrix(local[times].numpy()).as_rotvec()
        before = vectors[max(stretch.first - 1, 0), columns][None].numpy()
        followed = nearest_axis_angle(
            torch.cat([torch.from_numpy(before), torch.from_numpy(vector)]).numpy()[:, None]
        )
        changed[times, columns] = torch.from_numpy(followed[1:, 0])
    moved = problem.spline.through(problem.grid_s, changed - vectors, smooth_s=0.01)
    return State(state.control + moved, state.shared)


def _differ(problem: Problem, state: State, other: State, stretch: _Stretch) -> bool:
    """True where the bone points the other way in depth: the steps did not lead back."""
    begin, end = (problem.rig.joint(name) for name in _BONES[stretch.part])
    deep = []
    for one in (state, other):
        posed = pose(problem.rig, problem.grid.of(one.control), one.betas)
        bone = posed.joints[:, end] - posed.joints[:, begin]
        depth = (bone * problem.away(posed)).sum(-1)
        deep.append(float(depth[stretch.first : stretch.last + 1].mean()))
    return deep[0] * deep[1] < 0


def _affected(parts: list[str]) -> list[str]:
    """The parts themselves and the next one, which keeps its direction in the world."""
    side, last = parts[-1].split("_", 1)
    after = {"thigh": "shin", "shin": "foot", "upper_arm": "forearm", "forearm": "hand"}[last]
    return [*parts, f"{side}_{after}"]


def _smallest_turns(
    start: Float[Tensor, "T 3"], end: Float[Tensor, "T 3"]
) -> Float[Tensor, "T 3 3"]:
    """Rotations by the smallest angles from one direction to another."""
    a = torch.nn.functional.normalize(start, dim=-1)
    b = torch.nn.functional.normalize(end, dim=-1)
    cross, cosine = torch.linalg.cross(a, b), (a * b).sum(-1)
    skew = cross_matrix(cross)
    # Opposite directions have no smallest turn; any near one does, and the fit goes on from there.
    share = 1 / (1 + cosine).clamp_min(1e-2)
    turn = torch.eye(3, dtype=start.dtype) + skew + share[:, None, None] * skew @ skew
    u, _, v = torch.linalg.svd(turn)
    return u @ v
