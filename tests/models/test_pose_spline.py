"""The spline of pose residuals: scipy's values, a fixed gauge, and known errors found again."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline, CubicSpline

from evsplat.body import BodyTrack, axis_angle_to_matrix, default_body
from evsplat.body.smoothing import motion_noise
from evsplat.models.pose_spline import STIFFEST, PoseSpline
from evsplat.objectives import PosePrior

FRAMES = [40_000, 140_000, 320_000, 700_000, 910_000]


def make(seed: int = 0, knot_us: float = 93_000, joints: int = 4) -> tuple[PoseSpline, BSpline]:
    """A spline, and scipy's with random control points (K, J, 3) in their `c`."""
    rng = np.random.default_rng(seed)
    first, last = 10_000, 990_000
    stiffness = torch.tensor(rng.uniform(0, 1e-4, joints + 1))
    spline = PoseSpline(
        (first, last), knot_us, FRAMES, joint_rad=torch.tensor([0.03, 0.0, 0.5, 1.0])[:joints],
        root_m=0.02, stiffness_s3=stiffness,
    )  # fmt: skip
    knots = first + knot_us * np.arange(-3, spline.count + 1)
    points = rng.normal(size=(spline.count, joints, 3))
    return spline, BSpline(knots * 1e-6, points, 3)


