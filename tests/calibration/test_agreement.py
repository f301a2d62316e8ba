"""Events that lie or count otherwise than the frames are told, and those that fit are not."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evsplat.calibration import (
    Disagreement,
    FramePair,
    Lost,
    answered_share,
    estimate_disagreement,
    find_lost,
    pauses,
    unrecorded_spans,
    untold_spans,
)
from evsplat.events import ALWAYS, EventStore, EventStream, Span, moved, write_events

from ..conftest import write_event_file
from .synthetic import HEIGHT, WIDTH, Recording, record


def _taken_back(
    found: Disagreement, events: EventStream, given: EventStream, width: int, height: int
) -> None:
    """Every event is back at its pixel by the homography that was found."""
    back = EventStream.joined(list(moved([events], found.homography, width, height)))
    assert np.array_equal(back.x, given.x) and np.array_equal(back.y, given.y)


def _changed(events: EventStream, **columns: np.ndarray) -> EventStream:
    return replace(events, **columns)


@pytest.mark.parametrize(
    ("turned", "flip_x", "flip_y"),
    [
        ("", False, False),
        ("mirrored left to right", True, False),
        ("mirrored top to bottom", False, True),
        ("turned by 180 degrees", True, True),
    ],
)
@pytest.mark.parametrize("inverted", [False, True])
def test_what_events_went_through_is_found(rng, turned, flip_x, flip_y, inverted) -> None:
    seed = int(rng.integers(10_000))
    recording = record(seed, plus=0.2, minus=0.25, lag_us=6_000, noise_hz=0.5)
    given = recording.events
    events = _changed(
        given,
        x=(WIDTH - 1 - given.x).astype(np.uint16) if flip_x else given.x,
        y=(HEIGHT - 1 - given.y).astype(np.uint16) if flip_y else given.y,
        p=-given.p if inverted else given.p,
    )
    found = estimate_disagreement(recording.pairs, events)
    if not (turned or inverted):
        assert found is None
        return
    assert found is not None and (found.turned, found.inverted) == (turned, inverted)
    assert found.correlation > max(0.8, found.as_given)
    assert ("other polarity" in str(found)) == inverted and turned in str(found)
    _taken_back(found, events, given, WIDTH, HEIGHT)


@pytest.mark.parametrize(
    ("turned", "quarters", "mirrored"),
    [
        ("turned by 90 degrees to the right", 1, False),
        ("turned by 90 degrees to the left", 3, False),
        ("mirrored with x and y exchanged", 1, True),
        ("turned by 180 degrees with x and y exchanged", 3, True),
    ],
)
def test_quarter_turns_are_told_of_square_pictures_by_what_takes_them_back(
    rng: np.random.Generator, turned, quarters, mirrored
) -> None:
    """NumPy says which way: each event's pixel is followed through ``rot90`` by its number."""
    recording = record(int(rng.integers(10_000)), plus=0.2, minus=0.2)
    side = HEIGHT
    pairs = [
        replace(pair, change=pair.change[:, :side], usable=pair.usable[:, :side])
        for pair in recording.pairs
    ]
    inside = recording.events.take(recording.events.x < side)
    numbers = np.rot90(np.arange(side * side).reshape(side, side), quarters)
    numbers = numbers[::-1] if mirrored else numbers
    goes_to = np.argsort(numbers.ravel())[inside.y.astype(int) * side + inside.x]
    events = _changed(
        inside, x=(goes_to % side).astype(np.uint16), y=(goes_to // side).astype(np.uint16)
    )
    found = estimate_disagreement(pairs, events)
    assert found is not None and (found.turned, found.inverted) == (turned, False)
    _taken_back(found, events, inside, side, side)
    assert estimate_disagreement(pairs, inside) is None


def test_events_of_another_scene_or_none_fit_in_no_way() -> None:
    ours, others = record(0, plus=0.2, minus=0.2), record(1, plus=0.2, minus=0.2)
    assert estimate_disagreement(ours.pairs, others.events) is None
    assert estimate_disagreement(ours.pairs, ours.events.take(slice(0, 0))) is None
    assert estimate_disagreement([], ours.events) is None


def _without(recording: Recording, start_us: int, end_us: int) -> EventStream:
    t = recording.events.t
    return recording.events.take((t < start_us) | (t >= end_us))


def test_a_gap_in_the_events_is_found_where_it_is(rng: np.random.Generator) -> None:
    seed = int(rng.integers(10_000))
    recording = record(seed, plus=0.2, minus=0.2)
    assert find_lost(recording.pairs, recording.events) == Lost()
    # frames are 40 ms apart: those of 200.5 to 280.5 and 280.5 to 320.5 ms saw no event
    found = find_lost(recording.pairs, _without(recording, 200_000, 325_000))
    assert found == Lost(((200_500, 320_500),))


def test_of_lost_events_all_the_silence_tells_nothing_across_held_out_intervals_too(
    rng: np.random.Generator,
    tmp_path: Path,
) -> None:
    recording = record(int(rng.integers(10_000)), plus=0.2, minus=0.2)
    start, end = int(rng.integers(130_000, 200_000)), int(rng.integers(430_000, 500_000))
    rest, readable = _without(recording, start, end), [(ALWAYS[0], 220_000), (300_000, ALWAYS[1])]
    events = _stored(rest, tmp_path / "gap.h5", readable)
    before, after = int(rest.t[rest.t < start][-1]) + 1, int(rest.t[rest.t >= end][0])
    pairs = [
        replace(pair, recorded_us=span)
        for span in readable
        for pair in recording.pairs
        if span[0] <= pair.span_us[0] and pair.span_us[1] <= span[1]
    ]
    assert untold_spans(find_lost(pairs, events), events) == [(before, after)]
    whole = _stored(recording.events, tmp_path / "whole.h5", readable)
    assert untold_spans(find_lost(pairs, whole), whole) == []


def _stored(events: EventStream, path: Path, readable_us: list[Span]) -> EventStore:
    write_event_file(path, events.t, events.x, events.y, events.p > 0)
    return EventStore(path, WIDTH, HEIGHT, readable_us=readable_us)


@pytest.mark.parametrize("noise", [0, 40])
def test_a_pause_is_seen_among_more_frames_than_anybody_reads(
    rng: np.random.Generator, tmp_path: Path, noise: int
) -> None:
    """Of a stall the frames about it; of rest, which comes slowly, some, however often it comes."""
    count, period = 6_000, 40_000
    spans = [(k * period, k * period + 10_000) for k in range(count)]
    # Somebody who rests for some frames time and again.
    usual = 200 * np.clip(1.5 * np.sin(np.arange(count) / rng.uniform(14, 18)), 0, 1)
    begins = int(rng.integers(1_000, 5_000))
    while usual[begins - 5 : begins + 15].min() < 180:
        begins += 1
    # Far enough within exposures that these see events, and no frame between them does.
    within_us = rng.integers(4_000, 6_000, 2).tolist()
    last = begins + int(rng.integers(3, 9))
    start, end = begins * period + within_us[0], last * period + within_us[1]
    frame = np.repeat(np.arange(count), rng.poisson(usual + noise))
    t = np.sort(frame * period + rng.integers(0, period, len(frame)))
    t = t[(t < start) | (t >= end)]
    events = EventStream(
        t, *(rng.integers(0, side, len(t)).astype(np.uint16) for side in (WIDTH, HEIGHT)),
        rng.choice(np.array([-1, 1], np.int8), len(t)),
    )  # fmt: skip
    events = replace(events, y=np.minimum(events.y, HEIGHT - 1))
    write_events(tmp_path / "long.h5", events)
    store = EventStore(tmp_path / "long.h5", WIDTH, HEIGHT)
    found = pauses(spans, [ALWAYS] * count, store)
    silent = [k for k in range(count) if start <= spans[k][0] and spans[k][1] <= end]
    within = [pair for pair in found if pair[0] <= silent[-1] and pair[1] >= silent[0]]
    assert [within[0][0], within[-1][1]] == [silent[0], silent[-1]]
    assert len(found) <= 60 and (len(found) == len(within)) == bool(noise)


def test_no_gap_is_told_where_nothing_moves_or_nothing_was_recorded() -> None:
    recording = record(3, plus=0.2, minus=0.2)
    still = [replace(pair, change=np.zeros_like(pair.change)) for pair in recording.pairs]
    assert find_lost(still, recording.events.take(slice(0, 0))) == Lost()
    late = [replace(pair, recorded_us=(400_000, 900_000)) for pair in recording.pairs]
    assert find_lost(late, _without(recording, 0, 400_000)) == Lost()


@pytest.mark.parametrize("backwards", [False, True], ids=["early", "late"])
@pytest.mark.parametrize("draw", range(2))
def test_a_recorder_that_ends_early_or_begins_late_is_told_from_who_stands_still(
    rng: np.random.Generator, tmp_path: Path, draw: int, backwards: bool
) -> None:
    """Late is early with time running backwards: events change sign, pairs their frames."""
    seed, frames, exposure_us = rng.integers(10_000), 20, int(rng.integers(500, 35_000))
    plus, minus = rng.uniform(0.1, 0.35, 2)
    end = frames * 40_000

    def found(recording: Recording, name: str) -> tuple[list[Span], list[FramePair], EventStore]:
        pairs, events = recording.pairs, recording.events
        if backwards:
            pairs = [_backwards(pair, end) for pair in pairs[::-1]]
            t, p = end - events.t[::-1], -events.p[::-1]
            events = EventStream(t, events.x[::-1], events.y[::-1], p)
        store = _stored(events, tmp_path / f"{name}.h5", [ALWAYS])
        return unrecorded_spans(pairs, store), pairs, store

    def recorded(moving_frames: int) -> Recording:
        return record(
            seed, plus=plus, minus=minus, exposure_us=exposure_us, frames=frames,
            moving_frames=moving_frames, frame_noise=rng.choice([0.0, 0.01]),
        )  # fmt: skip

    for still in range(4):
        assert found(recorded(frames - still), f"still{still}")[0] == []
    whole = recorded(frames)
    last_mid = sum(whole.pairs[-1].after_us) // 2
    short = _without(whole, last_mid - int(rng.uniform(1, 2) * 40_000), end)
    spans, pairs, store = found(Recording(whole.pairs, short), "short")
    first, last = store.time_range_us
    expected = sum(pairs[0].before_us) // 2 - 1, first
    if not backwards:
        expected = last, sum(pairs[-1].after_us) // 2 + 1
    assert spans == [expected]


def _backwards(pair: FramePair, end_us: int) -> FramePair:
    before, after = ((end_us - b, end_us - a) for a, b in (pair.after_us, pair.before_us))
    return FramePair(before, after, -pair.change, pair.usable, ALWAYS)


def test_events_that_lie_in_other_pixels_are_told_from_lost_ones(rng: np.random.Generator) -> None:
    seed = int(rng.integers(10_000))
    recording = record(seed, plus=0.2, minus=0.2, still_rows=HEIGHT // 2, noise_hz=1.0)
    assert not find_lost(recording.pairs, recording.events).elsewhere
    # Where nothing moves in the pictures.
    moved = _changed(recording.events, y=(HEIGHT - 1 - recording.events.y).astype(np.uint16))
    found = find_lost(recording.pairs, moved)
    assert found.spans_us and found.elsewhere
    silent = _without(recording, 200_000, 325_000)
    found = find_lost(recording.pairs, silent)
    assert found.spans_us and not found.elsewhere
    few = recording.events.take(np.random.default_rng(seed).random(len(recording.events)) < 0.01)
    found = find_lost(recording.pairs, few)
    assert found.spans_us and not found.elsewhere


@pytest.mark.parametrize("lag_us", [0, 15_000])
def test_pixels_that_change_very_much_have_events_unless_the_sensor_is_coarser(rng, lag_us) -> None:
    """As of a sensor with a third of the pixels' columns and rows, warped to the frames.

    How many of the few pixels that change so much lie on them varies by 0.03 from one recording to
    the next: in the mean of six by 0.012.
    """
    off = []
    for seed in rng.integers(10_000, size=6):
        recording = record(int(seed), plus=0.35, minus=0.4, lag_us=lag_us, noise_hz=1.0)
        share = answered_share(recording.pairs, recording.events)
        assert share is not None and share > 0.85
        x, y = recording.events.x, recording.events.y
        coarse = recording.events.take((x % 3 == 1) & (y % 3 == 1))
        answered = answered_share(recording.pairs, coarse)
        assert answered is not None
        off.append(answered - share / 9)
    assert np.mean(off) == pytest.approx(0, abs=0.06)
    still = [replace(pair, change=np.zeros_like(pair.change)) for pair in recording.pairs]
    assert answered_share(still, recording.events) is None
