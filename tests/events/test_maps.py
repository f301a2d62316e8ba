"""Voxel grids, time surfaces and counts against eventcv and their own sums."""

import itertools

import eventcv
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from evsplat.errors import DataError
from evsplat.events import (
    EventStream,
    begun_counts,
    count_map,
    polarity_counts,
    time_surface,
    voxel_grid,
    window_counts,
)
from evsplat.events import maps as maps_module

WIDTH, HEIGHT = 19, 13
EVENTCV_VOXEL_US = 30_000
"""The window of eventcv's voxel grid ends with the last event and is this long."""


def random_stream(seed: int, count: int, last_us: int = 25_000) -> EventStream:
    rng = np.random.default_rng(seed)
    return EventStream(
        np.sort(rng.integers(0, last_us, count)).astype(np.int64),
        rng.integers(0, WIDTH, count).astype(np.uint16),
        rng.integers(0, HEIGHT, count).astype(np.uint16),
        rng.choice(np.array([-1, 1], dtype=np.int8), count),
    )


def in_eventcv(stream: EventStream) -> "eventcv.EventStream":
    rows = np.stack([stream.x, stream.y, stream.t, stream.p > 0], axis=1).astype(np.int64)
    return eventcv.from_numpy(rows, sensor_size=(WIDTH, HEIGHT), time_unit="us")


@given(st.integers(0, 10_000), st.integers(1, 400), st.integers(2, 9))
def test_voxel_grid_is_that_of_eventcv(seed: int, count: int, bins: int) -> None:
    stream = random_stream(seed, count)
    expected = in_eventcv(stream).voxel(bins=bins).numpy()
    last = int(stream.t[-1])
    grid = voxel_grid(stream, HEIGHT, WIDTH, bins, window_us=(last - EVENTCV_VOXEL_US, last))
    assert grid.shape == (bins, HEIGHT, WIDTH) and grid.dtype == torch.float32
    assert np.allclose(grid.numpy(), expected, atol=2e-5)


@given(st.integers(0, 10_000), st.integers(1, 400), st.floats(0.2, 50.0))
def test_time_surface_is_that_of_eventcv(seed: int, count: int, decay_ms: float) -> None:
    stream = random_stream(seed, count)
    expected = in_eventcv(stream).tsurf(tau_ms=decay_ms).numpy()
    surface = time_surface(stream, HEIGHT, WIDTH, decay_us=1000 * decay_ms)
    assert np.allclose(surface.numpy(), expected, atol=1e-6)


@given(st.integers(0, 10_000), st.integers(0, 400))
def test_counts_of_the_polarities_are_those_of_eventcv(seed: int, count: int) -> None:
    stream = random_stream(seed, count)
    on, off = polarity_counts(stream, HEIGHT, WIDTH)
    assert torch.equal(on - off, count_map(stream, HEIGHT, WIDTH))
    if count:
        assert np.array_equal((on + off).numpy(), in_eventcv(stream).count().numpy().squeeze())


@given(st.integers(0, 10_000), st.integers(0, 300), st.integers(1, 7), st.integers(0, 20_000))
def test_bins_add_up_to_the_counts_of_the_window(seed: int, count: int, bins: int, start: int):
    stream = random_stream(seed, count)
    grid = voxel_grid(stream, HEIGHT, WIDTH, bins, window_us=(start, start + 4_000))
    inside = stream.between(start, start + 4_001)
    assert torch.allclose(grid.sum(0), count_map(inside, HEIGHT, WIDTH), atol=1e-5)


def test_an_event_between_two_instants_is_shared_by_its_distance() -> None:
    stream = EventStream(*(np.array([v]) for v in (1_300, 4, 2, -1)))
    grid = voxel_grid(stream, HEIGHT, WIDTH, 5, window_us=(1_000, 2_000))
    # instants at 1000, 1250, 1500, 1750, 2000: a fifth of the way from the second to the third
    assert grid[:, 2, 4].tolist() == pytest.approx([0, -0.8, -0.2, 0, 0])
    assert grid.abs().sum() == pytest.approx(1)


def test_grid_without_window_reaches_from_first_to_last_event() -> None:
    stream = random_stream(3, 200)
    whole = (int(stream.t[0]), int(stream.t[-1]))
    expected = voxel_grid(stream, HEIGHT, WIDTH, 6, window_us=whole)
    assert torch.equal(voxel_grid(stream, HEIGHT, WIDTH, 6), expected)