def residual(
    spline: PoseSpline, times: list[int], points: torch.Tensor, root: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Turns and shifts at ``times`` with control points (K, J, 3), and (K, 3) of the root."""
    with torch.no_grad():
        spline.rotations.copy_(points)
        spline.translations.copy_(points[:, 0] if root is None else root)
        return spline.residual(times)


@pytest.mark.parametrize("seed", range(3))
def test_values_and_bends_are_scipys(seed):
    spline, scipys = make(seed, knot_us=[40_000, 93_000, 5_000_000][seed])
    times = np.random.default_rng(seed).integers(10_000, 990_001, size=40)
    times[:2] = 10_000, 990_000
    seconds = times * 1e-6
    points = torch.tensor(scipys.c, dtype=torch.float32)
    value = torch.einsum("tk,kjc->tjc", spline.weights(times.tolist()) + spline.mean, points)
    assert np.allclose(value, scipys(seconds), atol=1e-5)
    bend = torch.einsum("tk,kjc->tjc", spline.weights(times.tolist(), derivative=2), points)
    scale = max(1.0, np.abs(scipys(seconds, 2)).max())
    assert np.allclose(bend / scale, scipys(seconds, 2) / scale, atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_the_mean_over_frames_is_zero_and_a_constant_says_nothing(seed):
    spline, scipys = make(seed)
    points = torch.tensor(scipys.c, dtype=torch.float32)
    turns, shifts = residual(spline, FRAMES, points)
    assert turns.mean(0).abs().max() < 1e-6
    assert shifts.mean(0).abs().max() < 1e-7
    times = list(range(0, 1_000_000, 70_000))
    moved, given = (residual(spline, times, points + more)[0] for more in (3.0, 0.0))
    assert torch.allclose(moved, given, atol=1e-5)


def test_units_still_joints_and_held_ends():
    spline, scipys = make(1)
    points = torch.tensor(scipys.c, dtype=torch.float32)
    found, shifts = residual(spline, [200_000], points, points[:, 2])
    assert (found[:, 1] == 0).all()
    plain = (spline.weights([200_000]) @ points.flatten(1)).view(1, -1, 3)
    assert torch.allclose(found[:, 2], 0.5 * plain[:, 2], atol=1e-6)
    assert torch.allclose(shifts, 0.02 * plain[:, 2])
    ends, _ = residual(spline, [-50_000, 10_000, 990_000, 2_000_000], points)
    assert torch.equal(ends[0], ends[1]) and torch.equal(ends[2], ends[3])


def test_the_price_is_that_of_scipys_curve():
    spline, scipys = make(2)
    times = np.array([10_000, 210_000, 400_000, 610_000, 800_000, 990_000])
    points = torch.tensor(scipys.c, dtype=torch.float32)
    root = points[:, 0].flip(0)
    residual(spline, [], points, root)
    model = SimpleNamespace(residual=spline, residual_active=True)
    found = PosePrior(times.tolist()).loss(SimpleNamespace(model=model))["pose_prior"].detach()
    gap, seconds, frames = 0.196, times * 1e-6, np.array(FRAMES) * 1e-6
    prices = []
    curves = [BSpline(scipys.t, scipys.c[:, joint], 3) for joint in (0, 2, 3)]
    curves.append(BSpline(scipys.t, root.double().numpy(), 3))
    stiffness = [*spline.joint_stiffness[[0, 2, 3]], spline.root_stiffness]
    for curve, stiff in zip(curves, stiffness, strict=True):
        value = curve(seconds) - curve(frames).mean(0)
        bend = curve(seconds, 2)
        prices.append((value**2).mean() + float(stiff) * gap * (bend**2).mean())
    assert float(found) == pytest.approx(np.mean(prices), rel=1e-4)
    model.residual_active = False
    assert PosePrior(times.tolist()).loss(SimpleNamespace(model=model)) == {}


@pytest.mark.parametrize("seed", range(3))
def test_held_at_keys_it_is_scipys_curve_less_the_cubic_through_its_keys(seed):
    rng = np.random.default_rng(seed)
    keys = np.sort(rng.choice(np.arange(10_000, 990_001, 1_000), 9, replace=False))
    keys[0], keys[-1] = 10_000, 990_000
    spline = PoseSpline(
        (10_000, 990_000), 50_000, FRAMES, joint_rad=torch.ones(2), root_m=1.0,
        held_us=keys.tolist(),
    )  # fmt: skip
    knots = 10_000 + 50_000 * np.arange(-3, spline.count + 1)
    free = BSpline(1e-6 * knots, rng.normal(size=(spline.count, 2, 3)), 3)
    through = CubicSpline(1e-6 * keys, free(1e-6 * keys))
    points = torch.tensor(free.c, dtype=torch.float32)
    assert residual(spline, keys.tolist(), points)[0].abs().max() < 1e-5
    times = rng.integers(10_000, 990_001, size=40)
    seconds = 1e-6 * times
    expected = free(seconds) - through(seconds)
    assert np.abs(expected).max() > 0.3
    assert np.allclose(residual(spline, times.tolist(), points)[0], expected, atol=1e-4)
    bend = torch.einsum("tk,kjc->tjc", spline.weights(times.tolist(), derivative=2), points)
    expected = free(seconds, 2) - through(seconds, 2)
    assert np.allclose(bend, expected, atol=1e-4 * np.abs(expected).max())
    outside, _ = residual(spline, [-5_000, 2_000_000], points)
    assert outside.abs().max() < 1e-5


def dance(seed: int):
    rng = np.random.default_rng(seed)
    body = default_body()
    times = np.arange(16) * 80_000
    poses = 0.4 * np.sin(times[:, None, None] * 3e-6 + rng.uniform(0, 6, (len(body.parents), 3)))
    return body, times, poses, 0.1 * rng.normal(size=(16, 3)).cumsum(0)


def joints_of(body, rotations, transl):
    return body.joint_transforms(rotations, transl)[..., :3, 3]


def test_gradients_are_those_of_finite_differences():
    body, times, poses, transl = dance(0)
    track = BodyTrack(body, times, poses, transl)
    spline = PoseSpline.of(
        track, motion_noise(track), times[::3].tolist(),
        knot_frames=1.5, joint_rad=0.3, root_m=0.1, stiff=False,
    )  # fmt: skip
    rng = np.random.default_rng(3)
    points = spline.rotations
    torch.nn.init.normal_(points, std=0.5, generator=torch.Generator().manual_seed(3))
    drawn = [90_000, 500_000]
    base, shift = track.at(drawn)
    look = torch.tensor(rng.normal(size=(2, len(body.parents), 3)), dtype=torch.float32)

    def value():
        turned = base @ axis_angle_to_matrix(spline.residual(drawn)[0])
        return (joints_of(body, turned, shift) * look).sum()

    direction = torch.tensor(rng.normal(size=points.shape), dtype=torch.float32)
    (gradient,) = torch.autograd.grad(value(), points)
    with torch.no_grad():
        points += 0.01 * direction
        ahead = value()
        points -= 0.02 * direction
        behind = value()
    assert float((gradient * direction).sum()) == pytest.approx(
        float(ahead - behind) / 0.02, rel=2e-3
    )


@pytest.mark.parametrize("seed", [4])
def test_known_errors_of_key_poses_are_found_again(seed):
    """Joints seen at random times in between tell the errors of the key poses, but their mean."""
    body, times, poses, transl = dance(seed)
    rng = np.random.default_rng(seed + 50)
    wrong = 0.03 * rng.normal(size=poses.shape)
    wrong -= wrong.mean(0)
    wrong[:, len(body.parents) // 2 :] = 0
    moved = 0.01 * rng.normal(size=transl.shape)
    moved -= moved.mean(0)
    truth = BodyTrack(body, times, poses, transl)
    given = BodyTrack(body, times, poses + wrong, transl + moved)
    spline = PoseSpline.of(
        given, motion_noise(given), times.tolist(),
        knot_frames=1, joint_rad=0.03, root_m=0.01, stiff=False,
    )  # fmt: skip
    adam = torch.optim.Adam(spline.parameters(), lr=0.2)

    def error(drawn):
        rotations, transl = given.at(drawn)
        turns, shifts = spline.residual(drawn)
        found = joints_of(body, rotations @ axis_angle_to_matrix(turns), transl + shifts)
        return found - joints_of(body, *truth.at(drawn))

    keys = times.tolist()
    before = float(error(keys).detach().norm(dim=-1).mean())
    for step in range(150):
        adam.param_groups[0]["lr"] = 0.2 * 0.98**step
        adam.zero_grad()
        drawn = rng.integers(0, times[-1], 12).tolist()
        (1e4 * error(drawn).square().mean()).backward()
        adam.step()
    assert before > 0.01
    assert float(error(keys).detach().norm(dim=-1).mean()) < 0.2 * before


def test_stiffness_is_that_of_the_smoothing_but_bounded():
    body, times, poses, transl = dance(1)
    noisy = poses + 0.03 * np.random.default_rng(1).normal(size=poses.shape)
    track = BodyTrack(body, times, noisy, transl)
    noise = motion_noise(track)
    options = dict(knot_frames=1, joint_rad=0.03, root_m=0.01)
    spline = PoseSpline.of(track, noise, times.tolist(), **options, stiff=True)
    bound = STIFFEST * 0.08**3
    assert np.allclose(spline.joint_stiffness, np.minimum(noise.stiffness_s3[:-1], bound))
    loose = PoseSpline.of(track, noise, times.tolist(), **options, stiff=False)
    assert float(loose.joint_stiffness.abs().sum() + loose.root_stiffness) == 0
