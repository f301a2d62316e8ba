"""Events counted on a device: what the compiled module counts on the host."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from evsplat.capture import load_capture
from evsplat.devices import DeviceCache
from evsplat.errors import HeldOutError
from evsplat.events import EventStream, polarity_counts, window_counts
from evsplat.events.on_device import DeviceEvents, EventBlocks, packed

HEIGHT, WIDTH = 5, 7


def random_stream(seed: int, count: int, signs: tuple[int, ...]) -> EventStream:
    rng = np.random.default_rng(seed)
    return EventStream(
        np.sort(rng.integers(0, 25_000, count)),
        rng.integers(0, WIDTH, count).astype(np.uint16),
        rng.integers(0, HEIGHT, count).astype(np.uint16),
        rng.choice(signs, count).astype(np.int8),
    )


@given(
    st.integers(0, 10_000),
    st.integers(0, 2_000),
    st.integers(2, 6),
    st.sampled_from([0, 300, 4_000, 100_000]),
    st.sampled_from([(1, -1), (0,)]),
)
def test_windows_on_a_device_are_those_of_the_host(seed, count, times, reach_us, signs):
    stream = random_stream(seed, count, signs)
    at = np.sort(np.random.default_rng(seed).integers(1_000, 24_000, times)).tolist()
    within = max(at[0] - reach_us - 500, 0), min(at[-1] + reach_us + 500, 25_000)
    events = DeviceEvents(packed(stream, -70, HEIGHT, WIDTH), -70, HEIGHT, WIDTH)
    expected = window_counts(stream.between(*within), at, HEIGHT, WIDTH, reach_us=reach_us)
    counts = events.window_counts(at, within, reach_us=reach_us)
    if reach_us == 0:
        assert torch.equal(counts, expected)
    else:  # shares are added up in another order
        assert (counts - expected).abs().max() < 1e-5
    spans = [(time - 500, time + 400) for time in at]
    expected = [polarity_counts(stream.between(*span), HEIGHT, WIDTH) for span in spans]
    assert torch.equal(events.counts_around(spans), torch.stack(expected))


@pytest.mark.parametrize("seed", range(5))
def test_blocks_hold_what_the_recording_holds_and_nothing_hidden(seed, tiny_capture):
    whole = load_capture(tiny_capture()).events
    start, end = whole.time_range_us
    middle = (start + end) // 2
    events = whole.restricted_to([(start, middle), (middle + 30_000, end)]).keeping(1 << 20)
    rng = np.random.default_rng(seed)
    blocks, data = EventBlocks(events), DeviceCache("cpu", 0)
    for low, high in ((start, middle), (middle + 30_000, end)):
        at = np.sort(rng.integers(low, high, 4)).tolist()
        found = blocks.between(data, at[0], at[-1])
        expected = window_counts(events.between(at[0], at[-1]), at, events.height, events.width)
        assert torch.equal(found.window_counts(at, (at[0], at[-1]), reach_us=0), expected)
    with pytest.raises(HeldOutError):
        blocks.between(data, middle + 10_000, middle + 20_000)
