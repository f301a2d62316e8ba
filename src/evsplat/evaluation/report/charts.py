"""Line charts as inline SVG; colours come from the page's style sheet."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise

import numpy as np

_WIDTH, _HEIGHT = 380, 240
_LEFT, _RIGHT, _TOP, _BOTTOM = 46, 12, 10, 36
_MOST_POINTS = 240
SERIES_COLOURS = 8
"""Line colours of the style sheet."""


@dataclass(frozen=True)
class Series:
    """One line of a chart."""

    name: str
    x: Sequence[float]
    y: Sequence[float]


def line_chart(
    series: Sequence[Series],
    *,
    x_title: str,
    y_title: str,
    log: bool = False,
    dots: bool = False,
    lines: bool = True,
) -> str:
    """An SVG element with axes and lines, and a legend where there are several.

    Long series are averaged over bins, unless each value has its dot. On a logarithmic axis values
    that are not positive leave a gap.
    """
    prepared = [(line.name, *_prepared(line, log, whole=dots)) for line in series]
    prepared = [(name, x, y) for name, x, y in prepared if len(x)]
    if not prepared:
        return ""
    area = _Area.of([(x, y) for _, x, y in prepared])
    parts = area.axes(log=log)
    # A single line takes the accent colour; the first of several is the sum, in the text colour.
    first = 1 if len(prepared) == 1 else 0
    for number, (name, x, y) in enumerate(prepared, start=first):
        places, colour = area.places(x, y), f"c{number % SERIES_COLOURS}"
        if lines:
            points = " ".join(f"{left},{top}" for left, top in places)
            parts.append(
                f'<polyline class="line {colour}" points="{points}">'
                f"<title>{escape(name)}</title></polyline>"
            )
        if dots:
            parts += [
                f'<circle class="dot {colour}" cx="{left}" cy="{top}" r="3"/>'
                for left, top in places
            ]
    parts.append(
        f'<text class="tick" x="{_WIDTH - _RIGHT}" y="{_HEIGHT - 2}" text-anchor="end">'
        f"{escape(x_title)}</text>"
    )
    legend = "".join(
        f'<span class="key"><i class="c{number % SERIES_COLOURS}"></i>{escape(name)}</span>'
        for number, (name, _, _) in enumerate(prepared)
    )
    scale = ", logarithmic" if log else ""
    return (
        f'<figure class="chart"><figcaption>{escape(y_title)}{scale}</figcaption>'
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{escape(y_title)}">'
        f"{''.join(parts)}</svg>"
        f'<div class="legend">{legend if len(prepared) > 1 else ""}</div></figure>'
    )


@dataclass(frozen=True)
class _Area:
    """Ranges of both axes; on a logarithmic one those of decimal logarithms."""

    x_low: float
    x_high: float
    y_low: float
    y_high: float

    @classmethod
    def of(cls, lines: Sequence[tuple[np.ndarray, np.ndarray]]) -> "_Area":
        """That holds the points of all lines, with a margin above and below."""
        x, y = (np.concatenate(values) for values in zip(*lines, strict=True))
        y_low, y_high = _widened(float(y.min()), float(y.max()))
        margin = 0.05 * (y_high - y_low)
        return cls(*_widened(float(x.min()), float(x.max())), y_low - margin, y_high + margin)

    def left(self, x: float) -> float:
        """Of a value, in the SVG's units."""
        return _LEFT + (x - self.x_low) / (self.x_high - self.x_low) * (_WIDTH - _LEFT - _RIGHT)

    def top(self, y: float) -> float:
        """Of a value, in the SVG's units, downwards."""
        share = (y - self.y_low) / (self.y_high - self.y_low)
        return _HEIGHT - _BOTTOM - share * (_HEIGHT - _TOP - _BOTTOM)

    def places(self, x: np.ndarray, y: np.ndarray) -> list[tuple[str, str]]:
        """Of points, as the SVG has them."""
        return [
            (f"{self.left(float(a)):.1f}", f"{self.top(float(b)):.1f}")
            for a, b in zip(x, y, strict=True)
        ]

    def axes(self, *, log: bool) -> list[str]:
        """Grid, labels and the base line."""
        right, base = _WIDTH - _RIGHT, _HEIGHT - _BOTTOM
        parts = []
        for value, label in (_log_ticks if log else _ticks)(self.y_low, self.y_high):
            y = self.top(value)
            parts += [
                f'<line class="grid" x1="{_LEFT}" x2="{right}" y1="{y:.1f}" y2="{y:.1f}"/>',
                f'<text class="tick" x="{_LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{label}'
                "</text>",
            ]
        for value, label in _ticks(self.x_low, self.x_high):
            parts.append(
                f'<text class="tick" x="{self.left(value):.1f}" y="{base + 18}" '
                f'text-anchor="middle">{label}</text>'
            )
        return [*parts, f'<line class="axis" x1="{_LEFT}" x2="{right}" y1="{base}" y2="{base}"/>']


def _prepared(line: Series, log: bool, *, whole: bool) -> tuple[np.ndarray, np.ndarray]:
    """Finite points, binned; on a logarithmic axis the ordinate is the decimal logarithm."""
    x, y = np.asarray(line.x, dtype=np.float64), np.asarray(line.y, dtype=np.float64)
    keep = np.isfinite(x) & np.isfinite(y) & ((y > 0) if log else True)
    x, y = x[keep], y[keep]
    if len(x) > _MOST_POINTS and not whole:
        groups = np.array_split(np.arange(len(x)), _MOST_POINTS)
        x = np.array([x[group].mean() for group in groups])
        y = np.array([y[group].mean() for group in groups])
    return x, np.log10(y) if log else y


def _widened(low: float, high: float) -> tuple[float, float]:
    """An interval that is not empty."""
    if high > low:
        return low, high
    half = max(abs(low) * 0.05, 0.5)
    return low - half, high + half


def _ticks(low: float, high: float) -> list[tuple[float, str]]:
    """About five round values inside [low, high] with labels."""
    rough = (high - low) / 5
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= rough)
    first = math.ceil(low / step)
    last = math.floor(high / step)
    return [(index * step, _label(index * step, step)) for index in range(first, last + 1)]


def _log_ticks(low: float, high: float) -> list[tuple[float, str]]:
    """Powers of ten inside the range of decimal logarithms, with 2 and 5 where they are few."""
    factors = (1,) if high - low > 2.5 else (1, 2, 5)
    step = max(1, math.ceil((high - low) / 6))
    exponents = range(math.floor(low), math.ceil(high) + 1, step)
    values = [(e + math.log10(factor), factor * 10.0**e) for e in exponents for factor in factors]
    ticks = [(place, _label(value)) for place, value in values if low <= place <= high]
    # A range within a factor of two may hold none: fall back on linear places.
    if ticks:
        return ticks
    places = [place for place, _ in _ticks(low, high)]
    least = min((10**b - 10**a for a, b in pairwise(places)), default=1.0)
    return [(place, _label(10**place, least)) for place in places]


def _label(value: float, step: float = math.inf) -> str:
    """A value in short, with as many digits as tell it from one that is a ``step`` away."""
    digits = 1
    if value and math.isfinite(step):
        powers = (math.floor(math.log10(number)) for number in (abs(value), step))
        digits = max(1, 1 + next(powers) - next(powers))
    if value and abs(value) < 1e-3:
        return f"{value:.{digits - 1}e}".replace("e-0", "e-")
    if abs(value) >= 1e4:
        return f"{value / 1000:.{max(digits, 6)}g}k"
    return f"{value:.{max(digits, 4)}g}"
