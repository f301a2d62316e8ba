"""Exposures over sub-frames, and the mean of each in linear light as they come by."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64

from evsplat.errors import ConfigError
from evsplat.options import SynthesisSettings


@dataclass(frozen=True)
class Exposure:
    """One blurry frame to be made."""

    source: int
    """Index of the source picture in the middle, which is its sharp truth."""
    start_us: int
    end_us: int


@dataclass(frozen=True, eq=False)
class Plan:
    """All sub-frames and exposures of a synthesis."""

    subframe_us: Int64[np.ndarray, "S"]
    """Strictly ascending; every ``factor``-th is a source picture's own."""
    edges_us: Float[np.ndarray, "S+1"]
    """A sub-frame stands for the time between its two edges, half way to its neighbours."""
    exposures: tuple[Exposure, ...]


def plan_exposures(times_us: Int64[np.ndarray, "N"], settings: SynthesisSettings) -> Plan:
    """Sub-frames between source times and the exposures that fit into the footage.

    Mid-exposures fall exactly on source pictures: with ``settings.fps`` on those nearest to even
    spacing. Raises `ConfigError` where settings and footage do not go together.
    """
    if len(times_us) < 2:
        raise ConfigError("the footage is a single picture, expected at least 2.")
    gap_us = float(np.median(np.diff(times_us)))
    subframes = _subframes(times_us, settings.factor)
    spacing_us = gap_us / settings.factor
    middles = (subframes[1:] + subframes[:-1]) / 2
    # exposures are whole microseconds and may begin one before the first sub-frame's time
    outer = spacing_us / 2 + 1
    edges = np.concatenate([[subframes[0] - outer], middles, [subframes[-1] + outer]])
    period_us = gap_us if settings.fps is None else 1e6 / settings.fps
    if period_us < 0.99 * gap_us:
        raise ConfigError(
            f"fps {settings.fps:g}: the source has {1e6 / gap_us:.4g} pictures per second and each "
            "blurry frame needs one of its own as truth; give at most that rate."
        )
    half_us = round(_length_us(settings, period_us, spacing_us) / 2)
    if 2 * half_us < 1.5 * spacing_us:
        raise ConfigError(
            f"exposures of {2 * half_us} us see a single sub-frame (one every {spacing_us:.0f} us) "
            "and are not blurry; give a longer exposure, a lower fps or more sub-frames."
        )
    fits = (times_us - half_us >= edges[0]) & (times_us + half_us <= edges[-1])
    chosen = np.flatnonzero(fits)
    if not len(chosen):
        raise ConfigError(
            f"the footage lasts {(times_us[-1] - times_us[0]) / 1e6:.3f} s, too short for an "
            f"exposure of {2 * half_us / 1e6:.3f} s; give a shorter one."
        )
    if settings.fps is not None:
        chosen = _spaced(times_us, chosen, period_us, gap_us)
    exposures = (
        Exposure(int(i), int(times_us[i]) - half_us, int(times_us[i]) + half_us) for i in chosen
    )
    return Plan(subframes, edges, tuple(exposures))


def _subframes(times_us: Int64[np.ndarray, "N"], factor: int) -> Int64[np.ndarray, "S"]:
    starts, gaps = times_us[:-1, None], np.diff(times_us)[:, None]
    if gaps.min() < factor:
        raise ConfigError(
            f"upsample {factor}: pictures {int(gaps.min())} us apart leave no whole microseconds "
            "between sub-frames; give a smaller factor."
        )
    between = starts + np.round(gaps * (np.arange(factor) / factor)).astype(np.int64)
    return np.append(between.ravel(), times_us[-1])


def _length_us(settings: SynthesisSettings, period_us: float, spacing_us: float) -> float:
    if settings.exposure_us is not None:
        return settings.exposure_us
    if settings.subframes is not None:
        return settings.subframes * spacing_us
    assert settings.duty is not None
    return settings.duty * period_us


def _spaced(
    times_us: Int64[np.ndarray, "N"],
    allowed: Int64[np.ndarray, "A"],
    period_us: float,
    gap_us: float,
) -> Int64[np.ndarray, "M"]:
    """Indices of allowed pictures nearest to even times from the first of them on."""
    times = times_us[allowed]
    wanted = np.arange(times[0], times[-1] + gap_us / 2, period_us)
    after = np.searchsorted(times, wanted).clip(0, len(times) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.where(wanted - times[before] < times[after] - wanted, before, after)
    return allowed[np.unique(nearer)]


class ExposureMean:
    """Means over exposures of sub-frames that come one after the other.

    A sub-frame counts by how much of its time lies in the exposure. Memory grows with the number of
    exposures that overlap, not with that of sub-frames.
    """

    def __init__(self, plan: Plan) -> None:
        self._edges = plan.edges_us
        self._waiting = deque(plan.exposures)
        self._open: deque[tuple[Exposure, np.ndarray]] = deque()
        self._next = 0

    def add(
        self, linear: Float[np.ndarray, "H W C"]
    ) -> Iterator[tuple[Exposure, Float[np.ndarray, "H W C"]]]:
        """Show the next sub-frame; gives the exposures that it completes, with their means."""
        start, end = self._edges[self._next], self._edges[self._next + 1]
        self._next += 1
        last = self._next == len(self._edges) - 1
        while self._waiting and self._waiting[0].start_us < end:
            self._open.append((self._waiting.popleft(), np.zeros(linear.shape)))
        for exposure, total in self._open:
            seen_us = min(end, exposure.end_us) - max(start, exposure.start_us)
            if seen_us > 0:
                total += (seen_us / (exposure.end_us - exposure.start_us)) * linear
        while self._open and (self._open[0][0].end_us <= end or last):
            exposure, total = self._open.popleft()
            yield exposure, total.astype(np.float32)