def test_scaled_grid_has_unit_variance_where_it_is_not_empty() -> None:
    stream = random_stream(5, 150)
    plain = voxel_grid(stream, HEIGHT, WIDTH, 5)
    scaled = voxel_grid(stream, HEIGHT, WIDTH, 5, scaling="standard")
    filled = plain != 0
    assert filled.any() and (~filled).any() and (scaled[~filled] == 0).all()
    assert scaled[filled].mean() == pytest.approx(0, abs=1e-6)
    assert scaled[filled].std(correction=0) == pytest.approx(1, abs=1e-6)
    # a straight line of the plain values
    line = np.polyfit(plain[filled].numpy(), scaled[filled].numpy(), 1, full=True)
    assert line[0][0] > 0 and line[1] == pytest.approx(0, abs=1e-8)


def test_surface_at_an_earlier_time_ignores_what_comes_later() -> None:
    stream = random_stream(7, 300)
    now = int(stream.t[120])
    early = time_surface(stream, HEIGHT, WIDTH, decay_us=4_000, time_us=now)
    cut = time_surface(stream.between(0, now + 1), HEIGHT, WIDTH, decay_us=4_000, time_us=now)
    assert torch.equal(early, cut) and early.max() == 1


def crossings(level: np.ndarray, times: np.ndarray) -> EventStream:
    """Events of pixels (times, H, W) whose level, in thresholds, starts at a whole number."""
    events, reported = [], level[0].round()
    for now, at in zip(times[1:], level[1:], strict=True):
        for sign in (1, -1):
            y, x = np.nonzero(sign * (at - reported) >= 1)
            reported[y, x] += sign
            events += [(now, x_, y_, sign) for x_, y_ in zip(x, y, strict=True)]
    t, x, y, p = np.array(events).T
    return EventStream(t, x.astype(np.uint16), y.astype(np.uint16), p.astype(np.int8))


@given(st.integers(0, 10_000))
def test_counts_with_what_has_begun_follow_a_steady_change_exactly(seed: int) -> None:
    rng = np.random.default_rng(seed)
    times = np.arange(0, 20_001, 25)
    slopes = rng.uniform(-6, 6, (HEIGHT, WIDTH)) / 20_000
    level = slopes * times[:, None, None]
    stream = crossings(level, times)
    now = int(rng.integers(6_000, 14_000))
    on, off = (
        begun_counts(stream, [now], HEIGHT, WIDTH, reach_us=20_000)[0]
        + polarity_counts(stream.between(0, now), HEIGHT, WIDTH)
    ).numpy()
    known = (np.abs(slopes * now) > 1.02) & (np.abs(slopes * (20_000 - now)) > 1.02)
    # events come up to 25 us after the crossing
    late = np.abs(slopes) * 50
    assert (np.abs(on - off - slopes * now) <= late + 1e-5)[known].all()
    assert (np.minimum(on, off) == 0).all()  # each slope has one polarity


@pytest.mark.parametrize("seed", range(3))
def test_what_has_begun_brings_counts_nearer_to_a_changing_brightness(seed: int) -> None:
    rng = np.random.default_rng(seed)
    times = np.arange(0, 100_001, 50)
    waves = 2 * np.pi * rng.uniform(10, 40, (3, HEIGHT, WIDTH)) * 1e-6
    sizes, phases = rng.uniform(0.5, 3, waves.shape), rng.uniform(0, 2 * np.pi, waves.shape)
    level = sum(
        size * (np.sin(wave * times[:, None, None] + phase) - np.sin(phase))
        for wave, size, phase in zip(waves, sizes, phases, strict=True)
    )
    stream = crossings(level, times)
    held, even = [], []
    for index in range(200, 1_801, 100):
        now = int(times[index])
        counts = polarity_counts(stream.between(0, now), HEIGHT, WIDTH)
        begun = begun_counts(stream, [now], HEIGHT, WIDTH, reach_us=50_000)[0]
        for errors, (on, off) in ((held, counts), (even, counts + begun)):
            errors.append(np.abs((on - off).numpy() - level[index]).mean())
    assert np.mean(even) < 0.8 * np.mean(held)


