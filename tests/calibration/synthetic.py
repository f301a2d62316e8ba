"""Recordings with known clock lag and thresholds: each pixel's log luminance is a sine in time."""

from dataclasses import dataclass

import numpy as np
import torch

from evsplat.calibration import FramePair, exposure, pair, pair_indices
from evsplat.events import EventStream

HEIGHT, WIDTH = 24, 32
STEP_US = 500


@dataclass(frozen=True)
class Recording:
    pairs: list[FramePair]
    events: EventStream


def record(
    seed: int,
    *,
    plus: float,
    minus: float,
    lag_us: int = 0,
    exposure_us: int = 1_000,
    period_us: int = 40_000,
    frames: int = 20,
    frame_noise: float = 0.0,
    noise_hz: float = 0.0,
    start_us: int = 0,
    still_rows: int = 0,
    moving_frames: int | None = None,
) -> Recording:
    """Ideal pixels with random first reference levels; stamps are ``lag_us`` late.

    Nothing changes in the last ``still_rows`` rows, nor after the first ``moving_frames`` frames.
    """
    rng = np.random.default_rng(seed)
    mean = rng.uniform(-2.0, -1.2, (HEIGHT, WIDTH))
    amplitude = rng.uniform(0.5, 1.1, (HEIGHT, WIDTH))
    amplitude[HEIGHT - still_rows :] = 0
    hertz = rng.uniform(4.0, 9.0, (HEIGHT, WIDTH))
    phase = rng.uniform(0, 2 * np.pi, (HEIGHT, WIDTH))
    end_us = start_us + frames * period_us
    still_us = start_us + (frames if moving_frames is None else moving_frames) * period_us

    def level(time_us: float) -> np.ndarray:
        time_us = min(time_us, still_us)
        return mean + amplitude * np.sin(2 * np.pi * hertz * time_us * 1e-6 + phase)

    reference = level(start_us) + rng.uniform(-minus, plus, (HEIGHT, WIDTH))
    events = []
    for time in range(start_us, end_us, STEP_US):
        now = level(time)
        for sign, size in ((1, plus), (-1, minus)):
            while (passed := sign * (now - reference) >= size).any():
                y, x = np.nonzero(passed)
                events.append((np.full(len(x), time + lag_us), x, y, np.full(len(x), sign)))
                reference[passed] += sign * size
    noise = []
    for _ in range(rng.poisson(noise_hz * HEIGHT * WIDTH * (end_us - start_us) * 1e-6)):
        x, y = rng.integers(0, WIDTH), rng.integers(0, HEIGHT)
        noise.append((rng.integers(start_us, end_us), x, y, (-1, 1)[rng.integers(0, 2)]))
    events.append(np.array(noise, dtype=int).reshape(-1, 4).T)
    columns = [np.concatenate(column) for column in zip(*events, strict=True)]
    order = np.lexsort(columns[::-1])
    t, x, y, p = (column[order] for column in columns)
    spans = [
        (start_us + k * period_us, start_us + k * period_us + exposure_us) for k in range(frames)
    ]
    pictures = []
    for start, end in spans:
        linear = np.mean([np.exp(level(u)) for u in np.linspace(start, end, 21)], axis=0)
        coded = linear ** (1 / 2.2) + frame_noise * rng.standard_normal(linear.shape)
        pictures.append(exposure(torch.from_numpy(coded), (start, end)))
    stream = EventStream(t, x.astype(np.uint16), y.astype(np.uint16), p.astype(np.int8))
    recorded = int(t[0]), int(t[-1]) + 1
    pairs = [pair(pictures[i], pictures[j], recorded) for i, j in pair_indices(spans, 60)]
    return Recording(pairs, stream)
