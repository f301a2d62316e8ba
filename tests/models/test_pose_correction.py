"""Learned errors of poses: known ones found again and carried on, prices, what counts when."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from evsplat.body import BodyTrack, axis_angle_to_matrix, default_body
from evsplat.body.spline_error import apart_from_errors, spline_error
from evsplat.models.pose_correction import SHARES, PoseCorrection, _apart
from evsplat.models.ridge import Ridge

STEP_US = 80_000
KEYS = 16


def dance(seed: int) -> BodyTrack:
    rng = np.random.default_rng(seed)
    body = default_body()
    times = np.arange(KEYS) * STEP_US
    poses = 0.4 * np.sin(times[:, None, None] * 3e-6 + rng.uniform(0, 6, (len(body.parents), 3)))
    return BodyTrack(body, times, poses, 0.1 * rng.normal(size=(KEYS, 3)).cumsum(0))


def correction(
    track: BodyTrack, *, joint_rad=0.03, root_m=0.01, frames=slice(None), exact=False
) -> PoseCorrection:
    keys, joints = track.poses.shape[:2]
    return PoseCorrection(
        track,
        track.times_us[frames].tolist(),
        joint_rad=np.broadcast_to(joint_rad, (keys, joints)).copy(),
        root_m=np.broadcast_to(root_m, (keys, 3)).copy(),
        between=spline_error(track),
        exact=exact,
    )


def fill(module: torch.nn.Module, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for value in module.parameters():
            value.normal_(generator=generator)


@pytest.mark.parametrize("seed", range(2))
def test_gradients_are_those_of_finite_differences(seed):
    track = dance(seed)
    learned = correction(track, joint_rad=0.3, root_m=0.1)
    fill(learned, seed)
    drawn = [90_000, 500_000]
    base, _ = track.at(drawn)
    look = torch.randn(2, len(track.body.parents), 3)

    def value():
        turns, shifts = learned.residual(drawn)
        return ((base @ axis_angle_to_matrix(turns)).sum(-1) * look).sum() + shifts.sum()

    gradients = torch.autograd.grad(value(), list(learned.errors.parameters()))
    for parameter, gradient in zip(learned.errors.parameters(), gradients, strict=True):
        direction = torch.randn_like(parameter)
        with torch.no_grad():
            parameter += 1e-2 * direction
            ahead = value()
            parameter -= 2e-2 * direction
            behind = value()
            parameter += 1e-2 * direction
        numeric = float(ahead - behind) / 2e-2
        assert float((gradient * direction).sum()) == pytest.approx(numeric, rel=5e-3, abs=5e-3)


@pytest.mark.parametrize("seed", range(2))
def test_sizes_are_those_expected_at_each_key_and_linear_between(seed):
    rng, track = np.random.default_rng(seed), dance(seed)
    joints = track.poses.shape[1]
    joint_rad, root_m = rng.uniform(0, 0.1, (KEYS, joints)), rng.uniform(0.001, 0.1, (KEYS, 3))
    joint_rad[:, 3] = 0
    sized, plain = (
        correction(track, joint_rad=rad, root_m=m) for rad, m in ((joint_rad, root_m), (1.0, 1.0))
    )
    for each in (sized, plain):
        fill(each.errors, seed)
    times = [5 * STEP_US, int(6.25 * STEP_US), -10, (KEYS + 1) * STEP_US]
    turns, shifts = (value.detach().numpy() for value in sized.residual(times))
    unit_turns, unit_shifts = (value.detach().numpy() for value in plain.residual(times))
    at = [joint_rad[5], 0.75 * joint_rad[6] + 0.25 * joint_rad[7], *joint_rad[[0, -1]]]
    assert np.allclose(turns, unit_turns * np.array(at)[..., None], atol=1e-5)
    at = [root_m[5], 0.75 * root_m[6] + 0.25 * root_m[7], *root_m[[0, -1]]]
    assert np.allclose(shifts, unit_shifts * np.array(at), atol=1e-5)
    assert not turns[:, 3].any()


def test_motion_between_keys_that_errors_explain_is_no_unknown():
    """Nor do errors that a state tells count where it tells that poses are exact."""
    track = dance(0)
    wrong, exact = correction(track, joint_rad=3.0, root_m=9.0), correction(track, exact=True)
    with torch.no_grad():
        wrong.between.rotations.normal_()
        exact.between.rotations.normal_()
    middles = (track.times_us[:-1] + STEP_US // 2).tolist()
    assert not wrong.residual(middles)[0].any()
    wrong.load_state_dict(exact.state_dict())
    turns, _ = wrong.residual(middles)
    assert turns.abs().max() > 1e-4 and torch.equal(turns, exact.residual(middles)[0])


@pytest.mark.parametrize("exact", [False, True])
def test_what_counts_is_said_by_the_state(exact):
    track = dance(0)
    learned = correction(track, exact=exact)
    fill(learned, 1)
    keys = track.times_us.tolist()
    turns, shifts = learned.residual(keys)
    assert (float(turns.detach().abs().max()) < 1e-5) == exact
    assert float(learned.residual([3 * STEP_US // 2])[0].detach().abs().max()) > 1e-4
    other = correction(track, exact=not exact)
    other.load_state_dict(learned.state_dict())
    again = other.residual(keys)
    assert torch.equal(again[0], turns) and torch.equal(again[1], shifts)
    learned.forget()
    assert not learned.residual([3 * STEP_US // 2])[0].any() and bool(learned.exact) == exact


@pytest.mark.parametrize("exact", [True, False])
def test_one_key_has_no_motion_between_keys_and_a_price_that_is_a_number(exact):
    whole = dance(1)
    track = BodyTrack(whole.body, whole.times_us[:1], whole.poses[:1], whole.transl[:1])
    learned = correction(track, exact=exact)
    fill(learned, 3)
    turns, shifts = learned.residual([0, 30_000])
    assert learned.between is None
    assert bool(learned.price().isfinite()) and (learned.price() == 0) == exact
    assert bool(turns.any()) != exact and bool(shifts.any()) != exact


def test_prices_are_squares_per_unknown():
    """Control points that are all 2 make a spline that is 2, and nothing where its mean is out."""
    track = dance(0)
    learned = correction(track)
    with torch.no_grad():
        for spline in learned.errors.values():
            spline.rotations.fill_(2.0)
            spline.translations.fill_(2.0)
    expected = 4.0 * 1 / learned.errors["fast"].count
    assert float(learned.price().detach()) == pytest.approx(expected, rel=1e-4)
    still = correction(track, joint_rad=np.arange(len(track.body.parents)) % 2 * 0.1)
    with torch.no_grad():
        still.errors["constant"].rotations[:, ::2] = 5.0  # joints that are not expected to err
    assert float(still.price().detach()) == 0.0


def uneven(seed: int, keys: int = 40) -> BodyTrack:
    """Keys some of which lie close together, and a gap."""
    rng, body = np.random.default_rng(seed), default_body()
    times = np.cumsum(rng.integers(20_000, 120_000, keys))
    times[keys // 2 :] += 900_000
    poses = 0.3 * rng.normal(size=(keys, len(body.parents), 3))
    return BodyTrack(body, times, poses, rng.normal(size=(keys, 3)))


@pytest.mark.parametrize("seed", range(2))
def test_motion_between_keys_adds_to_errors_and_is_nothing_at_keys(seed):
    track = uneven(seed)
    both, alone = (correction(track, joint_rad=0.3, root_m=0.3) for _ in range(2))
    for each in (both, alone):
        fill(each, seed)
    with torch.no_grad():
        for value in alone.between.parameters():
            value.zero_()
    missed = spline_error(track)
    every = torch.tensor([*missed.rotation_rad, missed.translation_m])
    told = apart_from_errors(every, torch.full_like(every, SHARES["fast"] ** 0.5 * 0.3))
    keys, middles = track.times_us.tolist(), (track.times_us[:-1] + 9_000).tolist()
    count = len(keys)
    moved, placed = both.between.values(keys + middles)
    sizes = moved * told[:-1, None], placed * told[-1]
    pairs = zip(both.residual(keys + middles), alone.residual(keys + middles), sizes, strict=True)
    for one, errors, size in pairs:
        assert torch.allclose(one, errors + size, atol=1e-6)
        assert torch.allclose(one[:count], errors[:count], atol=1e-5)
        assert float(size[count:].detach().abs().max()) > 1e-4
    assert float(both.price().detach()) > float(alone.price().detach())


@pytest.mark.parametrize("track", [dance(0), uneven(1), uneven(2)], ids=["even", "1", "2"])
def test_banded_ridge_regression_is_the_dense_one(track):
    learned = correction(track, frames=slice(None, None, 3))
    times = track.times_us.tolist()
    parts = [(learned.errors[name], SHARES[name] ** 0.5) for name in SHARES]
    design = [factor * spline.weights(times).double().numpy() for spline, factor in parts]
    dense = np.concatenate(design, 1)
    goal = np.random.default_rng(0).normal(size=(len(times), 7))
    square = dense.T @ dense + 0.05**2 * np.eye(dense.shape[1])
    ridge = Ridge(parts, times, 0.05)
    found = ridge.solve(goal)
    # Control points' weights are of float32 in the dense matrix.
    assert np.allclose(found, np.linalg.solve(square, dense.T @ goal), rtol=0, atol=2e-5)
    assert np.allclose(ridge.values(found), dense @ found, atol=1e-6)


def test_smoothing_is_the_smallest_that_fits():
    """As the pseudo-inverse of the dense matrix has it."""
    track = dance(1)
    learned = correction(track, joint_rad=0.2)
    rng = np.random.default_rng(1)
    poses = track.poses + 0.05 * rng.normal(size=track.poses.shape)
    other = BodyTrack(track.body, track.times_us, poses, track.transl + 0.01)
    learned.smooth_to(track, other)
    turns, shifts = _apart(track, other)
    inverse = np.linalg.pinv(learned.smoothing.weights(track.times_us.tolist()).double().numpy())
    wanted = inverse @ turns.flatten(1).double().numpy()
    assert np.allclose(learned.smoothing.rotations.flatten(1), wanted, rtol=0, atol=1e-6)
    assert np.allclose(learned.smoothing.translations, inverse @ shifts.numpy(), rtol=0, atol=1e-6)


@pytest.mark.parametrize("seed", range(2))
def test_what_holds_throughout_and_what_drifts_reaches_held_out_times(seed):
    """Runs of three frames without pictures get most of errors that change slowly."""
    rng, track = np.random.default_rng(seed), dance(seed)
    unseen = np.arange(KEYS) % 8 > 4
    seconds = track.times_us * 1e-6
    shape = (1, *track.poses.shape[1:])
    wrong = 0.05 * rng.normal(size=shape) + 0.05 * np.sin(
        2 * np.pi * (0.4 * seconds[:, None, None] + rng.uniform(size=shape))
    )
    learned = correction(track, joint_rad=0.1, frames=~unseen)
    goal, zero = torch.from_numpy(wrong).float(), torch.zeros(KEYS, 3)
    learned.fit(track.times_us[~unseen].tolist(), goal[~unseen], zero[~unseen], misfit=0.05)
    found = learned.residual(track.times_us.tolist())[0].detach()

    def rms(value, times):
        return float(value[torch.from_numpy(times)].square().mean().sqrt())

    assert rms(found - goal, ~unseen) < 0.1 * rms(goal, ~unseen)
    assert rms(found - goal, unseen) < 0.5 * rms(goal, unseen)


def test_the_start_is_the_likeliest_of_given_residuals():
    """Ridge regression as numpy solves it, with the same unknowns and variances."""
    track = dance(3)
    learned = correction(track, joint_rad=0.2, root_m=0.05)
    rng = np.random.default_rng(3)
    times = track.times_us.tolist()
    turns = torch.from_numpy(rng.normal(size=track.poses.shape)).float()
    shifts = torch.from_numpy(rng.normal(size=(KEYS, 3))).float()
    learned.fit(times, turns, shifts, misfit=0.3)
    parts = {name: spline.weights(times).double() for name, spline in learned.errors.items()}
    design = torch.cat([SHARES[name] ** 0.5 * part for name, part in parts.items()], 1).numpy()
    covariance = design @ design.T
    gain = covariance @ np.linalg.inv(covariance + 0.09 * np.eye(KEYS))
    found = learned.residual(times)
    expected = np.einsum("st,tjc->sjc", gain, turns.double().numpy())
    assert np.allclose(found[0].detach(), expected, atol=1e-4)
    assert np.allclose(found[1].detach(), gain @ shifts.double().numpy(), atol=1e-4)


@pytest.mark.parametrize("seed", range(2))
def test_started_at_a_better_motion_it_counts_and_gives_that_motion(seed):
    rng, given = np.random.default_rng(seed), dance(seed)
    turns = Rotation.from_rotvec(rng.normal(scale=0.05, size=(given.poses.size // 3, 3)))
    poses = (Rotation.from_rotvec(given.poses.reshape(-1, 3)) * turns).as_rotvec()
    place = given.transl + rng.normal(scale=0.02, size=given.transl.shape)
    better = BodyTrack(given.body, given.times_us, poses.reshape(given.poses.shape), place)
    learned = correction(given, joint_rad=0.05, root_m=0.02)
    assert not bool(learned.started)
    learned.start_at(given, better, misfit=1e-3)
    times = given.times_us.tolist()
    (found, at), (expected, there) = given.at(times), better.at(times)
    corrected, shifts = (value.detach() for value in learned.residual(times))
    assert torch.allclose(found @ axis_angle_to_matrix(corrected), expected, atol=2e-3)
    assert torch.allclose(at + shifts, there, atol=1e-3)
    assert bool(learned.started)


@pytest.mark.parametrize("seed", range(2))
def test_what_is_smoothed_away_is_part_of_the_state_and_no_error(seed):
    """Smoothed keys come back at the keys, from a state as well; they are neither learned nor
    paid for, and another motion knows nothing of them."""
    rng, track = np.random.default_rng(seed), dance(seed)
    poses = track.poses + rng.normal(0, 0.02, track.poses.shape)
    transl = track.transl + rng.normal(0, 0.01, track.transl.shape)
    noisy = BodyTrack(track.body, track.times_us, poses, transl)
    learned = correction(noisy)
    learned.smooth_to(noisy, track)
    assert learned.price().detach() == 0
    assert not {id(value) for value in learned.parameters()} & {id(learned.smoothing.rotations)}
    again = correction(noisy)
    again.load_state_dict(learned.state_dict())
    times = track.times_us.tolist()
    for each in (learned, again):
        turns, shifts = each.residual(times)
        rotations, places = noisy.at(times)
        wanted, there = track.at(times)
        assert torch.allclose(rotations @ axis_angle_to_matrix(turns), wanted, atol=2e-4)
        assert torch.allclose(places + shifts, there, atol=2e-4)
    learned.forget()
    assert not any(value.any() for value in learned.residual(times))
