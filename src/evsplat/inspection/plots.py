"""Pages with a time axis: a capture's exposures, key poses and event rate; one curve."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw

from evsplat.capture.capture import Capture
from evsplat.inspection.drawing import (
    CURVE,
    FAINT,
    INK,
    OVERSAMPLING,
    PAPER,
    TEST,
    font,
    header,
    line,
    round_ticks,
    short_number,
    split_colour,
)
from evsplat.wording import counted

_WIDTH, _HEIGHT = 1400, 470
_LEFT, _RIGHT = 96, 24
_BARS, _POSES, _RATE = (84, 168), (190, 204), (238, 408)
_RATE_BINS = 400
_CURVE_WIDTH, _CURVE_HEIGHT = 1000, 360
_CURVE_LEFT, _CURVE_RIGHT, _TOP, _BOTTOM = 70, 976, 76, 290


def draw_timeline(capture: Capture) -> Image.Image:
    """Exposures as bars (in two rows if they overlap), key poses as ticks, event rate below."""
    start, end = _span_us(capture)
    page = Image.new("RGB", (_WIDTH * OVERSAMPLING, _HEIGHT * OVERSAMPLING), PAPER)
    shapes = ImageDraw.Draw(page)

    def x_of(time_us: float) -> float:
        return _LEFT + (time_us - start) / (end - start) * (_WIDTH - _LEFT - _RIGHT)

    for tick in round_ticks(0, end - start):
        x = x_of(start + tick)
        line(shapes, [(x, _BARS[0]), (x, _RATE[1] + 5)], (232, 235, 239), 1)
    _draw_exposures(capture, shapes, x_of)
    for time_us in _pose_times(capture):
        if start <= time_us <= end:
            x = x_of(float(time_us))
            line(shapes, [(x, _POSES[0]), (x, _POSES[1])], INK, 1)
    peak = _draw_rate(capture, shapes, x_of)
    page = page.resize((_WIDTH, _HEIGHT), Image.Resampling.LANCZOS)
    _draw_labels(capture, ImageDraw.Draw(page), x_of, (start, end), peak)
    return page


def _span_us(capture: Capture) -> tuple[int, int]:
    """Time from the first to the last exposure or event."""
    starts = [min(frame.exposure_us[0] for frame in capture.frames)]
    ends = [max(frame.exposure_us[1] for frame in capture.frames)]
    if capture.events is not None and len(capture.events):
        first, last = capture.events.time_range_us
        starts.append(first)
        ends.append(last)
    return min(starts), max(ends)


def _draw_exposures(
    capture: Capture, draw: ImageDraw.ImageDraw, x_of: Callable[[float], float]
) -> None:
    overlap = any(
        after.exposure_us[0] < before.exposure_us[1]
        for before, after in zip(capture.frames, capture.frames[1:], strict=False)
    )
    rows = 2 if overlap else 1
    height = (_BARS[1] - _BARS[0]) / rows
    for frame in capture.frames:
        top = _BARS[0] + frame.index % rows * height
        left, right = x_of(frame.exposure_us[0]), x_of(frame.exposure_us[1])
        box = (left, top + 2, max(right - 1, left + 1), top + height - 2)
        draw.rectangle([OVERSAMPLING * v for v in box], fill=split_colour(frame.split))


def _draw_rate(
    capture: Capture, draw: ImageDraw.ImageDraw, x_of: Callable[[float], float]
) -> float:
    """Draw the filled curve; gives the events per second at its top."""
    line(draw, [(_LEFT, _RATE[1]), (_WIDTH - _RIGHT, _RATE[1])], FAINT, 1)
    if capture.events is None or len(capture.events) == 0:
        return 0.0
    edges, rate = capture.events.rate(_RATE_BINS)
    peak = float(rate.max())
    points = []
    for index, value in enumerate(rate):
        y = _RATE[1] - value / peak * (_RATE[1] - _RATE[0])
        points += [(x_of(edges[index]), y), (x_of(edges[index + 1]), y)]
    outline = [(points[0][0], _RATE[1]), *points, (points[-1][0], _RATE[1])]
    draw.polygon([(OVERSAMPLING * x, OVERSAMPLING * y) for x, y in outline], fill=(222, 218, 240))
    line(draw, points, CURVE, 1.5)
    return peak


def _pose_times(capture: Capture) -> list[int]:
    return capture.body_file.times_us.tolist() if capture.has_body else []


def _draw_labels(
    capture: Capture,
    draw: ImageDraw.ImageDraw,
    x_of: Callable[[float], float],
    span: tuple[int, int],
    peak: float,
) -> None:
    start, end = span
    subtitle = ", ".join(
        (counted(len(capture.frames), "exposure"), counted(len(_pose_times(capture)), "key pose"))
    )
    if capture.events is not None:
        subtitle += f", {len(capture.events):,} events"
    header(
        draw,
        f"{capture.name}: timeline",
        subtitle,
        _WIDTH,
        {frame.split for frame in capture.frames},
    )
    for text, (top, bottom) in (("exposures", _BARS), ("key poses", _POSES)):
        draw.text((10, (top + bottom) / 2), text, fill=INK, font=font(14), anchor="lm")
    draw.text((10, (_RATE[0] + _RATE[1]) / 2), "events/s", fill=INK, font=font(14), anchor="lm")
    for value, y in ((peak, _RATE[0]), (0.0, _RATE[1])):
        draw.text((_LEFT - 6, y), short_number(value), fill=FAINT, font=font(12), anchor="rm")
    for tick in round_ticks(0, end - start):
        at = x_of(start + tick), _RATE[1] + 10
        draw.text(at, f"{tick / 1e6:g}", fill=FAINT, font=font(13), anchor="mt")
    centre = (_LEFT + _WIDTH - _RIGHT) / 2
    text = f"seconds from {start:,} us of the capture's clock" if start else "seconds"
    draw.text((centre, _HEIGHT - 26), text, fill=FAINT, font=font(14), anchor="mt")


def draw_curve(
    title: str,
    subtitle: str,
    x: Float[np.ndarray, "N"],
    y: Float[np.ndarray, "N"],
    *,
    x_label: str,
    x_unit: float,
    marks: Sequence[float] = (),
) -> Image.Image:
    """A curve over whole-number ``x``, with ticks at round multiples, shown divided by ``x_unit``.

    ``marks`` are places on the x axis that get a vertical line. Values that are NaN are left out.
    """
    x, y = x[np.isfinite(y)], y[np.isfinite(y)]
    start, end = float(x.min()), float(max(x.max(), x.min() + 1))
    low, high = min(0.0, float(y.min())), max(float(y.max()), 1e-9)
    page = Image.new("RGB", (_CURVE_WIDTH * OVERSAMPLING, _CURVE_HEIGHT * OVERSAMPLING), PAPER)
    shapes = ImageDraw.Draw(page)

    def place(at: float, value: float) -> tuple[float, float]:
        return (
            _CURVE_LEFT + (at - start) / (end - start) * (_CURVE_RIGHT - _CURVE_LEFT),
            _BOTTOM - (value - low) / (high - low) * (_BOTTOM - _TOP),
        )

    ticks = round_ticks(round(start), round(end))
    for tick in ticks:
        line(shapes, [place(tick, low), place(tick, high)], (232, 235, 239), 1)
    line(shapes, [place(start, 0), place(end, 0)], FAINT, 1)
    for mark in marks:
        line(shapes, [place(mark, low), place(mark, high)], TEST, 1.5)
    line(shapes, [place(*point) for point in zip(x, y, strict=True)], CURVE, 1.5)
    page = page.resize((_CURVE_WIDTH, _CURVE_HEIGHT), Image.Resampling.LANCZOS)
    draw = ImageDraw.Draw(page)
    header(draw, title, subtitle, _CURVE_WIDTH, set())
    for value in (low, high):
        beside = (_CURVE_LEFT - 6, place(start, value)[1])
        text = f"-{short_number(-value)}" if value < 0 else short_number(value)
        draw.text(beside, text, fill=FAINT, font=font(12), anchor="rm")
    for tick in ticks:
        below = (place(tick, low)[0], _BOTTOM + 8)
        draw.text(below, f"{tick / x_unit:g}", fill=FAINT, font=font(13), anchor="mt")
    centre = ((_CURVE_LEFT + _CURVE_RIGHT) / 2, _CURVE_HEIGHT - 26)
    draw.text(centre, x_label, fill=INK, font=font(14), anchor="mt")
    return page