@given(st.integers(0, 10_000), st.integers(0, 2_000), st.integers(1, 5), st.integers(100, 9_000))
def test_what_has_begun_is_that_of_each_pixel_alone(
    seed: int, count: int, times: int, reach_us: int
) -> None:
    stream = random_stream(seed, count)
    at = np.sort(np.random.default_rng(seed).integers(0, 25_000, times)).tolist()
    expected = np.zeros((times, 2, HEIGHT, WIDTH))
    for x, y in {(int(x), int(y)) for x, y in zip(stream.x, stream.y, strict=True)}:
        here = np.flatnonzero((stream.x == x) & (stream.y == y))
        for (a, b), (row, now) in itertools.product(itertools.pairwise(here), enumerate(at)):
            gap = stream.t[b] - stream.t[a]
            if stream.p[a] == stream.p[b] and stream.t[a] < now <= stream.t[b] and gap <= reach_us:
                channel = 0 if stream.p[a] > 0 else 1
                expected[row, channel, y, x] = (now - stream.t[a]) / gap
    begun = begun_counts(stream, at, HEIGHT, WIDTH, reach_us=reach_us)
    assert np.allclose(begun.numpy(), expected, atol=1e-6)


@given(st.integers(0, 10_000), st.integers(0, 2_000), st.integers(2, 5), st.integers(-9, 9_000))
def test_counts_of_windows_are_those_of_each_and_what_has_begun(
    seed: int, count: int, times: int, reach_us: int
) -> None:
    stream = random_stream(seed, count)
    at = np.sort(np.random.default_rng(seed).integers(0, 25_000, times)).tolist()
    maps = [
        polarity_counts(stream.between(*ends), HEIGHT, WIDTH) for ends in itertools.pairwise(at)
    ]
    expected = torch.stack(maps)
    if reach_us > 0:
        begun = begun_counts(stream, at, HEIGHT, WIDTH, reach_us=reach_us)
        expected = expected + begun[1:] - begun[:-1]
    counts = window_counts(stream, at, HEIGHT, WIDTH, reach_us=reach_us)
    assert (counts - expected).abs().max() < 1e-5
    with pytest.MonkeyPatch.context() as without:
        without.setattr(maps_module, "native", None)
        plain = window_counts(stream, at, HEIGHT, WIDTH, reach_us=reach_us)
    assert (plain - expected).abs().max() < 1e-5


def test_nothing_has_begun_between_opposite_or_distant_events() -> None:
    t = np.array([0, 0, 0, 1_000, 5_000, 2_000, 9_000])
    x = np.array([0, 1, 2, 0, 1, 2, 3], dtype=np.uint16)
    p = np.array([1, 1, -1, -1, 1, -1, 1], dtype=np.int8)
    order = np.argsort(t, kind="stable")
    stream = EventStream(t[order], x[order], np.zeros(7, np.uint16), p[order])
    now, late = begun_counts(stream, [500, 2_000], 1, 4, reach_us=4_000)
    assert now.tolist() == [[[0, 0, 0, 0]], [[0, 0, 0.25, 0]]]
    # an event at the instant itself has fully come about
    assert late.tolist() == [[[0, 0, 0, 0]], [[0, 0, 1, 0]]]
    (farther,) = begun_counts(stream, [500], 1, 4, reach_us=5_000)
    assert farther[0, 0].tolist() == pytest.approx([0, 0.1, 0, 0])


def test_no_events_make_empty_maps() -> None:
    nothing = random_stream(0, 0)
    assert voxel_grid(nothing, HEIGHT, WIDTH, 5, scaling="standard").abs().sum() == 0
    assert time_surface(nothing, HEIGHT, WIDTH, decay_us=10).abs().sum() == 0
    assert polarity_counts(nothing, HEIGHT, WIDTH).sum() == 0
    assert begun_counts(nothing, [5, 9], HEIGHT, WIDTH, reach_us=10).sum() == 0


def test_what_makes_no_sense_is_refused() -> None:
    stream = random_stream(1, 20)
    with pytest.raises(ValueError, match="at least one bin"):
        voxel_grid(stream, HEIGHT, WIDTH, 0)
    with pytest.raises(ValueError, match="ends before it starts"):
        voxel_grid(stream, HEIGHT, WIDTH, 3, window_us=(5, 4))
    with pytest.raises(ValueError, match="above 0 us"):
        time_surface(stream, HEIGHT, WIDTH, decay_us=0)
    for make in (polarity_counts, lambda s, h, w: voxel_grid(s, h, w, 3)):
        with pytest.raises(DataError, match=f"outside of a map of 4x{HEIGHT}"):
            make(stream, HEIGHT, 4)
