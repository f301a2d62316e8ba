"""A plain float64 sensor to compare with, and pictures to show to both."""

from collections.abc import Iterator

import numpy as np

from evsplat.events import EventStream, SensorSettings, SensorSimulator


def response(linear: np.ndarray, settings: SensorSettings) -> np.ndarray:
    """Log-intensity of linear light in [0, 1]."""
    if settings.response == "log":
        return np.log(linear + settings.log_eps)
    scaled = 255 * linear
    return np.where(scaled <= 20, scaled * np.log(20) / 20, np.log(np.maximum(scaled, 1)))


def reference_events(
    frames: list[np.ndarray],
    times_us: list[int],
    settings: SensorSettings,
    on: np.ndarray,
    off: np.ndarray,
) -> tuple[dict[tuple[int, int], list[tuple[float, int, float]]], np.ndarray]:
    """Noise-free events of each pixel (y, x): time in us, polarity, time that 2e-6 take to cross.

    Float32 logarithms are wrong by up to that much. Written from the equations of
    docs/simulator.md, one pixel after the other. The second result marks pixels that come within
    1e-5 of a threshold at the end of a step: there rounding decides on which side of the picture
    the event falls.
    """
    linear = np.asarray(frames, dtype=np.float64)
    seen = response(linear, settings)
    signal = seen.copy()
    for k in range(1, len(frames)):
        if settings.cutoff_hz > 0:
            light = (255 * linear[k].clip(0, 1) + 20) / 275
            a = 2 * np.pi * settings.cutoff_hz * light * (times_us[k] - times_us[k - 1]) * 1e-6
            slope = (seen[k] - seen[k - 1]) / a
            signal[k] = seen[k] - slope + (signal[k - 1] - seen[k - 1] + slope) * np.exp(-a)
    events: dict[tuple[int, int], list[tuple[float, int, float]]] = {}
    close = np.zeros(on.shape, dtype=bool)
    for y, x in np.ndindex(on.shape):
        level, last, found = signal[0, y, x], -np.inf, []
        for k in range(1, len(frames)):
            start, end = signal[k - 1, y, x], signal[k, y, x]
            for sign, step in ((1, float(on[y, x])), (-1, -float(off[y, x]))):
                while sign * (end - level - step) >= 0:
                    level += step
                    us_per_change = (times_us[k] - times_us[k - 1]) / (end - start)
                    t = times_us[k - 1] + (level - start) * us_per_change
                    if t - last >= settings.refractory_us:
                        found.append((t, sign, 2e-6 * abs(us_per_change)))
                        last = t
                close[y, x] |= abs(end - level - step) < 1e-5
        events[y, x] = found
    return events, close


def by_pixel(stream: EventStream) -> dict[tuple[int, int], list[tuple[int, int]]]:
    """(time, polarity) of the events of each pixel (y, x), in order."""
    found: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for t, x, y, p in zip(stream.t, stream.x, stream.y, stream.p, strict=True):
        found.setdefault((int(y), int(x)), []).append((int(t), int(p)))
    return found


def joined(parts: Iterator[EventStream] | list[EventStream]) -> EventStream:
    """Slices as one stream."""
    parts = list(parts)
    return EventStream(*(np.concatenate([getattr(s, name) for s in parts]) for name in "txyp"))


def moving_pattern(seed: int, count: int, height: int = 24, width: int = 37) -> list[np.ndarray]:
    """Linear pictures of random waves that travel, from black to full scale."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width]
    waves = rng.uniform(-0.6, 0.6, (5, 3))
    frames = []
    for k in range(count):
        sum_of_waves = sum(np.sin(a * x + b * y + 0.5 * c * k + 9 * a) for a, b, c in waves)
        frames.append(((sum_of_waves / 10 + 0.5).clip(0, 1) ** 2.2).astype(np.float32))
    return frames


def run(sensor: SensorSimulator, frames, times) -> EventStream:
    """All events of pictures shown at these times."""
    return joined([sensor.step(f, int(t)) for f, t in zip(frames, times, strict=True)])


def constant(sensor: SensorSimulator, light: float, seconds: float, step_us: int) -> EventStream:
    """All events under unchanging light."""
    picture = np.full((sensor.height, sensor.width), light, dtype=np.float32)
    times = range(0, int(seconds * 1e6) + 1, step_us)
    return run(sensor, [picture] * len(times), times)


def counts(stream: EventStream, sensor: SensorSimulator) -> np.ndarray:
    """Events of each pixel (H, W)."""
    pixel = stream.y.astype(int) * sensor.width + stream.x
    flat = np.bincount(pixel, minlength=sensor.width * sensor.height)
    return flat.reshape(sensor.height, sensor.width)
