"""The spline of pose residuals: scipy's values, a fixed gauge, zero at keys where held there."""

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline, CubicSpline

from evsplat.models.pose_spline import PoseSpline

FRAMES = [40_000, 140_000, 320_000, 700_000, 910_000]
SPAN = 10_000, 990_000


def make(seed: int, knot_us: float = 93_000, **variant) -> tuple[PoseSpline, BSpline]:
    """A spline of four joints with random control points, and scipy's with the same (K, J, 3)."""
    rng = np.random.default_rng(seed)
    spline = PoseSpline(SPAN, knot_us, 4, **variant)
    points = rng.normal(size=(spline.count, 4, 3))
    with torch.no_grad():
        spline.rotations.copy_(torch.from_numpy(points))
        spline.translations.copy_(torch.from_numpy(points[:, 2]))
    knots = SPAN[0] + knot_us * np.arange(-3, spline.count + 1)
    return spline, BSpline(knots * 1e-6, points, 3)


def values(spline: PoseSpline, times: list[int]) -> tuple[np.ndarray, np.ndarray]:
    turns, shifts = spline.values(times)
    return turns.detach().double().numpy(), shifts.detach().double().numpy()


@pytest.mark.parametrize("seed", range(3))
def test_values_are_scipys(seed):
    spline, scipys = make(seed, knot_us=[40_000, 93_000, 5_000_000][seed])
    times = np.random.default_rng(seed).integers(10_000, 990_001, size=40)
    times[:2] = SPAN
    turns, shifts = values(spline, times.tolist())
    assert np.allclose(turns, scipys(times * 1e-6), atol=1e-5)
    assert np.allclose(shifts, turns[:, 2], atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_centred_its_mean_is_zero_and_a_constant_says_nothing(seed):
    spline, _ = make(seed, centred_us=FRAMES)
    turns, shifts = values(spline, FRAMES)
    assert np.abs(turns.mean(0)).max() < 1e-6
    assert np.abs(shifts.mean(0)).max() < 1e-6
    times = list(range(0, 1_000_000, 70_000))
    given, _ = values(spline, times)
    with torch.no_grad():
        spline.rotations += 3.0
    assert np.allclose(values(spline, times)[0], given, atol=1e-5)


@pytest.mark.parametrize("variant", [{}, {"centred_us": FRAMES}, {"held_us": FRAMES}])
def test_many_times_in_blocks_are_those_at_once(variant, monkeypatch):
    spline, _ = make(0, knot_us=15_000, **variant)
    times = np.random.default_rng(0).integers(-10_000, 1_000_000, size=60)
    upstream = torch.from_numpy(np.random.default_rng(1).normal(size=(60, 4, 3))).float()

    def found():
        turns, shifts = spline.values(times.tolist())
        gradient = torch.autograd.grad((turns * upstream).sum(), spline.rotations)[0]
        return turns.detach(), shifts.detach(), gradient

    at_once = found()
    monkeypatch.setattr("evsplat.models.pose_spline._BLOCK", 7)
    for blocks, expected in zip(found(), at_once, strict=True):
        torch.testing.assert_close(blocks, expected, rtol=1e-5, atol=1e-5)


def test_an_infinite_knot_is_a_constant():
    spline = PoseSpline(SPAN, float("inf"), 4)
    with torch.no_grad():
        spline.rotations.normal_()
        spline.translations.normal_()
    turns, shifts = values(spline, [-5, 10_000, 700_000, 2_000_000])
    assert spline.count == 1
    assert np.array_equal(turns, np.broadcast_to(turns[0], turns.shape))
    assert np.array_equal(shifts, np.broadcast_to(shifts[0], shifts.shape))


def test_its_ends_are_held():
    spline, _ = make(1)
    ends, _ = values(spline, [-50_000, 10_000, 990_000, 2_000_000])
    assert np.array_equal(ends[0], ends[1]) and np.array_equal(ends[2], ends[3])


@pytest.mark.parametrize("seed", range(3))
def test_held_at_keys_it_is_scipys_curve_less_the_cubic_through_its_keys(seed):
    rng = np.random.default_rng(seed)
    keys = np.sort(rng.choice(np.arange(10_000, 990_001, 1_000), 9, replace=False))
    keys[0], keys[-1] = SPAN
    spline, free = make(seed, knot_us=50_000, held_us=keys.tolist())
    through = CubicSpline(1e-6 * keys, free(1e-6 * keys))
    assert np.abs(values(spline, keys.tolist())[0]).max() < 1e-5
    times = rng.integers(10_000, 990_001, size=40)
    seconds = 1e-6 * times
    expected = free(seconds) - through(seconds)
    assert np.abs(expected).max() > 0.3
    assert np.allclose(values(spline, times.tolist())[0], expected, atol=1e-4)
    assert np.abs(values(spline, [-5_000, 2_000_000])[0]).max() < 1e-5


@pytest.mark.parametrize("seed", range(2))
def test_between_many_keys_it_is_the_spline_through_all_of_them(seed):
    """Pieces that know near keys alone against the cubic spline through a thousand keys."""
    rng = np.random.default_rng(seed)
    keys = np.cumsum(rng.integers(15_000, 60_000, 1_000))
    spline = PoseSpline((int(keys[0]), int(keys[-1])), 20_000.0, 1, held_us=keys.tolist())
    plain = PoseSpline((int(keys[0]), int(keys[-1])), 20_000.0, 1)
    values = rng.normal(size=spline.count)
    times = np.sort(rng.integers(keys[0], keys[-1], 400))
    own = CubicSpline(keys * 1e-6, plain.weights(keys.tolist()).double().numpy() @ values)
    expected = plain.weights(times.tolist()).double().numpy() @ values - own(times * 1e-6)
    found = spline.weights(times.tolist()).double().numpy() @ values
    assert np.abs(found - expected).max() < 1e-4
    assert np.abs(spline.weights(keys.tolist()).double().numpy() @ values).max() < 1e-4
    # Bytes in proportion to the keys, where all weights of all pieces would be a million.
    assert spline.slopes.numel() < 1_000 * 250


def test_in_parts_it_is_the_same_and_only_those_near_have_a_gradient(monkeypatch):
    rng = np.random.default_rng(0)
    keys = np.cumsum(rng.integers(30_000, 60_000, 300))
    span = int(keys[0]), int(keys[-1])
    whole = PoseSpline(span, 22_000.0, 4, held_us=keys.tolist())
    monkeypatch.setattr("evsplat.models.pose_spline._DENSE", 50)
    monkeypatch.setattr("evsplat.models.pose_spline._APART", 64)
    parts = PoseSpline(span, 22_000.0, 4, held_us=keys.tolist())
    times = (keys[150] + rng.integers(0, 40_000, 9)).tolist()
    assert parts.still_zero(times) and not whole.still_zero(times)
    with torch.no_grad():
        for mine, theirs in zip(parts.whole(), whole.whole(), strict=True):
            theirs.normal_()
            assert mine.shape == theirs.shape
        for mine, theirs in (
            (parts.rotations, whole.rotations),
            (parts.translations, whole.translations),
        ):
            for part, values in zip(mine, theirs.split(64), strict=True):
                part.copy_(values)
    assert not parts.still_zero(times)
    turns, shifts = parts.values(times)
    expected_turns, expected_shifts = whole.values(times)
    torch.testing.assert_close(turns, expected_turns, rtol=0, atol=1e-6)
    torch.testing.assert_close(shifts, expected_shifts, rtol=0, atol=1e-6)
    upstream = torch.from_numpy(rng.normal(size=turns.shape)).float()
    (turns * upstream).sum().backward()
    (expected_turns * upstream).sum().backward()
    met = [part.grad is not None for part in parts.rotations]
    assert 0 < sum(met) <= 3 < len(met)
    found = [torch.zeros_like(p) if p.grad is None else p.grad for p in parts.rotations]
    torch.testing.assert_close(torch.cat(found), whole.rotations.grad, rtol=0, atol=1e-6)
