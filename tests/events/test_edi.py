"""The event double integral against light whose integral is known in closed form."""

import numpy as np
import pytest
import torch

from evsplat.errors import DataError
from evsplat.events import EventStream
from evsplat.events.edi import deblur, log_gain
from evsplat.pictures import decode, encode

EXPOSURE = (10_000, 40_000)
LENGTH = EXPOSURE[1] - EXPOSURE[0]


def _stream(events: list[tuple[float, int, int, int]]) -> EventStream:
    """Events (t, x, y, p) in any order."""
    t, x, y, p = np.array(sorted(events) or np.zeros((0, 4))).T
    return EventStream(
        np.round(t).astype(np.int64), x.astype(np.uint16), y.astype(np.uint16), p.astype(np.int8)
    )


@pytest.mark.parametrize("seed", range(3))
def test_staircases_of_light_are_recovered_exactly(seed: int) -> None:
    """Each pixel's light jumps by C+ or C- at random times; B is summed interval by interval."""
    rng = np.random.default_rng(seed)
    up, down = rng.uniform(0.1, 0.5, 2)
    height, width = 3, 4
    events, blurry = [], np.zeros((height, width))
    times = [2_000, 10_000, 21_777, 40_000, 47_000]
    truth = np.zeros((len(times), height, width))
    for y in range(height):
        for x in range(width):
            jumps = sorted(rng.choice(50_000, rng.integers(0, 12), replace=False).tolist())
            signs = rng.choice([-1, 1], len(jumps)).tolist()
            events += [(t, x, y, p) for t, p in zip(jumps, signs, strict=True)]
            start = rng.uniform(0.1, 0.4)

            def light(t, start=start, jumps=jumps, signs=signs):
                return start * np.exp(
                    sum(up if p > 0 else -down for j, p in zip(jumps, signs, strict=True) if j < t)
                )

            edges = [EXPOSURE[0], *(j for j in jumps if EXPOSURE[0] < j < EXPOSURE[1]), EXPOSURE[1]]
            pieces = zip(edges, edges[1:], strict=False)
            blurry[y, x] = sum((b - a) * light((a + b) / 2) for a, b in pieces) / LENGTH
            # Events at the very instant have not happened yet, as in EventStream.between.
            truth[:, y, x] = [light(t) for t in times]
    gain = log_gain(_stream(events), EXPOSURE, times, (up, down), height, width)
    np.testing.assert_allclose(blurry * np.exp(gain), truth, rtol=1e-12)


@pytest.mark.parametrize(("rate", "contrast"), [(2.0, 0.02), (-1.5, 0.02), (2.0, 0.2)])
def test_an_exponential_ramp_is_recovered_within_a_threshold(rate: float, contrast: float) -> None:
    """Light exp(rate u) over the exposure u in [0, 1]; its mean is (exp(rate) - 1) / rate."""
    crossings = np.arange(1, int(abs(rate) / contrast) + 1) * contrast / abs(rate)
    sign = int(np.sign(rate))
    events = _stream([(EXPOSURE[0] + u * LENGTH, 0, 0, sign) for u in crossings])
    shares = np.array([0.0, 0.31, 0.5, 0.77, 1.0])
    times = [round(EXPOSURE[0] + u * LENGTH) for u in shares]
    gain = log_gain(events, EXPOSURE, times, (contrast, contrast), 1, 1)[:, 0, 0]
    truth = rate * shares - np.log((np.exp(rate) - 1) / rate)
    assert np.abs(gain - truth).max() <= contrast
    # The staircase is right on average: half of a threshold each way.
    assert abs((gain - truth).mean()) < 0.35 * contrast


def test_a_step_inside_the_exposure_gives_both_levels() -> None:
    step_at, contrast = 19_000, 0.25
    dark, bright = 0.1, 0.1 * np.exp(4 * contrast)
    share = (step_at - EXPOSURE[0]) / LENGTH
    linear = torch.full((1, 1, 3), share * dark + (1 - share) * bright)
    events = _stream([(step_at, 0, 0, 1)] * 4)
    before, after = deblur(encode(linear), events, EXPOSURE, [15_000, 30_000], (contrast, contrast))
    assert decode(before).numpy() == pytest.approx(dark, rel=1e-4)
    assert decode(after).numpy() == pytest.approx(bright, rel=1e-4)


@pytest.mark.parametrize("transfer", ["power", "srgb"])
def test_without_events_the_picture_stays(transfer) -> None:
    blurry = torch.rand(5, 6, 3, generator=torch.Generator().manual_seed(4))
    sharp = deblur(blurry, _stream([]), EXPOSURE, [20_000], (0.2, 0.2), transfer=transfer)
    assert sharp.shape == (1, 5, 6, 3)
    torch.testing.assert_close(sharp[0], blurry, atol=2e-6, rtol=0)


def test_all_channels_get_the_same_factor() -> None:
    blurry = torch.tensor([0.6, 0.3, 0.2]).view(1, 1, 3)
    sharp = deblur(blurry, _stream([(15_000, 0, 0, -1)]), EXPOSURE, [30_000], (0.2, 0.3))
    ratio = decode(sharp[0]) / decode(blurry)
    assert float(ratio.max() - ratio.min()) < 1e-5 and float(ratio.max()) < 1


@pytest.mark.parametrize("seed", range(3))
def test_a_moving_edge_becomes_sharp(seed: int) -> None:
    """A soft texture slides by 12 pixels; events are exact crossings of its log luminance."""
    rng = np.random.default_rng(seed)
    height, width, contrast, steps = 16, 64, 0.08, 240
    coarse = rng.uniform(-1.6, -0.2, (height, 16))
    columns = np.linspace(0, 15, 4 * width)
    texture = np.stack([np.interp(columns, np.arange(16), row) for row in coarse])

    def log_light(u: float) -> np.ndarray:
        position = np.arange(width) * 2.0 + 12.0 * u * 2.0
        return np.stack([np.interp(position, np.arange(4 * width), row) for row in texture])

    sequence = np.array([log_light(u) for u in (np.arange(steps) + 0.5) / steps])
    events, reference = [], sequence[0].copy()
    for k in range(1, steps):
        t = EXPOSURE[0] + LENGTH * k / steps
        for sign in (1, -1):
            for y, x in np.argwhere(sign * (sequence[k] - reference) >= contrast):
                events.append((t, x, y, sign))
                reference[y, x] += sign * contrast
    linear = np.exp(sequence).mean(0)
    blurry = encode(torch.from_numpy(np.repeat(linear[..., None], 3, -1)).float())
    truth = encode(torch.from_numpy(np.exp(log_light(0.5))).float())[..., None]
    sharp = deblur(blurry, _stream(events), EXPOSURE, [25_000], (contrast, contrast))[0]

    def psnr(picture: torch.Tensor) -> float:
        return float(-10 * torch.log10(((picture - truth) ** 2).mean()))

    assert psnr(sharp) > psnr(blurry) + 6


def test_bad_input_is_named() -> None:
    events = _stream([(15_000, 9, 0, 1)])
    with pytest.raises(DataError, match="x=9, y=0.*8x6"):
        log_gain(events, EXPOSURE, [20_000], (0.2, 0.2), 6, 8)
    with pytest.raises(DataError, match="from 5 to 5"):
        log_gain(_stream([]), (5, 5), [5], (0.2, 0.2), 6, 8)
